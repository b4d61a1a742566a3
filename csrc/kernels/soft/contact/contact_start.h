// Where the iteration of a step in contact begins.
#pragma once

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// The guess or the inertial positions y, whichever has less energy; fixed unknowns at their
/// targets.
ContactIterate contact_start(StepProblem& objective, const ConstantSystem& system,
                             const StepInputs& inputs);

/// Where inertia and the given forces alone would take the nodes, (num_nodes, 3) [m].
Vector free_flight(const ConstantSystem& system, const StepInputs& inputs);

/// Smallest length that counts for a body at x [m].
double length_tolerance(const Vector& x);

}  // namespace diffsim
