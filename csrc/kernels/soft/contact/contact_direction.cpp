#include "kernels/soft/contact/contact_direction.h"

namespace diffsim {
namespace {

// Directions on changed statuses, where friction pushes nodes backwards.
constexpr int kMaxReversals = 5;
// Largest residual of the linear system, of its right-hand side, however little would be enough,
// and however little could be reached: clamping H would trade Newton's convergence for nothing.
constexpr double kLargestResidual = 0.5;
// Of one linear solve. What needs more gets a factor of the tangent, where the method allows one.
constexpr std::size_t kMaxKrylovIterations = 2000;

/// q of ContactSolve::solve, with its first guess; one on which iterations do not converge gets a
/// factor of the tangent, where the method allows one, and goes on from where they ended. A tangent
/// that is not positive definite is clamped: conjugate gradients meet its negative curvature, GMRES
/// stalls far from the answer. It is not factored where GMRES met negative curvature, too.
/// @return whether H is clamped now
bool solve_linear(ContactProblem& p, const Vector& x, const Vector& rhs, double tolerance,
                  bool is_clamped, bool is_guess, Vector& q) {
  const int limit =
      static_cast<int>(std::min<std::size_t>(p.objective.size(), kMaxKrylovIterations));
  const bool may_factor = p.options.method == StepMethod::kAuto;
  const auto solve_factored = [&] {
    p.solve.use_tangent();
    p.solve.statuses_changed();
    return p.solve.solve(rhs, tolerance, limit, true, q);
  };
  KrylovResult result = p.solve.solve(rhs, tolerance, limit, is_guess, q);
  if (!result.converged && !result.negative_curvature && may_factor) result = solve_factored();
  // Conjugate gradients end at negative curvature, GMRES may go on to an answer.
  const bool has_ended = result.negative_curvature && !p.space.any_sliding_friction();
  const bool is_usable =
      !has_ended && result.residual_norm <= kLargestResidual * p.objective.ops().norm(rhs);
  if (!result.converged && !is_usable && !is_clamped) {
    is_clamped = true;
    p.objective.assemble(x, true);
    p.solve.matrix_changed(true);
    result = p.solve.solve(rhs, tolerance, limit, true, q);
  }
  if (!result.converged && !is_usable && may_factor) solve_factored();
  return is_clamped;
}

/// The direction on the statuses as they are; the one before is where the linear solve begins.
void solve_on_statuses(ContactProblem& p, const ContactIterate& at,
                       const DirectionAccuracy& accuracy, ContactDirection& d) {
  const bool is_guess = !d.within.empty();
  if (is_guess) {
    p.objective.ops().add(1.0, d.onto, d.within);
    p.space.project(d.within);
  }
  Vector rhs;
  p.space.correction(at.x, d.onto);
  p.objective.multiply(d.onto, rhs);
  for (std::size_t i = 0; i < rhs.size(); ++i) rhs[i] = -(rhs[i] + at.gradient[i]);
  p.space.reduce(rhs);
  d.rhs_norm = p.objective.ops().norm(rhs);
  const double enough = std::min(kLargestResidual * d.rhs_norm, accuracy.enough);
  d.is_clamped = solve_linear(p, at.x, rhs, std::max(accuracy.forcing * d.rhs_norm, enough),
                              d.is_clamped, is_guess, d.within);
}

}  // namespace

ContactDirection contact_direction(ContactProblem& problem, const ContactIterate& at,
                                   const DirectionAccuracy& accuracy, ContactDirection before) {
  ContactDirection d = std::move(before);
  for (int trial = 0; trial < kMaxReversals; ++trial) {
    solve_on_statuses(problem, at, accuracy, d);
    if (!problem.statuses.stop_reversed(at.x, d.within)) break;
    problem.solve.contacts_stopped();
  }
  d.is_corrected = std::any_of(d.onto.begin(), d.onto.end(), [](double v) { return v != 0.0; });
  return d;
}

}  // namespace diffsim
