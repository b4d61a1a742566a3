// Coulomb contacts of a linear body in their forces alone, a few dense unknowns per contact.
//
// With relative displacements u = free + W f, each force f in its cone K, slip u_T and depth
// offset:
//   f = P_K(f - rho (u + (mu |u_T| - offset) n)),
// the projection with de Saxce's correction of the displacement (de Saxce and Feng 1998). It is
// solved by sweeps over single contacts, which do not cycle but are slow where a stiff body couples
// them, and by Newton's method on the equation, which lowers its residual or hands back to them.
#pragma once

#include <Eigen/Core>

namespace diffsim {

struct ConeProblem {
  explicit ConeProblem(Eigen::Index size)
      : normal(3, size), offset(size), friction(size), free(3 * size), W(3 * size, 3 * size) {}

  Eigen::Matrix3Xd normal;   // (3, num_contacts), unit
  Eigen::VectorXd offset;    // (num_contacts,) least normal displacement [m]
  Eigen::VectorXd friction;  // (num_contacts,) [-]
  Eigen::VectorXd free;      // (3 num_contacts,) displacements without forces [m]
  Eigen::MatrixXd W;         // (3 num_contacts, 3 num_contacts) their change by forces [m/N]
};

/// @param[in,out] force  (3 num_contacts,) from where to begin; the contact forces [N]
/// @return false where they did not settle
bool solve_cones(const ConeProblem& problem, Eigen::VectorXd& force);

}  // namespace diffsim
