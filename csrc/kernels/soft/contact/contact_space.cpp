#include "kernels/soft/contact/contact_space.h"

#include <limits>

namespace diffsim {
namespace {

// Roundings of its largest coordinate that leave a node's position undetermined.
constexpr double kRoundings = 4.0;

double dot3(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/// v <- (I - n n^T) v.
void tangential(const double* n, double* v) {
  const double along = dot3(n, v);
  for (int i = 0; i < 3; ++i) v[i] -= along * n[i];
}

/// v <- t t^T v.
void along_direction(const double* t, double* v) {
  const double along = dot3(t, v);
  for (int i = 0; i < 3; ++i) v[i] = along * t[i];
}

}  // namespace

double ContactSpace::gap(std::size_t k, const Vector& x) const {
  double total = -in_.offset[k];
  for (std::size_t i = 0; i < 3; ++i)
    total += normal(k)[i] * (x[3 * node(k) + i] - in_.reference[3 * k + i]);
  return total;
}

double ContactSpace::slip(std::size_t k, const Vector& x, double u[3]) const {
  for (std::size_t i = 0; i < 3; ++i) u[i] = x[3 * node(k) + i] - in_.reference[3 * k + i];
  tangential(normal(k), u);
  return std::sqrt(dot3(u, u));
}

double ContactSpace::rounding(std::size_t k, const Vector& x) const {
  double largest = 0.0;
  for (std::size_t i = 0; i < 3; ++i) largest = std::max(largest, std::abs(x[3 * node(k) + i]));
  return kRoundings * std::numeric_limits<double>::epsilon() * largest;
}

double ContactSpace::normal_part(std::size_t k, const Vector& r) const {
  return dot3(normal(k), r.data() + 3 * node(k));
}

std::size_t ContactSpace::num_contacts() const {
  return size() - static_cast<std::size_t>(
                      std::count(status.begin(), status.end(), ContactStatus::kSeparate));
}

bool ContactSpace::any_slip() const {
  return std::find(status.begin(), status.end(), ContactStatus::kSlip) != status.end();
}

bool ContactSpace::any_sliding_friction() const {
  for (std::size_t k = 0; k < size(); ++k)
    if (status[k] == ContactStatus::kSlip && in_.friction[k] > 0.0) return true;
  return false;
}

bool ContactSpace::on_rail(std::size_t k) const {
  return status[k] == ContactStatus::kSlip && std::isinf(slip_stiffness[k]);
}

void ContactSpace::project(Vector& v) const {
  for (std::size_t k = 0; k < size(); ++k) {
    double* at = v.data() + 3 * node(k);
    if (status[k] == ContactStatus::kStick)
      std::fill(at, at + 3, 0.0);
    else if (on_rail(k))
      along_direction(direction.data() + 3 * k, at);
    else if (status[k] == ContactStatus::kSlip)
      tangential(normal(k), at);
  }
}

void ContactSpace::reduce(Vector& r) const {
  for (std::size_t k = 0; k < size(); ++k) {
    double* at = r.data() + 3 * node(k);
    if (status[k] == ContactStatus::kStick) {
      std::fill(at, at + 3, 0.0);
    } else if (status[k] == ContactStatus::kSlip) {
      const double friction = in_.friction[k] * dot3(normal(k), at);
      tangential(normal(k), at);
      if (on_rail(k)) along_direction(direction.data() + 3 * k, at);
      for (std::size_t i = 0; i < 3; ++i) at[i] += friction * direction[3 * k + i];
    }
  }
}

void ContactSpace::expand(Vector& p) const {
  for (std::size_t k = 0; k < size(); ++k) {
    if (status[k] != ContactStatus::kSlip) continue;
    double* at = p.data() + 3 * node(k);
    const double along = in_.friction[k] * dot3(direction.data() + 3 * k, at);
    for (int i = 0; i < 3; ++i) at[i] += along * normal(k)[i];
  }
}

void ContactSpace::add_slip_stiffness(const Vector& v, Vector& out) const {
  for (std::size_t k = 0; k < size(); ++k) {
    if (status[k] != ContactStatus::kSlip || slip_stiffness[k] == 0.0 || on_rail(k)) continue;
    const double* t = direction.data() + 3 * k;
    double across[3];
    std::copy_n(v.data() + 3 * node(k), 3, across);
    tangential(normal(k), across);
    tangential(t, across);
    for (std::size_t i = 0; i < 3; ++i) out[3 * node(k) + i] += slip_stiffness[k] * across[i];
  }
}

std::vector<HeldNode> ContactSpace::held_nodes() const {
  std::vector<HeldNode> held;
  for (std::size_t k = 0; k < size(); ++k) {
    if (status[k] != ContactStatus::kSeparate) held.push_back(held_node(k, on_rail(k)));
  }
  return held;
}

HeldNode ContactSpace::held_node(std::size_t k, bool on_rail) const {
  HeldNode h{in_.node[k], {}, {}};
  const double* n = normal(k);
  const double* t = direction.data() + 3 * k;
  for (int i = 0; i < 9 && status[k] == ContactStatus::kSlip; ++i) {
    const double along = t[i / 3] * t[i % 3];
    h.free[i] = on_rail ? along : (i % 4 == 0) - n[i / 3] * n[i % 3];
    if (!on_rail && slip_stiffness[k] > 0.0)
      h.stiffness[i] = slip_stiffness[k] * (h.free[i] - along);
  }
  return h;
}

void ContactSpace::across_slip(std::size_t k, double across[3]) const {
  const double* n = normal(k);
  const double* t = direction.data() + 3 * k;
  for (int i = 0; i < 3; ++i) {
    const int p = (i + 1) % 3, q = (i + 2) % 3;
    across[i] = n[p] * t[q] - n[q] * t[p];
  }
}

void ContactSpace::restore(const std::int64_t* taken, const Vector& x, const Vector& r,
                           const double* stiffness) {
  for (std::size_t k = 0; k < size(); ++k) {
    status[k] = static_cast<ContactStatus>(taken[k]);
    if (status[k] != ContactStatus::kSlip) continue;
    double u[3];
    const double length = slip(k, x, u);
    const double friction = in_.friction[k];
    if (friction == 0.0) continue;
    if (length <= rounding(k, x)) {  // on the verge of slipping: the sticking side's derivative
      status[k] = ContactStatus::kStick;
      continue;
    }
    for (std::size_t i = 0; i < 3; ++i) direction[3 * k + i] = u[i] / length;
    slip_stiffness[k] = friction * std::max(0.0, normal_part(k, r)) / length;
    if (slip_stiffness[k] > kMaxSlipStiffness * stiffness[node(k)])
      slip_stiffness[k] = std::numeric_limits<double>::infinity();
  }
}

void ContactSpace::correction(const Vector& x, Vector& dx) const {
  dx.assign(x.size(), 0.0);
  for (std::size_t k = 0; k < size(); ++k) {
    if (status[k] == ContactStatus::kSeparate) continue;
    const double depth = -gap(k, x);
    double u[3] = {0.0, 0.0, 0.0};
    if (status[k] == ContactStatus::kStick) slip(k, x, u);
    for (std::size_t i = 0; i < 3; ++i) dx[3 * node(k) + i] = depth * normal(k)[i] - u[i];
  }
}

}  // namespace diffsim
