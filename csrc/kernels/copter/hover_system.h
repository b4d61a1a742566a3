// The optimality conditions of the hover problem in hover.h, shared by the solve and its adjoint.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "kernels/copter/box_qp.h"
#include "kernels/copter/hover.h"

namespace diffsim::hover_system {

using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::Vector4d;
using Eigen::VectorXd;
using Rows3 = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::RowMajor>;

constexpr double kDelta = 1e-6;  // compliance of the constraint where there is no hover

/// A problem as matrices.
struct View {
  explicit View(const HoverProblem& p)
      : n(p.num_rotors),
        F(p.force, 3, n),
        T(p.torque, 3, n),
        h(p.weights, n),
        upper(p.upper, n),
        barrier(p.barrier) {}
  /// F u and T u.
  Vector3d net_force(const VectorXd& u) const { return along(F.data(), u); }
  Vector3d net_torque(const VectorXd& u) const { return along(T.data(), u); }

  int n;
  Eigen::Map<const Rows3> F, T;
  Eigen::Map<const VectorXd> h, upper;
  double barrier;

 private:
  Vector3d along(const double* rows, const VectorXd& u) const {
    Vector3d sum = Vector3d::Zero();
    for (int k = 0; k < 3; ++k)
      for (int i = 0; i < n; ++i) sum[k] += rows[k * n + i] * u[i];
    return sum;
  }
};

/// Thrusts, multipliers of c and what stands at a bound.
struct Iterate {
  VectorXd u;
  Vector4d y = Vector4d::Zero();
  std::vector<BoundState> state;
  bool feasible = false;
};

/// dc/du where the net thrust has the direction a, (4, n).
MatrixXd jacobian(const View& p, const Vector3d& a);

/// The part of F that turns the net thrust: d2|F u|/du2 = turning' turning / |F u|.
MatrixXd turning(const View& p, const Vector3d& a);

/// Those columns of X, and entries of x.
MatrixXd columns(const MatrixXd& X, const std::vector<int>& kept);
VectorXd entries(const VectorXd& x, const std::vector<int>& kept);

std::vector<int> free_rotors(const std::vector<BoundState>& state);

VectorXd barrier_gradient(const View& p, const VectorXd& u);
VectorXd barrier_curvature(const View& p, const VectorXd& u);

/// dL/du of the Lagrangian, all rotors; zero for the free ones at the optimum.
VectorXd stationarity(const View& p, const Iterate& at, const Vector3d& a);

/// The symmetric matrix of the Newton step in (u_free, y).
MatrixXd kkt_matrix(const View& p, const Iterate& at, const std::vector<int>& free);

/// Least-norm least-squares solution: the step where rotors do not command all of c.
VectorXd pseudo_solve(const MatrixXd& K, const VectorXd& rhs);

}  // namespace diffsim::hover_system
