#include "kernels/soft/linearized_solver.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

/// -d(grad g)/dp dp and, for fixed unknowns that move, -H dtarget: (count, size), fixed entries
/// zero.
Vector right_hand_sides(StepProblem& problem, const ConstantSystem& system, const Vector& x,
                        const StepDirections& d, bool is_linear) {
  const Index size = static_cast<Index>(problem.size());
  Vector rhs(static_cast<std::size_t>(d.count * size));
  if (is_linear)
    problem.linear_load_tangents(x, d, rhs.data());
  else
    problem.load_tangents(x, d, rhs.data());
  Vector pushed(problem.size()), moved(problem.size());
  for (Index k = 0; k < d.count; ++k) {
    double* b = rhs.data() + k * size;
    if (d.target) {
      for (Index i = 0; i < size; ++i)
        moved[static_cast<std::size_t>(i)] = system.fixed()[i] ? d.target[k * size + i] : 0.0;
      problem.multiply_all(moved, pushed);
    }
    for (Index i = 0; i < size; ++i) {
      if (d.target) b[i] -= pushed[static_cast<std::size_t>(i)];
      if (system.fixed()[i]) b[i] = 0.0;
    }
  }
  return rhs;
}

/// (rows, columns) -> (columns, rows).
void transpose(Index rows, Index columns, const double* from, double* to) {
  for (Index i = 0; i < rows; ++i)
    for (Index j = 0; j < columns; ++j) to[j * rows + i] = from[i * columns + j];
}

}  // namespace

StepStats implicit_step_tangent(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x_in,
                                const StepDirections& d, double* dx, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool, uses_multigrid(system, options.method));
  const Index size = static_cast<Index>(problem.size());
  const bool is_linear = options.method == StepMethod::kLinearlyImplicit;
  const Vector x(x_in, x_in + size);
  const Vector point = is_linear ? Vector(inputs.guess, inputs.guess + size) : x;
  problem.assemble(point, false);
  const Vector rhs = right_hand_sides(problem, system, x, d, is_linear);

  // Many right-hand sides repay a factor wherever memory allows one; multigrid may do a few sooner.
  const SolverPlan& plan = system.plan();
  const bool wants_factor = std::isfinite(plan.factorize_cost) &&
                            (!problem.by_multigrid() ||
                             plan.factorize_adjoint(options.rtol, static_cast<double>(d.count)));
  const bool direct = wants_factor && problem.factorize();
  if (direct) {
    Vector columns(rhs.size());
    transpose(d.count, size, rhs.data(), columns.data());
    problem.solve_factorized_many(columns.data(), static_cast<int>(d.count));
    transpose(size, d.count, columns.data(), dx);
  }

  LinearizedSolver solver(problem, plan, point);
  Vector b(problem.size()), z(problem.size()), residual;
  StepStats worst;
  worst.converged = 1.0;
  worst.tolerance = options.rtol;
  for (Index k = 0; k < d.count; ++k) {
    b.assign(rhs.data() + k * size, rhs.data() + (k + 1) * size);
    const double scale = problem.ops().norm(b);
    double left = 0.0;
    if (direct) {
      z.assign(dx + k * size, dx + (k + 1) * size);
      problem.multiply(z, residual);
      problem.ops().add(-1.0, b, residual);
      left = problem.ops().norm(residual);
    }
    // What a factor could not do well enough is left to the adjoint's solver.
    if (scale == 0.0) {
      z.assign(z.size(), 0.0);
    } else if (!direct || !(left <= options.rtol * scale)) {
      const KrylovResult solve =
          solver.solve(options.method, false, b, options.rtol * scale, options.max_iters, z);
      left = solve.residual_norm;
      worst.num_iters += solve.num_iters;
      if (!solve.converged) worst.converged = 0.0;
    }
    if (scale > 0.0) worst.residual_norm = std::max(worst.residual_norm, left / scale);
    for (Index i = 0; i < size; ++i) {
      double& out = dx[k * size + i];
      out = z[static_cast<std::size_t>(i)];
      if (system.fixed()[i]) out = d.target ? d.target[k * size + i] : 0.0;
    }
  }
  worst.num_solves = problem.num_solves;
  worst.num_factorizations = problem.num_factorizations;
  return worst;
}

}  // namespace diffsim
