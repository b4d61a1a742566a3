// Frictional contact on a linearised body by nonlinear Gauss-Seidel on the Delassus operator:
// slower than the semismooth Newton iteration, but it does not cycle. Used where that one does.
#pragma once

#include <vector>

#include "kernels/soft/contact/contact_space.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {

/// Moves x to the solution of the contact problem linearised at x, and sets the statuses.
/// @param[in] contacts  those that may touch; the others separate
/// @param[in] gradient  grad g at x [N]
/// @param[out] limits   (num_contacts,) friction force at which each contact slips [N]
/// @return false where the clamped tangent cannot be factorised or the sweeps do not settle
bool relax_contacts(StepProblem& problem, ContactSpace& space,
                    const std::vector<std::size_t>& contacts, const Vector& gradient, Vector& x,
                    Vector& limits);

}  // namespace diffsim
