// Which contacts separate, stick or slip, decided from positions and forces.
#pragma once

#include <set>

#include "kernels/soft/contact/contact_space.h"

namespace diffsim {

class ContactStatuses {
 public:
  /// @param[in] stiffness  (num_nodes,) [N/m], weighs displacements against forces
  ContactStatuses(ContactSpace& space, const double* stiffness)
      : space_(space), stiffness_(stiffness), releases_(space.size(), 0) {}

  /// Smallest force and length that count [N], [m].
  void set_tolerances(double force, double length) {
    force_tolerance_ = force;
    length_tolerance_ = length;
  }
  /// First guess, from last step's forces and where the nodes would go without contact.
  void guess(const Vector& x_free);
  /// Forgets statuses met: a step begins with those that it has.
  void begin();
  /// How many contacts new statuses from x and r = grad g would separate.
  std::size_t num_let_go(const Vector& x, const Vector& r) const;
  /// Takes new statuses from x and the contact forces r = grad g; true where any changed.
  bool update(const Vector& x, const Vector& r);
  /// Lets nodes stick that a Newton step q would make slip against their direction; true where any.
  bool stop_reversed(const Vector& x, const Vector& q);
  /// Slip directions and the stiffness of their change, for the statuses as they are.
  void update_slip(const Vector& x, const Vector& r);

  /// Statuses came round again: change one contact at a time from now on.
  bool cautious() const { return cautious_; }
  int num_changes() const { return num_changes_; }
  int num_cycles() const { return num_cycles_; }
  /// Statuses came round again although only one was changed at a time; asked once for each time.
  bool needs_resolution();
  /// Remembers the statuses as they are; counts it where they were met before.
  void remember();

 private:
  struct Proposal {
    ContactStatus status;
    double violation;  // of what the old status promises [N]
  };
  Proposal propose(std::size_t k, const Vector& x, const Vector& r) const;
  ContactStatus first_touch(std::size_t k, double depth, double slip) const;

  void take(std::size_t k, ContactStatus status);

  ContactSpace& space_;
  const double* stiffness_;
  std::vector<int> releases_;
  double force_tolerance_ = 0.0, length_tolerance_ = 0.0;
  bool cautious_ = false, unresolved_ = false;
  int num_changes_ = 0, num_cycles_ = 0;
  std::set<std::vector<ContactStatus>> seen_;
};

}  // namespace diffsim
