#include "kernels/soft/implicit_step.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {
namespace {

/// Solves H z = b to |H z - b| <= tolerance, H symmetric, perhaps indefinite.
KrylovResult solve_adjoint(StepProblem& problem, StepMethod method, const Vector& b,
                           double tolerance, int max_iters, Vector& z) {
  const auto apply = [&](const Vector& in, Vector& out) { problem.multiply(in, out); };
  const auto constant = [&](const Vector& in, Vector& out) { problem.solve_constant(in, out); };
  const auto jacobi = [&](const Vector& in, Vector& out) { problem.solve_jacobi(in, out); };
  const auto direct = [&](const Vector& in, Vector& out) { problem.solve_factorized(in, out); };
  KrylovScratch scratch;
  KrylovResult result;
  if (method == StepMethod::kNewtonCholesky && problem.factorize()) {
    // Conjugate gradients on the exact factor is iterative refinement that measures its residual.
    result = conjugate_gradients(apply, direct, b, z, false, tolerance, max_iters, scratch,
                                 problem.ops());
  } else if (method == StepMethod::kNewtonJacobi) {
    result = conjugate_gradients(apply, jacobi, b, z, false, tolerance, max_iters, scratch,
                                 problem.ops());
  } else {
    result = conjugate_gradients(apply, constant, b, z, false, tolerance, max_iters, scratch,
                                 problem.ops());
  }
  if (result.converged) return result;
  // Indefinite (the step stopped at a saddle) or stalled: MINRES needs no sign.
  const int spent = result.num_iters;
  result = minres(apply, constant, b, z, tolerance, max_iters, problem.ops());
  result.num_iters += spent;
  return result;
}

}  // namespace

StepStats implicit_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x_in, const double* grad_x,
                                const StepAdjoint& out, ThreadPool& pool) {
  StepProblem problem(system, inputs, pool);
  const std::size_t size = problem.size();
  const Vector x(x_in, x_in + size);
  problem.assemble(x, false);

  Vector b(grad_x, grad_x + size), z, reaction;
  problem.zero_fixed(b);
  StepStats stats;
  stats.scale = problem.ops().norm(b);
  stats.tolerance = options.rtol * stats.scale + options.atol;
  const KrylovResult solve =
      solve_adjoint(problem, options.method, b, stats.tolerance, options.max_iters, z);
  stats.residual_norm = solve.residual_norm;
  stats.num_iters = solve.num_iters;
  stats.converged = solve.converged ? 1.0 : 0.0;
  stats.num_solves = problem.num_solves;
  stats.num_factorizations = problem.num_factorizations;

  problem.multiply_all(z, reaction);
  const double* inertia = system.inertia();
  for (std::size_t i = 0; i < size; ++i) {
    out.y[i] = inertia[i / 3] * z[i];
    out.force[i] = z[i];
    out.target[i] = system.fixed()[i] ? grad_x[i] - reaction[i] : 0.0;
    if (i % 3 == 0) out.inertia[i / 3] = 0.0;
    out.inertia[i / 3] -= z[i] * (x[i] - inputs.y[i]);
  }

  ElasticityScratch scratch;
  std::vector<DampingFrame> frames;
  if (inputs.parameters.damp_mu)
    frames = damping_frames(system.model(), inputs.x_frame, inputs.x_velocity, pool);
  parameter_adjoint(system.model(), inputs.parameters, frames, x.data(), z.data(), out.parameters,
                    scratch, pool);
  const auto negate = [](double* values, std::int64_t count) {
    if (values)
      for (std::int64_t i = 0; i < count; ++i) values[i] = -values[i];
  };
  const ParameterAdjoint& p = out.parameters;
  const std::int64_t elements = system.model().solid.num_elements;
  const std::int64_t fibres = system.model().fibre.num_elements;
  negate(p.w_mu, elements);
  negate(p.w_vol, elements);
  negate(p.fibre_stiffness, fibres);
  negate(p.activation, fibres);
  if (inputs.parameters.damp_mu) {
    negate(p.damp_mu, elements);
    negate(p.damp_lambda, elements);
    negate(p.x_frame, 3 * system.model().num_nodes);
    negate(p.x_velocity, 3 * system.model().num_nodes);
  }
  return stats;
}

}  // namespace diffsim
