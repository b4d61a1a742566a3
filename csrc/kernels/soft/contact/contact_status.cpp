#include "kernels/soft/contact/contact_status.h"

namespace diffsim {
namespace {

// Infinite friction leaves cases without an answer: a node that is pulled off where it sticks, but
// let go slides into the obstacle. From its second release in a step it is held, pulled or not.
constexpr int kMaxReleases = 2;
// Friction of the last step from this share of Coulomb's limit on was that of slip.
constexpr double kSlipEdge = 1.0 - 1e-6;
// Slip that a division needs [m].
constexpr double kLeastSlip = 1e-300;

double norm3(const double* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

}  // namespace

/// A node without force sticks if stopping it along the surface takes less than mu times what
/// stopping it across takes.
ContactStatus ContactStatuses::first_touch(std::size_t k, double depth, double slip) const {
  const double friction = space_.inputs().friction[k];
  return friction > 0.0 && (std::isinf(friction) || slip <= friction * depth)
             ? ContactStatus::kStick
             : ContactStatus::kSlip;
}

void ContactStatuses::guess(const Vector& x_free) {
  const ContactInputs& in = space_.inputs();
  for (std::size_t k = 0; k < space_.size(); ++k) {
    const double* before = in.force_guess + 3 * k;
    const double* n = space_.normal(k);
    const double pressing = n[0] * before[0] + n[1] * before[1] + n[2] * before[2];
    const double depth = -space_.gap(k, x_free);
    double u[3];
    const double slip = space_.slip(k, x_free, u);
    space_.status[k] = ContactStatus::kSeparate;
    if (pressing > 0.0) {
      double along[3];
      for (int i = 0; i < 3; ++i) along[i] = before[i] - pressing * n[i];
      const double friction = norm3(along);
      const bool slipped = friction >= kSlipEdge * in.friction[k] * pressing;
      space_.status[k] = slipped ? ContactStatus::kSlip : ContactStatus::kStick;
    } else if (depth > 0.0) {
      space_.status[k] = first_touch(k, depth, slip);
    }
    if (space_.status[k] == ContactStatus::kSlip && slip > 0.0)
      for (std::size_t i = 0; i < 3; ++i) space_.direction[3 * k + i] = u[i] / slip;
  }
}

void ContactStatuses::begin() {
  std::fill(releases_.begin(), releases_.end(), 0);
  cautious_ = unresolved_ = false;
  seen_.clear();
  remember();
}

std::size_t ContactStatuses::num_let_go(const Vector& x, const Vector& r) const {
  std::size_t count = 0;
  for (std::size_t k = 0; k < space_.size(); ++k)
    count += space_.status[k] != ContactStatus::kSeparate &&
             propose(k, x, r).status == ContactStatus::kSeparate;
  return count;
}

ContactStatuses::Proposal ContactStatuses::propose(std::size_t k, const Vector& x,
                                                   const Vector& r) const {
  const ContactStatus now = space_.status[k];
  const double stiffness = stiffness_[space_.node(k)];
  const double gap = space_.gap(k, x);
  double u[3];
  const double slip = space_.slip(k, x, u);
  if (now == ContactStatus::kSeparate) {
    if (gap >= -length_tolerance_ - force_tolerance_ / stiffness) return {now, 0.0};
    return {first_touch(k, -gap, slip), -stiffness * gap};
  }
  const double pressing = space_.normal_part(k, r);
  const double friction = space_.inputs().friction[k];
  if (std::isinf(friction) && releases_[k] >= kMaxReleases) return {now, 0.0};
  if (pressing < -force_tolerance_) return {ContactStatus::kSeparate, -pressing};
  if (std::isinf(friction)) return {now, 0.0};
  const double limit = friction * std::max(pressing, 0.0);
  double trial[3];
  for (std::size_t i = 0; i < 3; ++i)
    trial[i] = r[3 * space_.node(k) + i] - pressing * space_.normal(k)[i] - stiffness * u[i];
  const double force = norm3(trial);
  if (now == ContactStatus::kStick && force > limit + force_tolerance_)
    return {ContactStatus::kSlip, force - limit};
  if (now == ContactStatus::kSlip && friction > 0.0 && force < limit - force_tolerance_)
    return {ContactStatus::kStick, limit - force};
  return {now, 0.0};
}

void ContactStatuses::take(std::size_t k, ContactStatus status) {
  if (status == ContactStatus::kSeparate) ++releases_[k];
  space_.status[k] = status;
}

bool ContactStatuses::update(const Vector& x, const Vector& r) {
  std::size_t worst = space_.size();
  double violation = 0.0;
  bool changed = false;
  for (std::size_t k = 0; k < space_.size(); ++k) {
    const Proposal proposal = propose(k, x, r);
    if (proposal.status == space_.status[k]) continue;
    changed = true;
    if (!cautious_) {
      take(k, proposal.status);
    } else if (proposal.violation > violation) {
      violation = proposal.violation;
      worst = k;
    }
  }
  if (cautious_ && worst < space_.size()) take(worst, propose(worst, x, r).status);
  if (changed) {
    ++num_changes_;
    remember();
  }
  return changed;
}

bool ContactStatuses::stop_reversed(const Vector& x, const Vector& q) {
  bool changed = false;
  for (std::size_t k = 0; k < space_.size(); ++k) {
    if (space_.status[k] != ContactStatus::kSlip || !(space_.inputs().friction[k] > 0.0)) continue;
    const double* t = space_.direction.data() + 3 * k;
    double u[3], before = 0.0, step = 0.0;
    space_.slip(k, x, u);
    for (std::size_t i = 0; i < 3; ++i) {
      before += t[i] * u[i];
      step += t[i] * q[3 * space_.node(k) + i];
    }
    if (step >= 0.0 || before + step >= 0.0) continue;
    space_.status[k] = ContactStatus::kStick;
    space_.slip_stiffness[k] = 0.0;
    changed = true;
  }
  if (changed) {
    ++num_changes_;
    remember();
  }
  return changed;
}

void ContactStatuses::remember() {
  if (seen_.insert(space_.status).second) return;
  ++num_cycles_;
  unresolved_ = cautious_;
  cautious_ = true;
  seen_.clear();
  seen_.insert(space_.status);
}

bool ContactStatuses::needs_resolution() {
  const bool needed = unresolved_;
  unresolved_ = false;
  return needed;
}

void ContactStatuses::update_slip(const Vector& x, const Vector& r) {
  for (std::size_t k = 0; k < space_.size(); ++k) {
    space_.slip_stiffness[k] = 0.0;
    if (space_.status[k] != ContactStatus::kSlip) continue;
    const double stiffness = stiffness_[space_.node(k)];
    const double pressing = space_.normal_part(k, r);
    double u[3];
    const double slip = space_.slip(k, x, u);
    double* t = space_.direction.data() + 3 * k;
    const double limit = space_.inputs().friction[k] * std::max(pressing, 0.0);
    // A slip of a few roundings of x has no direction that friction could be computed from.
    const bool vague = slip * force_tolerance_ <= limit * space_.rounding(k, x);
    if (slip > length_tolerance_ && !vague) {
      for (int i = 0; i < 3; ++i) t[i] = u[i] / slip;
    } else {  // about to slip: against the force that holds it
      double against[3];
      for (std::size_t i = 0; i < 3; ++i)
        against[i] = pressing * space_.normal(k)[i] - r[3 * space_.node(k) + i];
      if (!vague || norm3(against) == 0.0)
        for (int i = 0; i < 3; ++i) against[i] += stiffness * u[i];
      const double force = norm3(against);
      if (force > 0.0)
        for (int i = 0; i < 3; ++i) t[i] = against[i] / force;
    }
    if (limit > 0.0)
      space_.slip_stiffness[k] =
          std::min(limit / std::max(slip, kLeastSlip), kMaxSlipStiffness * stiffness);
  }
}

}  // namespace diffsim
