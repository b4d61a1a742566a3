// Frictional contact on a linearized body, solved as a whole in its contact forces
// (contact_cone.h): slower than the iteration on statuses, but it does not cycle. Used where that
// one does.
#pragma once

#include <vector>

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// Moves x to the solution of the contact problem linearized at x, and sets the statuses.
/// @param[in] contacts  those that may touch; the others separate
/// @param[in] gradient  grad g at x [N]
/// @param[out] limits   (num_contacts,) friction force at which each contact slips [N]
/// @return false where the clamped tangent cannot be factorized or the forces do not settle
bool relax_contacts(StepProblem& problem, ContactSpace& space,
                    const std::vector<std::size_t>& contacts, const Vector& gradient, Vector& x,
                    Vector& limits);

/// The last resort of one step: solves its contact problem as a whole, by relaxation after
/// relaxation, and with more of them each time it is asked.
class ContactRelaxation {
 public:
  explicit ContactRelaxation(std::size_t num_contacts) : touched_(num_contacts, false) {}

  /// Remembers which contacts have touched in this step.
  void remember(const ContactSpace& space);
  /// Moves x and sets the statuses; false where that did not succeed, or is too large to try.
  bool resolve(ContactProblem& problem, ContactIterate& at);

 private:
  std::vector<std::size_t> candidates(const ContactSpace& space, const Vector& x) const;

  std::vector<bool> touched_;
  int doublings_ = 0;
};

}  // namespace diffsim
