#include "kernels/soft/small_steps.h"

#include <algorithm>

#include "kernels/soft/element_stage.h"
#include "kernels/soft/linear_step.h"
#include "kernels/soft/small_solver.h"
#include "kernels/soft/step_search.h"

namespace diffsim {
namespace {

// Iterations on a factor that cost about as much as a new one: where more seem to be left, at the
// rate of the last, a new one is made.
constexpr double kWorthFactor = 6.0;
// Factors of one step, after which it is left to the solver of larger bodies.
constexpr int kMostFactors = 4;
// Memory of what steps leave to their adjoints: what is behind it is made again.
constexpr std::size_t kMostKept = std::size_t{1} << 28;  // bytes

/// All that the tangent of a step at x depends on but the system.
Vector tangent_inputs(const ConstantSystem& system, const StepInputs& in, const double* x) {
  const SoftModel& model = system.model();
  const std::int64_t positions = 3 * model.num_nodes, fibers = model.fiber.num_elements;
  Vector all;
  const auto add = [&](const double* values, std::int64_t size) {
    if (values) all.insert(all.end(), values, values + size);
  };
  add(x, positions);
  add(in.parameters.weights, model.weights_size());
  add(in.parameters.fiber_stiffness, fibers), add(in.parameters.activation, fibers);
  add(in.parameters.damp_mu, model.solid.num_elements);
  add(in.parameters.damp_lambda, model.solid.num_elements);
  add(in.inertia, model.num_nodes);
  if (in.parameters.damp_mu) add(in.x_frame, positions), add(in.x_velocity, positions);
  return all;
}

/// Steps that may be kept of a system.
std::size_t most_kept(const ConstantSystem& system) {
  const SoftModel& model = system.model();
  const SmallPattern& pattern = system.pattern().small()->pattern;
  const auto blocks = at(pattern.num_blocks() + pattern.num_factor_blocks());
  const std::size_t samples = elements::with_types(model, [&](auto, auto material) {
    using M = decltype(material);
    return at(model.solid.num_groups) * kParts * sizeof(typename M::template Sample<Native>);
  });
  return kMostKept / (blocks * SmallCholesky::kBlock * sizeof(double) + samples);
}

/// Leaves what a linearly implicit step computed at x to its adjoint.
void keep(const ConstantSystem& system, const StepInputs& in, const double* x, StepProblem& problem,
          std::unique_ptr<SmallCholesky> factor) {
  KeptStep step;
  step.of = tangent_inputs(system, in, x);
  step.factor = std::move(factor);
  step.samples.swap(problem.scratch().samples);
  step.kept_at.swap(problem.scratch().kept_at);
  system.kept_steps().keep(std::move(step), most_kept(system));
}

/// A step on its way.
struct Search {
  Search(const ConstantSystem& system, const StepInputs& in, const StepOptions& options,
         ThreadPool& pool)
      : problem(system, in, pool), solver(system), quasi_newton(problem) {
    x.assign(in.guess, in.guess + problem.size());
    for (std::size_t i = 0; i < x.size(); ++i)
      if (system.fixed()[i]) x[i] = in.target[i];
    value = problem.value_gradient(x, gradient);
    // The tangent is that of the first place; elsewhere nothing needs singular values.
    problem.scratch().stresses_alone = true;
    stats = begin_stats(problem, options, gradient, system.rounding_floor(x));
    is_left = !std::isfinite(value);
    check();
  }

  void check() { stats.converged = stats.residual_norm <= stats.tolerance ? 1.0 : 0.0; }
  bool is_active() const { return !is_left && !is_spent && stats.converged == 0.0; }

  /// Factors the tangent at x; leaves where it is not definite, or that was done too often.
  void refactor() {
    wants_factor = false;
    is_left = stats.num_factorizations >= kMostFactors;
    if (is_left) return;
    solver.assemble(problem, x);
    is_left = !solver.factor();
    stats.num_factorizations += 1.0;
    quasi_newton.forget();
  }

  /// Moves along the direction that the factor gives; leaves where that does not lower the energy.
  void advance(int max_iters) {
    d = gradient;
    quasi_newton.begin(d);
    solver.solve(d, d);
    quasi_newton.finish(d);
    const double slope = problem.ops().dot(d, gradient), last = stats.residual_norm;
    x_old = x, g_old = gradient;
    is_left = !(slope < 0.0 && line_search(problem, d, slope, x, value, gradient));
    if (is_left) return;
    quasi_newton.update(x_old, g_old, x, gradient);
    stats.residual_norm = problem.ops().norm(gradient);
    stats.num_iters += 1.0;
    check();
    const double rate = std::log(stats.residual_norm / last);
    wants_factor = !(std::log(stats.tolerance / stats.residual_norm) > kWorthFactor * rate);
    is_spent = stats.num_iters >= max_iters;
  }

  StepProblem problem;
  SmallSolver solver;
  QuasiNewton quasi_newton;
  Vector x, gradient, d, x_old, g_old;
  StepStats stats;
  double value = 0.0;
  bool is_left = false;   // to the solver of larger bodies
  bool is_spent = false;  // has taken all iterations that it may
  bool wants_factor = true;
};

void note(const SmallSystem& solved, StepStats& stats) {
  stats.residual_norm = solved.result.residual_norm;
  stats.num_iters = solved.result.num_iters;
  stats.num_factorizations = 1.0;
  stats.converged = 1.0;
}

}  // namespace

bool steps_are_small(const ConstantSystem& system, const StepOptions& options) {
  if (options.method == StepMethod::kLinearlyImplicit) return adjoints_are_small(system, options);
  return options.method == StepMethod::kAuto && system.plan().factorize_step(options.rtol) &&
         system.pattern().small();
}

bool adjoints_are_small(const ConstantSystem& system, const StepOptions& options) {
  const bool by_choice =
      options.method == StepMethod::kAuto || options.method == StepMethod::kLinearlyImplicit;
  return by_choice && system.plan().factorize_adjoint(options.rtol) && system.pattern().small();
}

StepStats small_step(const ConstantSystem& system, const StepInputs& in, const StepOptions& options,
                     double* x, ThreadPool& pool) {
  Search search(system, in, options, pool);
  while (search.is_active()) {
    if (search.wants_factor) search.refactor();
    if (search.is_active()) search.advance(options.max_iters);
  }
  search.stats.energy = search.problem.elastic_energy();
  std::copy(search.x.begin(), search.x.end(), x);
  if (!search.is_left) return search.stats;
  // From here on as a larger body, from where it is; a start that was not finite from its guess.
  StepInputs rest = in;
  if (std::isfinite(search.value)) rest.guess = search.x.data();
  StepStats stats = implicit_step(system, rest, options, x, pool);
  stats.num_iters += search.stats.num_iters;
  stats.num_factorizations += search.stats.num_factorizations;
  return stats;
}

StepStats small_linear_step(const ConstantSystem& system, const StepInputs& in,
                            const StepOptions& options, double* x, ThreadPool& pool) {
  StepProblem problem(system, in, pool);
  LinearProblem linear(system, problem, in);
  SmallSolver solver(system);
  solver.assemble(problem, linear.q);
  if (linear.is_pushed) {
    Vector pushed;
    solver.multiply(linear.moved, pushed);
    linear.push(problem, pushed);
  }
  StepStats stats = linear.begin_stats(problem, options);
  SmallSystem s;
  s.b = linear.b;
  s.tolerance = stats.tolerance;
  solver.solve_refined(s, problem.ops());
  if (s.result.converged) {
    linear.finish(s.z, x);
    note(s, stats);
    if (options.keep) keep(system, in, in.guess, problem, solver.release());
    return stats;
  }
  stats = linear_step(system, in, options, x, pool);
  stats.num_factorizations += 1.0;
  return stats;
}

StepStats small_adjoint(const ConstantSystem& system, const StepInputs& in,
                        const StepOptions& options, const double* x, const double* grad_x,
                        const StepAdjoint& out, ThreadPool& pool) {
  const bool by_linear = options.method == StepMethod::kLinearlyImplicit;
  StepProblem problem(system, in, pool);
  SmallSolver solver(system);
  const double* where = by_linear ? in.guess : x;
  const Vector answer(x, x + problem.size());
  KeptStep kept = system.kept_steps().take(tangent_inputs(system, in, where));
  const bool is_factored = kept.factor != nullptr;
  kept.samples.swap(problem.scratch().samples);
  kept.kept_at.swap(problem.scratch().kept_at);
  if (is_factored)
    solver.adopt(std::move(kept.factor));
  else
    solver.assemble(problem, Vector(where, where + problem.size()));
  SmallSystem s;
  s.b.assign(grad_x, grad_x + problem.size());
  problem.zero_fixed(s.b);
  StepStats stats;
  stats.scale = problem.ops().norm(s.b);
  s.tolerance = stats.tolerance = options.rtol * stats.scale + options.atol;
  solver.solve_refined(s, problem.ops());
  if (!s.result.converged) {
    const auto adjoint = by_linear ? linear_step_adjoint : implicit_step_adjoint;
    stats = adjoint(system, in, options, x, grad_x, out, pool);
    stats.num_factorizations += 1.0;
    return stats;
  }
  note(s, stats);
  stats.num_factorizations = is_factored ? 0.0 : 1.0;
  Vector rest(grad_x, grad_x + problem.size());
  problem.ops().add(-1.0, s.product, rest);
  if (by_linear)
    problem.linear_input_gradients(answer, s.z, rest, out);
  else
    problem.input_gradients(answer, s.z, rest, out);
  return stats;
}

}  // namespace diffsim
