#include "kernels/soft/step_search.h"

#include "kernels/soft/descent.h"

namespace diffsim {
namespace {

// A line search gives up after so many trials, and extends a full step by so many doublings while
// the slope there is at least this of the first.
constexpr int kMaxTrials = 30, kMaxDoublings = 10;
constexpr double kSteep = 0.5;

/// Takes longer and longer steps along d while the energy falls about as steeply as at its start.
/// Directions on a clamped Hessian are far too short where a body buckles: it is stiffer than the
/// energy, and full steps would leave a saddle by a fifth more each.
void extend(StepProblem& problem, const Vector& d, double slope, const Vector& start, Vector& x,
            double& value, Vector& gradient) {
  Vector farther, gradient_there;
  double step = 1.0;
  for (int k = 0; k < kMaxDoublings && problem.ops().dot(gradient, d) < kSteep * slope; ++k) {
    step *= 2.0;
    farther = start;
    problem.ops().add(step, d, farther);
    const double value_there = problem.value_gradient(farther, gradient_there);
    const double added = 0.5 * step;
    if (!(value_there < value + kArmijo * added * slope)) {
      value = problem.value_gradient(x, gradient);  // what the problem remembers is that of x again
      return;
    }
    x.swap(farther);
    gradient.swap(gradient_there);
    value = value_there;
  }
}

}  // namespace

StepStats begin_stats(StepProblem& problem, const StepOptions& options, const Vector& gradient,
                      double rounding) {
  StepStats stats;
  stats.residual_norm = problem.ops().norm(gradient);
  // A static problem without load has no force scale of its own: measure from the start, which may
  // be rounding already.
  const bool unloaded = !(problem.scale() > 0.0);
  stats.scale = unloaded ? stats.residual_norm : problem.scale();
  stats.tolerance = options.rtol * stats.scale + options.atol;
  if (unloaded) stats.tolerance = std::max(stats.tolerance, rounding);
  return stats;
}

bool line_search(StepProblem& problem, const Vector& d, double slope, Vector& x, double& value,
                 Vector& gradient) {
  const Vector start = x;
  const double start_value = value;
  const double rounding = kEnergyRounding * problem.magnitude();
  double step = 1.0;
  for (int trial = 0; trial < kMaxTrials; ++trial, step *= 0.5) {
    x = start;
    problem.ops().add(step, d, x);
    value = problem.value_gradient(x, gradient);
    if (!std::isfinite(value)) continue;  // beyond the reach of the energy: inverted, or overflow
    if (value <= start_value + kArmijo * step * slope + rounding) {
      if (step == 1.0) extend(problem, d, slope, start, x, value, gradient);
      return true;
    }
    if (value <= start_value + kFlatEnergy * problem.magnitude() &&
        std::abs(problem.ops().dot(gradient, d)) <= -kWolfe * slope)
      return true;
  }
  x = start;
  value = problem.value_gradient(x, gradient);
  return false;
}

}  // namespace diffsim
