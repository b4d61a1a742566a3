#include "kernels/soft/lane_steps.h"

#include <algorithm>

#include "kernels/soft/lane_solver.h"
#include "kernels/soft/linear_step.h"
#include "kernels/soft/step_search.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
// Iterations on a factor that cost about as much as a new one: where more seem to be left, at the
// rate of the last, a new one is made.
constexpr double kWorthFactor = 6.0;
// Factors of one step, after which it is left to the solver of single bodies.
constexpr int kMostFactors = 4;

/// One step on its way.
struct Member {
  Member(const ConstantSystem& system, const StepInputs& inputs, const StepOptions& options,
         ThreadPool& pool)
      : in(inputs), problem(system, in, pool), quasi_newton(problem) {
    x.assign(in.guess, in.guess + problem.size());
    for (std::size_t i = 0; i < x.size(); ++i)
      if (system.fixed()[i]) x[i] = in.target[i];
    value = problem.value_gradient(x, gradient);
    rounding = system.rounding_floor(x);
    stats = begin_stats(problem, options, gradient, rounding);
    is_left = !std::isfinite(value);
    check();
  }

  void check() { stats.converged = stats.residual_norm <= stats.tolerance ? 1.0 : 0.0; }
  bool is_active() const { return !is_left && !is_spent && stats.converged == 0.0; }

  /// Moves along d, which solves on the factor; leaves where that does not lower the energy.
  void advance(int max_iters) {
    const double slope = problem.ops().dot(d, gradient), last = stats.residual_norm;
    x_old = x, g_old = gradient;
    const bool descended = slope < 0.0 && line_search(problem, d, slope, x, value, gradient);
    if (!descended) {
      is_left = true;
      return;
    }
    quasi_newton.update(x_old, g_old, x, gradient);
    stats.residual_norm = problem.ops().norm(gradient);
    stats.num_iters += 1.0;
    check();
    const double rate = std::log(stats.residual_norm / last);
    wants_factor = !(std::log(stats.tolerance / stats.residual_norm) > kWorthFactor * rate);
    is_spent = stats.num_iters >= max_iters;
  }

  StepInputs in;
  StepProblem problem;
  QuasiNewton quasi_newton;
  Vector x, gradient, d, x_old, g_old;
  StepStats stats;
  double value = 0.0, rounding = 0.0;
  bool is_left = false;   // to the solver of single bodies
  bool is_spent = false;  // has taken all iterations that it may
  bool wants_factor = true;
};

/// Factors anew for the members that want it.
void refactor(std::vector<std::unique_ptr<Member>>& members, LaneSolver& lanes) {
  const auto wants = [](const Member& m) { return m.is_active() && m.wants_factor; };
  std::vector<LanePoint> points(members.size());
  for (std::size_t l = 0; l < members.size(); ++l) {
    Member& m = *members[l];
    if (!wants(m)) continue;
    if (m.stats.num_factorizations >= kMostFactors) {
      m.is_left = true;
      continue;
    }
    if (m.stats.num_factorizations > 0.0) lanes.clear(static_cast<int>(l));
    points[l] = {&m.problem, &m.x};
  }
  const auto is_asked = [](const LanePoint& point) { return point.problem != nullptr; };
  if (std::none_of(points.begin(), points.end(), is_asked)) return;
  lanes.assemble(points);
  const unsigned definite = lanes.factor();
  for (std::size_t l = 0; l < members.size(); ++l) {
    Member& m = *members[l];
    if (!wants(m)) continue;
    m.stats.num_factorizations += 1.0;
    m.is_left = !(definite >> l & 1u);
    m.wants_factor = false;
    m.quasi_newton.forget();
  }
}

void note_lane(const LaneSystem& solved, StepStats& stats) {
  stats.residual_norm = solved.result.residual_norm;
  stats.num_iters = solved.result.num_iters;
  stats.num_factorizations = 1.0;
  stats.converged = 1.0;
}

}  // namespace

bool steps_in_lanes(const ConstantSystem& system, const StepOptions& options) {
  if (options.method == StepMethod::kLinearlyImplicit) return adjoints_in_lanes(system, options);
  return options.method == StepMethod::kAuto && system.plan().factorize_step(options.rtol) &&
         system.pattern().lanes();
}

bool adjoints_in_lanes(const ConstantSystem& system, const StepOptions& options) {
  const bool by_choice =
      options.method == StepMethod::kAuto || options.method == StepMethod::kLinearlyImplicit;
  return by_choice && system.plan().factorize_adjoint(options.rtol) && system.pattern().lanes();
}

void lane_steps(const ConstantSystem& system, const StepInputs& inputs, const StepOptions& options,
                Index first, int count, double* x, StepStats* stats, ThreadPool& pool) {
  const Index size = 3 * system.model().num_nodes;
  LaneSolver lanes(system);
  std::vector<std::unique_ptr<Member>> members;
  for (int l = 0; l < count; ++l)
    members.push_back(std::make_unique<Member>(
        system, batch_item(inputs, system.model(), first + l), options, pool));
  const auto is_active = [](const std::unique_ptr<Member>& m) { return m->is_active(); };
  while (std::any_of(members.begin(), members.end(), is_active)) {
    refactor(members, lanes);
    for (int l = 0; l < count; ++l) {
      Member& m = *members[static_cast<std::size_t>(l)];
      m.d = m.gradient;
      if (m.is_active()) m.quasi_newton.begin(m.d);
      lanes.put(m.d, l);
    }
    lanes.solve();
    for (int l = 0; l < count; ++l) {
      Member& m = *members[static_cast<std::size_t>(l)];
      if (!m.is_active()) continue;
      lanes.get(l, m.d);
      m.quasi_newton.finish(m.d);
      m.advance(options.max_iters);
    }
  }
  for (int l = 0; l < count; ++l) {
    Member& m = *members[static_cast<std::size_t>(l)];
    double* out = x + (first + l) * size;
    StepStats& found = stats[first + l];
    m.stats.energy = m.problem.elastic_energy();
    std::copy(m.x.begin(), m.x.end(), out);
    found = m.stats;
    if (!m.is_left) continue;
    // From here on as a single body, from where it is; a start that was not finite from its guess.
    StepInputs rest = m.in;
    if (std::isfinite(m.value)) rest.guess = m.x.data();
    found = implicit_step(system, rest, options, out, pool);
    found.num_iters += m.stats.num_iters;
    found.num_factorizations += m.stats.num_factorizations;
  }
}

void lane_linear_steps(const ConstantSystem& system, const StepInputs& inputs,
                       const StepOptions& options, Index first, int count, double* x,
                       StepStats* stats, ThreadPool& pool) {
  const SoftModel& model = system.model();
  const std::size_t many = static_cast<std::size_t>(count);
  LaneSolver lanes(system);
  VectorOps ops(pool);
  std::vector<StepInputs> in;
  std::vector<std::unique_ptr<StepProblem>> problems;
  std::vector<LinearProblem> linear;
  for (int l = 0; l < count; ++l) in.push_back(batch_item(inputs, model, first + l));
  for (std::size_t l = 0; l < many; ++l) {
    problems.push_back(std::make_unique<StepProblem>(system, in[l], pool));
    linear.emplace_back(system, *problems[l], in[l]);
    lanes.put(linear[l].moved, static_cast<int>(l));
  }
  std::vector<LanePoint> points(many);
  for (std::size_t l = 0; l < many; ++l) points[l] = {problems[l].get(), &linear[l].q};
  lanes.assemble(points);
  const unsigned definite = lanes.factor();
  if (std::any_of(linear.begin(), linear.end(), [](const auto& p) { return p.is_pushed; }))
    lanes.multiply();
  std::vector<LaneSystem> systems(many);
  for (std::size_t l = 0; l < many; ++l) {
    Vector pushed;
    if (linear[l].is_pushed) {
      lanes.get_product(static_cast<int>(l), pushed);
      linear[l].push(*problems[l], pushed);
    }
    systems[l].b = linear[l].b;
    stats[first + static_cast<Index>(l)] = linear[l].begin_stats(*problems[l], options);
    systems[l].tolerance = stats[first + static_cast<Index>(l)].tolerance;
  }
  lanes.solve_refined(systems, definite, ops);
  for (std::size_t l = 0; l < many; ++l) {
    const Index k = first + static_cast<Index>(l);
    double* out = x + 3 * k * model.num_nodes;
    if (systems[l].result.converged) {
      linear[l].finish(systems[l].z, out);
      note_lane(systems[l], stats[k]);
    } else {
      stats[k] = linear_step(system, in[l], options, out, pool);
      stats[k].num_factorizations += 1.0;
    }
  }
}

void lane_adjoints(const ConstantSystem& system, const StepInputs& inputs,
                   const StepOptions& options, Index first, int count, const double* x,
                   const double* grad_x, const StepAdjoint& out, StepStats* stats,
                   ThreadPool& pool) {
  const SoftModel& model = system.model();
  const Index size = 3 * model.num_nodes;
  const std::size_t many = static_cast<std::size_t>(count);
  const bool by_linear = options.method == StepMethod::kLinearlyImplicit;
  LaneSolver lanes(system);
  std::vector<StepInputs> in;
  for (int l = 0; l < count; ++l) in.push_back(batch_item(inputs, model, first + l));
  std::vector<std::unique_ptr<StepProblem>> problems;
  std::vector<Vector> answers(many), starts(many);
  std::vector<LaneSystem> systems(many);
  std::vector<LanePoint> points(many);
  VectorOps ops(pool);
  for (std::size_t l = 0; l < many; ++l) {
    const Index at = (first + static_cast<Index>(l)) * size;
    answers[l].assign(x + at, x + at + size);
    problems.push_back(std::make_unique<StepProblem>(system, in[l], pool));
    if (by_linear) starts[l].assign(in[l].guess, in[l].guess + size);
    points[l] = {problems[l].get(), by_linear ? &starts[l] : &answers[l]};
    systems[l].b.assign(grad_x + at, grad_x + at + size);
    problems[l]->zero_fixed(systems[l].b);
    systems[l].tolerance = options.rtol * ops.norm(systems[l].b) + options.atol;
  }
  lanes.assemble(points);
  lanes.solve_refined(systems, lanes.factor(), ops);
  for (std::size_t l = 0; l < many; ++l) {
    const Index k = first + static_cast<Index>(l), at = k * size;
    const LaneSystem& s = systems[l];
    const StepAdjoint item = batch_item(out, model, k);
    if (!s.result.converged) {
      const auto adjoint = by_linear ? linear_step_adjoint : implicit_step_adjoint;
      stats[k] = adjoint(system, in[l], options, x + at, grad_x + at, item, pool);
      stats[k].num_factorizations += 1.0;
      continue;
    }
    stats[k] = {};
    stats[k].scale = ops.norm(s.b);
    stats[k].tolerance = s.tolerance;
    note_lane(s, stats[k]);
    Vector rest(grad_x + at, grad_x + at + size);
    ops.add(-1.0, s.product, rest);
    if (by_linear)
      problems[l]->linear_input_gradients(answers[l], s.z, rest, item);
    else
      problems[l]->input_gradients(answers[l], s.z, rest, item);
  }
}

}  // namespace diffsim
