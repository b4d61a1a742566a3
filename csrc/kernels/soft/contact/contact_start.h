// Where the iteration of a step in contact begins.
#pragma once

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// The guess or the inertial positions y, whichever has less energy once its nodes are out of the
/// obstacles, and the statuses there; fixed unknowns at their targets. Where a body has landed, y
/// goes on into the ground: elements there are inside out, and hardly any that touch will stay.
ContactIterate contact_start(ContactProblem& problem);

/// Smallest length that counts for a body at x [m].
double length_tolerance(const Vector& x);

}  // namespace diffsim
