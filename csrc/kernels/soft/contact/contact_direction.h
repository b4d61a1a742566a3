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

  /// None yet: nothing but the H that it will be of.
  static ContactDirection none(bool is_clamped) { return {{}, {}, 0.0, false, is_clamped}; }
};

/// Solves for the free unknowns with H as assembled at x. Friction that would push a node backwards
/// stops it instead, which changes its status; H is clamped where it shows negative curvature.
/// @param before  from the same x, looser or on other statuses, and whether the assembled H is
///                clamped; or nothing but the latter
ContactDirection contact_direction(ContactProblem& problem, const ContactIterate& at,
                                   const DirectionAccuracy& accuracy, ContactDirection before);

}  // namespace diffsim
