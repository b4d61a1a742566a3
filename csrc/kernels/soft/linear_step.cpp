#include "kernels/soft/linear_step.h"

#include "kernels/soft/linearized_solver.h"

namespace diffsim {
namespace {

KrylovResult solve(const ConstantSystem& system, StepProblem& problem, const StepOptions& options,
                   const Vector& q, const Vector& b, double tolerance, Vector& z) {
  const bool factorize = system.plan().factorize_adjoint(options.rtol);
  return LinearizedSolver(problem, system.plan(), q)
      .solve(StepMethod::kAuto, factorize, b, tolerance, options.max_iters, z);
}

void note(const KrylovResult& result, const StepProblem& problem, StepStats& stats) {
  stats.residual_norm = result.residual_norm;
  stats.num_iters = result.num_iters;
  stats.converged = result.converged ? 1.0 : 0.0;
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;
}

}  // namespace

LinearProblem::LinearProblem(const ConstantSystem& system, StepProblem& problem,
                             const StepInputs& in)
    : q(in.guess, in.guess + problem.size()), moved(problem.size(), 0.0) {
  problem.value_gradient(q, b);
  for (std::size_t i = 0; i < q.size(); ++i) {
    b[i] = -b[i];
    if (!system.fixed()[i]) continue;
    moved[i] = in.target[i] - q[i];
    is_pushed = is_pushed || moved[i] != 0.0;
  }
}

void LinearProblem::push(const StepProblem& problem, const Vector& pushed) {
  for (std::size_t i = 0; i < b.size(); ++i) b[i] -= pushed[i];
  problem.zero_fixed(b);
}

void LinearProblem::finish(const Vector& z, double* x) const {
  for (std::size_t i = 0; i < q.size(); ++i) x[i] = q[i] + (z[i] + moved[i]);
}

StepStats LinearProblem::begin_stats(StepProblem& problem, const StepOptions& options) {
  StepStats stats;
  const double norm = problem.ops().norm(b);
  stats.residual_norm = norm;
  stats.scale = problem.scale() > 0.0 ? problem.scale() : norm;
  stats.tolerance = options.rtol * stats.scale + options.atol;
  stats.energy = problem.elastic_energy();
  return stats;
}

StepStats linear_step(const ConstantSystem& system, const StepInputs& inputs,
                      const StepOptions& options, double* x, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool, uses_multigrid(system, options.method));
  LinearProblem linear(system, problem, inputs);
  Vector z(problem.size(), 0.0);
  problem.assemble(linear.q, false);
  if (linear.is_pushed) {
    problem.multiply_all(linear.moved, z);
    linear.push(problem, z);
  }
  StepStats stats = linear.begin_stats(problem, options);
  if (std::isfinite(stats.residual_norm))
    note(solve(system, problem, options, linear.q, linear.b, stats.tolerance, z), problem, stats);
  linear.finish(z, x);
  return stats;
}

StepStats linear_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                              const StepOptions& options, const double* x_in, const double* grad_x,
                              const StepAdjoint& out, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool, uses_multigrid(system, options.method));
  const std::size_t size = problem.size();
  const Vector x(x_in, x_in + size), q(inputs.guess, inputs.guess + size);
  problem.assemble(q, false);
  Vector b(grad_x, grad_x + size), z;
  problem.zero_fixed(b);
  StepStats stats;
  stats.scale = problem.ops().norm(b);
  stats.tolerance = options.rtol * stats.scale + options.atol;
  note(solve(system, problem, options, q, b, stats.tolerance, z), problem, stats);
  problem.linear_input_gradients(x, z, problem.left_at_fixed(grad_x, z), out);
  return stats;
}

}  // namespace diffsim
