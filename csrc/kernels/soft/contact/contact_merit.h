// What a step in contact lowers along a direction: g plus what friction would dissipate if the
// normal forces were those predicted (Tresca friction). Its minimum on the constraints is where the
// Newton step goes.
#pragma once

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// Friction force at which each contact slips after a step of H, zero where it does not slip.
/// @param[in] gradient  grad g where the step begins [N]
/// @param[in] step      displacement [m], with H as assembled
/// @return (num_contacts,) [N]
Vector friction_limits(StepProblem& objective, const ContactSpace& space, const Vector& gradient,
                       const Vector& step);

/// The merit at x, where g is `value` [J].
double merit(const ContactSpace& space, const Vector& limits, const Vector& x, double value);

/// What rounding of positions leaves undetermined of the merit's friction [J].
double dissipation_rounding(const ContactSpace& space, const Vector& limits, const Vector& x);

/// Its slope along q, (num_nodes, 3) [m], by the slip directions as they are [J].
double merit_slope(StepProblem& objective, const ContactSpace& space, const Vector& limits,
                   const Vector& gradient, const Vector& q);

}  // namespace diffsim
