// Frictional contact on a linearized body, solved as a whole in its contact forces
// (contact_cone.h): slower than the iteration on statuses, but it does not cycle. Used where that
// one does.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// The last resort of one step: solves its contact problem as a whole, by relaxation after
/// relaxation until these settle, closer after each cycle of the statuses.
class ContactRelaxation {
 public:
  explicit ContactRelaxation(std::size_t num_contacts) : touched_(num_contacts, false) {}

  /// Remembers which contacts have touched in this step.
  void remember(const ContactSpace& space);
  /// Moves x and sets the statuses; false where that did not succeed, or is too large to try.
  /// @param cycled  the statuses; false: they only changed on a tangent that needs a factor
  bool resolve(ContactProblem& problem, bool cycled, ContactIterate& at);

 private:
  std::vector<std::size_t> candidates(const ContactSpace& space, const Vector& x) const;
  /// Factors the clamped tangent at x; false where that fails.
  bool linearize(StepProblem& problem, const ContactSpace& space,
                 const std::vector<std::size_t>& contacts, const Vector& x);
  /// Moves x to the solution of the contact problem linearized there, and sets the statuses.
  /// @param[in] contacts  those that may touch, as linearized; the others separate
  /// @param[in] gradient  grad g at x [N]
  /// @param[out] limits   (num_contacts,) friction force at which each contact slips [N]
  /// @return false where the forces do not settle
  bool relax(StepProblem& problem, ContactSpace& space, const std::vector<std::size_t>& contacts,
             const Vector& gradient, Vector& x, Vector& limits) const;

  std::vector<bool> touched_;
  int num_cycles_ = 0;       // resolved
  Eigen::MatrixXd inverse_;  // of the tangent, between the linearized contacts
};

}  // namespace diffsim
