#include "kernels/soft/linearized_solver.h"

namespace diffsim {
namespace {

bool wants_factor(const ConstantSystem& system, const StepOptions& options) {
  return options.method == StepMethod::kNewtonCholesky ||
         (options.method == StepMethod::kAuto && system.plan().factorize_adjoint(options.rtol));
}

}  // namespace

StepStats implicit_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x_in,
                                const double* grad_x, const StepAdjoint& out, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool, uses_multigrid(system, options.method));
  const std::size_t size = problem.size();
  const Vector x(x_in, x_in + size);
  problem.assemble(x, false);

  Vector b(grad_x, grad_x + size), z;
  problem.zero_fixed(b);
  StepStats stats;
  stats.scale = problem.ops().norm(b);
  stats.tolerance = options.rtol * stats.scale + options.atol;
  const KrylovResult solve = LinearizedSolver(problem, system.plan(), x)
                                 .solve(options.method, wants_factor(system, options), b,
                                        stats.tolerance, options.max_iters, z);
  stats.residual_norm = solve.residual_norm;
  stats.num_iters = solve.num_iters;
  stats.converged = solve.converged ? 1.0 : 0.0;
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;

  problem.input_gradients(x, z, problem.left_at_fixed(grad_x, z), out);
  return stats;
}

}  // namespace diffsim
