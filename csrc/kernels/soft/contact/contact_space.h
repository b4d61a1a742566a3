// The unknowns that contact leaves free, and the equations that it leaves standing.
//
// One contact per node: a half space normal . (x - reference) >= offset, where `reference` is the
// place that sticking would hold the node at (moved with the obstacle), so that x - reference is
// the slip displacement of the step. Its status decides what holds at the node, with contact force
// r = grad g [N], r_N = n . r, slip u = (I - n n^T)(x - reference), t = u / |u|:
//   separate   r = 0
//   stick      x = reference + offset n                         |r_T| <= mu r_N
//   slip       n . (x - reference) = offset,  r_T + mu r_N t = 0
// (thesis eq. 4.24 and, for slip, Coulomb's law in complementarity form.) With P the projection on
// what a node may still do (I, 0, or I - n n^T), a Newton step on these equations is
//   [P H + mu t (n . H) + D] q = -[P r + mu t (n . r)],   P q = q,   D = mu r_N / |u| (P - t t^T),
// whose transpose P H (I + mu n t^T) + D is the adjoint's system.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/rigid_multigrid.h"
#include "kernels/vector_ops.h"

namespace diffsim {

enum class ContactStatus : std::int64_t { kSeparate = 0, kStick = 1, kSlip = 2 };

// Largest stiffness of a slip's direction beside the node's own: keeps Newton's matrix in range
// where a node all but sticks.
constexpr double kMaxSlipStiffness = 1e6;

/// Contacts of one step; all arrays belong to the caller.
struct ContactInputs {
  std::int64_t num_contacts = 0;
  const std::int64_t* node = nullptr;   // (num_contacts,), no node twice, free on all axes
  const double* normal = nullptr;       // (num_contacts, 3), unit, out of the obstacle
  const double* reference = nullptr;    // (num_contacts, 3) [m]
  const double* offset = nullptr;       // (num_contacts,) [m]
  const double* friction = nullptr;     // (num_contacts,) [-]; infinity never slips
  const double* force_guess = nullptr;  // (num_contacts, 3) [N], zero where unknown
};

class ContactSpace {
 public:
  explicit ContactSpace(const ContactInputs& inputs)
      : in_(inputs),
        status(size(), ContactStatus::kSeparate),
        direction(3 * size(), 0.0),
        slip_stiffness(size(), 0.0) {}

  std::size_t size() const { return static_cast<std::size_t>(in_.num_contacts); }
  const ContactInputs& inputs() const { return in_; }
  const double* normal(std::size_t k) const { return in_.normal + 3 * k; }
  std::size_t node(std::size_t k) const { return static_cast<std::size_t>(in_.node[k]); }
  /// n . (x - reference) - offset [m].
  double gap(std::size_t k, const Vector& x) const;
  /// Slip displacement u [m]; returns |u|.
  double slip(std::size_t k, const Vector& x, double u[3]) const;
  /// What rounding leaves undetermined of the node's position [m].
  double rounding(std::size_t k, const Vector& x) const;
  /// n . r.
  double normal_part(std::size_t k, const Vector& r) const;

  std::size_t num_contacts() const;
  bool any_contact() const { return num_contacts() > 0; }
  bool any_slip() const;
  /// Whether the Newton matrix is not symmetric: some node slips with friction.
  bool any_sliding_friction() const;

  /// v <- P v.
  void project(Vector& v) const;
  /// r <- P r + mu t (n . r): what is left of a residual, the friction of slip included.
  void reduce(Vector& r) const;
  /// p <- p + mu (t . p) n, the transpose of `reduce` on the range of P.
  void expand(Vector& p) const;
  /// out += D v.
  void add_slip_stiffness(const Vector& v, Vector& out) const;
  /// Nodes in contact with P and D, for what preconditions.
  std::vector<HeldNode> held_nodes() const;
  /// One of them; on_rail: it may only move along t.
  HeldNode held_node(std::size_t k, bool on_rail) const;
  /// n x t, in the surface across the slip.
  void across_slip(std::size_t k, double across[3]) const;
  /// Whether the node may only move along t.
  bool on_rail(std::size_t k) const;
  /// The statuses of a step that was taken, with slip directions and stiffnesses of its answer x.
  /// @param[in] r          grad g at x [N]
  /// @param[in] stiffness  (num_nodes,) [N/m]
  void restore(const std::int64_t* taken, const Vector& x, const Vector& r,
               const double* stiffness);
  /// Displacement that puts x on the constraints: zero at all nodes but those in contact.
  void correction(const Vector& x, Vector& dx) const;

 private:
  const ContactInputs& in_;

 public:
  std::vector<ContactStatus> status;  // (num_contacts,)
  Vector direction;                   // (num_contacts, 3) t where slipping
  Vector slip_stiffness;              // (num_contacts,) mu r_N / |u| [N/m]; infinite: t is held
};

}  // namespace diffsim
