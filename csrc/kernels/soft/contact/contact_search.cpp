#include "kernels/soft/contact/contact_search.h"

#include "kernels/soft/contact/contact_merit.h"
#include "kernels/soft/descent.h"

namespace diffsim {
namespace {

// A whole step that cuts the residual to this is taken without a look at the point on the
// constraints that it starts from: an evaluation less in most steps.
constexpr double kWholeStepResidual = 0.3;
// Shortest step towards a smaller residual, of the direction: the fifth trial.
constexpr double kLeastResidualStep = 0.05;
// Shortest step, of the direction: the thirtieth trial.
constexpr double kLeastStep = 1e-9;

/// Takes the whole step, onto the constraints and along the direction, if it cuts the residual.
bool take_whole_step(ContactProblem& p, const ContactDirection& d, const Vector& start,
                     ContactIterate& at) {
  at.move(p.objective, start, 1.0, d.within);
  return std::isfinite(at.value) && p.reduced_norm(at.gradient) <= kWholeStepResidual * d.rhs_norm;
}

/// Halves the step until the residual falls; false, and back at the start, where none does.
/// Coulomb's friction has no potential: as normal forces change within a step, Newton's direction
/// may lead up the merit, which holds them, and yet to the answer.
/// @param start  on the constraints, where `at` is
bool lower_residual(ContactProblem& p, const ContactDirection& d, const Vector& start,
                    ContactIterate& at) {
  const double before = p.reduced_norm(at.gradient);
  for (double step = 1.0; step > kLeastResidualStep; step *= 0.5) {
    at.move(p.objective, start, step, d.within);
    p.statuses.update_slip(at.x, at.gradient);
    if (std::isfinite(at.value) && p.reduced_norm(at.gradient) <= (1.0 - kArmijo * step) * before)
      return true;
  }
  at.x = start;
  at.evaluate(p.objective);
  p.statuses.update_slip(at.x, at.gradient);
  return false;
}

/// Halves the step until the merit falls, or its slope where rounding hides that; false where none
/// does. Slip directions turn along the step, and the slope with them: held, they would hide what
/// friction resists a turn with, which is most of the slope where a stiff body all but sticks.
/// @param start  on the constraints
bool backtrack(ContactProblem& p, const ContactDirection& d, const Vector& limits,
               const Vector& start, double slope, ContactIterate& at) {
  const double before = merit(p.space, limits, start, at.value);
  const double rounding = kEnergyRounding * p.objective.magnitude();
  const double flat =
      kFlatEnergy * p.objective.magnitude() + dissipation_rounding(p.space, limits, start);
  for (double step = 1.0; step > kLeastStep; step *= 0.5) {
    at.move(p.objective, start, step, d.within);
    const double after = merit(p.space, limits, at.x, at.value);
    if (!std::isfinite(after)) continue;
    if (after <= before + kArmijo * step * std::min(slope, 0.0) + rounding) return true;
    p.statuses.update_slip(at.x, at.gradient);
    if (after <= before + flat && std::abs(merit_slope(p.objective, p.space, limits, at.gradient,
                                                       d.within)) <= kWolfe * std::abs(slope))
      return true;
  }
  return false;
}

/// Where nothing descends the statuses are not those of an answer. A whole step on a clamped H
/// changes them; without one, the next iteration clamps.
void move_anyway(ContactProblem& p, const ContactDirection& d, const Vector& start,
                 ContactIterate& at) {
  at.x = start;
  if (d.is_clamped) p.objective.ops().add(1.0, d.within, at.x);
  at.evaluate(p.objective);
  if (std::isfinite(at.value)) return;
  at.x = start;
  at.evaluate(p.objective);
}

}  // namespace

SearchResult search_along(ContactProblem& problem, const ContactDirection& direction, bool is_loose,
                          ContactIterate& at) {
  const ContactDirection& d = direction;
  StepProblem& objective = problem.objective;
  const bool slides = problem.space.any_sliding_friction();
  Vector limits(problem.space.size(), 0.0);
  if (slides) {
    Vector step = d.onto;
    objective.ops().add(1.0, d.within, step);
    limits = friction_limits(objective, problem.space, at.gradient, step);
  }
  Vector start = at.x;
  if (d.is_corrected) {
    objective.ops().add(1.0, d.onto, start);
    if (!d.is_clamped && !slides && take_whole_step(problem, d, start, at))
      return SearchResult::kDescended;
    at.value = objective.value_gradient(start, at.gradient);
  }
  const double slope = merit_slope(objective, problem.space, limits, at.gradient, d.within);
  if (slope > 0.0 && is_loose && slides) {
    if (d.is_corrected) at.evaluate(objective);
    return SearchResult::kAscends;
  }
  if (slope > 0.0 && slides && lower_residual(problem, d, start, at))
    return SearchResult::kDescended;
  if (backtrack(problem, d, limits, start, slope, at)) return SearchResult::kDescended;
  move_anyway(problem, d, start, at);
  return SearchResult::kFailed;
}

}  // namespace diffsim
