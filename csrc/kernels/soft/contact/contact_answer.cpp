#include "kernels/soft/contact/contact_answer.h"

namespace diffsim {

ContactAnswer::ContactAnswer(const ConstantSystem& system, const StepInputs& inputs,
                             const ContactInputs& contacts, const double* x_in,
                             const std::int64_t* status, bool by_multigrid, ThreadPool& pool)
    : system_(system),
      pool_(pool),
      problem(system, inputs, pool, by_multigrid),
      x(x_in, x_in + problem.size()),
      space(contacts) {
  problem.value_gradient(x, r);
  space.restore(status, x, r, system.diagonal());
  problem.assemble(x, false);
}

StepStats ContactAnswer::solve(LinearSide side, const StepOptions& options,
                               const ContactOptions& contact_options, const Vector& rhs,
                               Vector& out) {
  StepStats stats;
  stats.scale = problem.ops().norm(rhs);
  stats.tolerance = options.rtol * stats.scale + options.atol;
  ContactSolve solve(problem, system_, space, options.method, options.rtol,
                     contact_options.cache_columns, pool_);
  const KrylovResult result =
      solve.solve_answer(x, side, rhs, stats.tolerance, options.max_iters, out);
  stats.residual_norm = result.residual_norm;
  stats.num_iters = result.num_iters;
  stats.converged = result.converged ? 1.0 : 0.0;
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;
  return stats;
}

}  // namespace diffsim
