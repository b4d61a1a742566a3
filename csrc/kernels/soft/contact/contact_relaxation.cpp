#include "kernels/soft/contact/contact_relaxation.h"

#include <cmath>

#include "kernels/soft/contact/contact_cone.h"
#include "kernels/soft/contact/contact_merit.h"

namespace diffsim {
namespace {

using Vec3 = Eigen::Vector3d;

// Friction from this share of Coulomb's limit on is that of slip.
constexpr double kConeEdge = 1.0 - 1e-9;
// The dense operator has (3 k)^2 entries: 160 MB for so many contacts.
constexpr std::size_t kMaxRelaxed = 1500;
// Relaxations of a resolution, and those that a factor of the tangent serves: an old one costs a
// tenth of a new one (ball that lands, 177k DoF: 0.2 for 2.0 s) and comes nearly as far.
constexpr int kMaxRelaxations = 32, kRelaxationsPerFactor = 4;
// Relaxations have settled where one is so short, of the longest of its resolution; after each
// cycle of a step, a tenth of that.
constexpr double kSettled = 0.1, kTighter = 0.1;
constexpr int kLooseResolutions = 2;  // of cycles; in later ones every relaxation has its factor
// Shortest step towards a relaxed solution, of the whole: ten trials.
constexpr double kLeastLength = 1e-3;

/// Moves x along `step` as far as lowers the merit.
/// @param lowers_merit  false: the step only has to reach where g is finite. The first step leads
///                      to the half spaces, which later ones do not leave: these are convex.
void move_relaxed(StepProblem& objective, const ContactSpace& space, const Vector& step,
                  const Vector& limits, bool lowers_merit, ContactIterate& at) {
  const Vector start = at.x;
  const double before = merit(space, limits, at.x, at.value);
  for (double length = 1.0; length > kLeastLength; length *= 0.5) {
    at.move(objective, start, length, step);
    if (std::isfinite(at.value) &&
        (!lowers_merit || merit(space, limits, at.x, at.value) <= before))
      return;
  }
}

/// W[3 i + b, 3 j + a] = H^-1 between contacts i and j, from the factor of H.
Eigen::MatrixXd inverse_between(StepProblem& problem, const ContactSpace& space,
                                const std::vector<std::size_t>& contacts) {
  std::vector<std::int64_t> nodes;
  for (const std::size_t k : contacts) nodes.push_back(static_cast<std::int64_t>(space.node(k)));
  const Eigen::Index size = static_cast<Eigen::Index>(3 * contacts.size());
  Eigen::MatrixXd W(size, size);  // symmetric: by rows and by columns the same
  problem.inverse_among(nodes, W.data());
  return W;
}

}  // namespace

void ContactRelaxation::remember(const ContactSpace& space) {
  for (std::size_t k = 0; k < space.size(); ++k)
    if (space.status[k] != ContactStatus::kSeparate) touched_[k] = true;
}

std::vector<std::size_t> ContactRelaxation::candidates(const ContactSpace& space,
                                                       const Vector& x) const {
  std::vector<std::size_t> near;
  for (std::size_t k = 0; k < space.size(); ++k)
    if (touched_[k] || space.status[k] != ContactStatus::kSeparate || space.gap(k, x) < 0.0)
      near.push_back(k);
  return near;
}

bool ContactRelaxation::resolve(ContactProblem& problem, bool cycled, ContactIterate& at) {
  StepProblem& objective = problem.objective;
  ContactSpace& space = problem.space;
  const std::vector<std::size_t> near = candidates(space, at.x);
  // Infinite friction may leave no answer to relax to; see kMaxReleases.
  const auto sticky = [&](std::size_t k) { return std::isinf(space.inputs().friction[k]); };
  if (near.size() > kMaxRelaxed || std::any_of(near.begin(), near.end(), sticky)) return false;
  const double settled = kSettled * std::pow(kTighter, num_cycles_);
  const int per_factor = num_cycles_ < kLooseResolutions ? kRelaxationsPerFactor : 1;
  if (cycled) ++num_cycles_;
  double longest = 0.0;
  for (int round = 0; round < kMaxRelaxations; ++round) {
    const std::vector<ContactStatus> before = space.status;
    if (round % per_factor == 0 && !linearize(objective, space, near, at.x)) return round > 0;
    Vector step = at.x, limits;
    if (!relax(objective, space, near, at.gradient, step, limits)) return round > 0;
    objective.ops().add(-1.0, at.x, step);
    const double length = objective.ops().norm(step);
    longest = std::max(longest, length);
    move_relaxed(objective, space, step, limits, round > 0, at);
    // Statuses also stay while a body buckles along its contacts, but then steps grow.
    if (space.status == before && length <= settled * longest) break;
  }
  problem.solve.statuses_changed();
  return true;
}

bool ContactRelaxation::linearize(StepProblem& problem, const ContactSpace& space,
                                  const std::vector<std::size_t>& contacts, const Vector& x) {
  problem.assemble(x, true);
  if (!problem.factorize_roughly()) return false;
  inverse_ = inverse_between(problem, space, contacts);
  return true;
}

bool ContactRelaxation::relax(StepProblem& problem, ContactSpace& space,
                              const std::vector<std::size_t>& contacts, const Vector& gradient,
                              Vector& x, Vector& limits) const {
  const ContactInputs& in = space.inputs();
  const Eigen::Index m = static_cast<Eigen::Index>(contacts.size());
  Vector step;
  problem.solve_factorized(gradient, step);
  Vector free = x;
  problem.ops().add(-1.0, step, free);

  ConeProblem dense(m);
  dense.W = inverse_;
  Eigen::VectorXd force = Eigen::VectorXd::Zero(3 * m);
  for (Eigen::Index j = 0; j < m; ++j) {
    const std::size_t k = contacts[static_cast<std::size_t>(j)];
    dense.normal.col(j) = Eigen::Map<const Vec3>(space.normal(k));
    dense.offset(j) = in.offset[k];
    dense.friction(j) = in.friction[k];
    for (std::size_t a = 0; a < 3; ++a)
      dense.free(3 * j + static_cast<Eigen::Index>(a)) =
          free[3 * space.node(k) + a] - in.reference[3 * k + a];
  }
  const bool settled = solve_cones(dense, force);
  Vector load(problem.size(), 0.0);
  std::fill(space.status.begin(), space.status.end(), ContactStatus::kSeparate);
  limits.assign(space.size(), 0.0);
  for (Eigen::Index j = 0; j < m; ++j) {
    const std::size_t k = contacts[static_cast<std::size_t>(j)];
    const Vec3 f = force.segment<3>(3 * j), n = Eigen::Map<const Vec3>(space.normal(k));
    for (std::size_t a = 0; a < 3; ++a)
      load[3 * space.node(k) + a] = f(static_cast<Eigen::Index>(a));
    if (f.isZero(0.0)) continue;
    const double pressing = n.dot(f);
    limits[k] = in.friction[k] * pressing;
    const bool slips = (f - pressing * n).norm() >= kConeEdge * limits[k];
    space.status[k] = slips ? ContactStatus::kSlip : ContactStatus::kStick;
  }
  problem.solve_factorized(load, step);
  x = free;
  problem.ops().add(1.0, step, x);
  return settled;
}

}  // namespace diffsim
