// Solves with the tangent matrix of a converged step: its adjoint, and what its derivatives leave.
#pragma once

#include "kernels/soft/step_problem.h"

namespace diffsim {

/// Solves H z = b to |H z - b| <= tolerance, H symmetric, perhaps indefinite.
class LinearizedSolver {
  auto apply() {
    return [this](const Vector& in, Vector& out) { problem_.multiply(in, out); };
  }
  auto base() {
    return [this](const Vector& in, Vector& out) { problem_.precondition(in, out); };
  }
  auto tangent() {
    return [this](const Vector& in, Vector& out) { problem_.solve_factorized(in, out); };
  }
  template <typename Precondition>
  KrylovResult conjugate(Precondition&& precondition, const Vector& b, double tolerance,
                         int max_iters, Vector& z) {
    return conjugate_gradients(apply(), precondition, b, z, false, tolerance, max_iters, scratch_,
                               problem_.ops());
  }

 public:
  LinearizedSolver(StepProblem& problem, const SolverPlan& plan, const Vector& x)
      : problem_(problem), plan_(plan), x_(x) {}

  KrylovResult solve(StepMethod method, bool factorize, const Vector& b, double tolerance,
                     int max_iters, Vector& z) {
    const bool direct = factorize && problem_.factorize();
    const auto jacobi = [this](const Vector& in, Vector& out) { problem_.solve_jacobi(in, out); };
    KrylovResult result;
    // Conjugate gradients on the exact factor are iterative refinement with a measured residual.
    if (direct)
      result = conjugate(tangent(), b, tolerance, max_iters, z);
    else if (method == StepMethod::kNewtonJacobi)
      result = conjugate(jacobi, b, tolerance, max_iters, z);
    else if (!factorize)
      result = conjugate(base(), b, tolerance, max_iters, z);
    if (result.converged) return result;
    // Indefinite (the step stopped at a saddle) or stalled: MINRES needs no sign. Its
    // preconditioner must be positive definite: a factor of the clamped tangent where memory allows
    // one, else multigrid on it or the constant factor.
    const int spent = result.num_iters;
    problem_.assemble(x_, true);
    const bool clamped = std::isfinite(plan_.factorize_cost) && problem_.factorize();
    if (!clamped && problem_.by_multigrid()) problem_.keep_multigrid();
    problem_.assemble(x_, false);
    result = clamped ? minres(apply(), tangent(), b, z, tolerance, max_iters, problem_.ops())
                     : minres(apply(), base(), b, z, tolerance, max_iters, problem_.ops());
    result.num_iters += spent;
    return result;
  }

 private:
  StepProblem& problem_;
  const SolverPlan& plan_;
  const Vector& x_;
  KrylovScratch scratch_;
};

}  // namespace diffsim
