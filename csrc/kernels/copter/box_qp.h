// Strictly convex quadratic programs in a box: a primal active set method for a handful of
// unknowns.
#pragma once

#include <Eigen/Core>
#include <vector>

namespace diffsim {

/// Where an unknown stands: at its lower bound, between the bounds, at its upper bound.
enum class BoundState : int { kLower = -1, kFree = 0, kUpper = 1 };

/// min 1/2 u' G u - q' u  s.t.  0 <= u <= upper.
/// @param[in]     G      (n, n) symmetric positive definite
/// @param[in]     q      (n,)
/// @param[in]     upper  (n,), >= 0
/// @param[in,out] u      (n,) start, inside the box; the minimizer
/// @param[in,out] state  (n,) start, consistent with u; where u stands at the minimizer
/// @return false if the working set did not settle (G not positive definite in floating point)
bool solve_box_qp(const Eigen::MatrixXd& G, const Eigen::VectorXd& q, const Eigen::VectorXd& upper,
                  Eigen::VectorXd& u, std::vector<BoundState>& state);

}  // namespace diffsim
