#include "kernels/soft/implicit_step.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {
namespace {

/// Solves H z = b to |H z - b| <= tolerance, H symmetric, perhaps indefinite.
class AdjointSolver {
  auto apply() {
    return [this](const Vector& in, Vector& out) { problem_.multiply(in, out); };
  }
  auto constant() {
    return [this](const Vector& in, Vector& out) { problem_.solve_constant(in, out); };
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
  AdjointSolver(StepProblem& problem, const Vector& x) : problem_(problem), x_(x) {}

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
      result = conjugate(constant(), b, tolerance, max_iters, z);
    if (result.converged) return result;
    // Indefinite (the step stopped at a saddle) or stalled: MINRES needs no sign. Its
    // preconditioner must be positive definite: a factor of the clamped tangent, else the constant
    // one.
    const int spent = result.num_iters;
    problem_.assemble(x_, true);
    const bool clamped = problem_.factorize();
    problem_.assemble(x_, false);
    result = clamped ? minres(apply(), tangent(), b, z, tolerance, max_iters, problem_.ops())
                     : minres(apply(), constant(), b, z, tolerance, max_iters, problem_.ops());
    result.num_iters += spent;
    return result;
  }

 private:
  StepProblem& problem_;
  const Vector& x_;
  KrylovScratch scratch_;
};

bool wants_factor(const ConstantSystem& system, const StepOptions& options) {
  return options.method == StepMethod::kNewtonCholesky ||
         (options.method == StepMethod::kAuto && system.plan().factorize_adjoint(options.rtol));
}

}  // namespace

StepStats implicit_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x_in,
                                const double* grad_x, const StepAdjoint& out, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool);
  const std::size_t size = problem.size();
  const Vector x(x_in, x_in + size);
  problem.assemble(x, false);

  Vector b(grad_x, grad_x + size), z, reaction;
  problem.zero_fixed(b);
  StepStats stats;
  stats.scale = problem.ops().norm(b);
  stats.tolerance = options.rtol * stats.scale + options.atol;
  const KrylovResult solve = AdjointSolver(problem, x)
                                 .solve(options.method, wants_factor(system, options), b,
                                        stats.tolerance, options.max_iters, z);
  stats.residual_norm = solve.residual_norm;
  stats.num_iters = solve.num_iters;
  stats.converged = solve.converged ? 1.0 : 0.0;
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;

  // What is left at fixed unknowns: dL/dx - H z.
  problem.multiply_all(z, reaction);
  Vector e(grad_x, grad_x + size);
  problem.ops().add(-1.0, reaction, e);
  problem.input_gradients(x, z, e, out);
  return stats;
}

}  // namespace diffsim
