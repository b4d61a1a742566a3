// Newton's direction of a step in contact: onto the constraints of the statuses, then within them.
#pragma once

#include "kernels/soft/contact/contact_problem.h"

namespace diffsim {

/// How accurately the linear system is solved.
struct DirectionAccuracy {
  double forcing;  // of its right-hand side
  double enough;   // residual that need not be lowered [N]
};

struct ContactDirection {
  Vector onto;        // (num_nodes, 3) puts x on the constraints [m]
  Vector within;      // (num_nodes, 3) in the range of P [m]
  double rhs_norm;    // what is left to solve on the constraints [N]
  bool is_corrected;  // `onto` is not zero
  bool is_clamped;    // H was made positive definite
};

/// Solves for the free unknowns with H as assembled at x. Friction that would push a node backwards
/// stops it instead, which changes its status; H is clamped where it shows negative curvature.
/// @param is_clamped  whether the assembled H is clamped
ContactDirection contact_direction(ContactProblem& problem, const ContactIterate& at,
                                   const DirectionAccuracy& accuracy, bool is_clamped);

}  // namespace diffsim
