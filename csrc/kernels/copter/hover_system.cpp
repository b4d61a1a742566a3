#include "kernels/copter/hover_system.h"

#include <Eigen/QR>

namespace diffsim::hover_system {
namespace {

constexpr double kPseudoDrop = 1e-12;  // relative pivot of the KKT matrix that counts as zero

}  // namespace

MatrixXd jacobian(const View& p, const Vector3d& a) {
  MatrixXd C(4, p.n);
  C.row(0) = a.transpose() * p.F;
  C.bottomRows<3>() = p.T;
  return C;
}

MatrixXd turning(const View& p, const Vector3d& a) { return p.F - a * (a.transpose() * p.F); }

std::vector<int> free_rotors(const std::vector<BoundState>& state) {
  std::vector<int> free;
  for (std::size_t i = 0; i < state.size(); ++i)
    if (state[i] == BoundState::kFree) free.push_back(static_cast<int>(i));
  return free;
}

VectorXd barrier_gradient(const View& p, const VectorXd& u) {
  return p.barrier * ((p.upper - u).cwiseInverse() - u.cwiseInverse());
}

VectorXd barrier_curvature(const View& p, const VectorXd& u) {
  return p.barrier * ((p.upper - u).cwiseAbs2().cwiseInverse() + u.cwiseAbs2().cwiseInverse());
}

MatrixXd kkt_matrix(const View& p, const Iterate& at, const std::vector<int>& free) {
  const Vector3d f = p.F * at.u;
  const double lift = f.norm();
  const Vector3d a = f / lift;
  const MatrixXd turn = turning(p, a)(Eigen::all, free);
  const MatrixXd C = jacobian(p, a)(Eigen::all, free);
  const int m = static_cast<int>(free.size());
  MatrixXd K = MatrixXd::Zero(m + 4, m + 4);
  K.topLeftCorner(m, m) = at.y[0] / lift * turn.transpose() * turn;
  for (int k = 0; k < m; ++k) K(k, k) += p.h[free[k]];
  if (p.barrier > 0.0) K.topLeftCorner(m, m).diagonal() += barrier_curvature(p, at.u)(free);
  K.topRightCorner(m, 4) = C.transpose();
  K.bottomLeftCorner(4, m) = C;
  if (!at.feasible) K.bottomRightCorner(4, 4).diagonal().setConstant(-kDelta);
  return K;
}

VectorXd pseudo_solve(const MatrixXd& K, const VectorXd& rhs) {
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> qr;
  qr.setThreshold(kPseudoDrop);
  return qr.compute(K).solve(rhs);
}

VectorXd stationarity(const View& p, const Iterate& at, const Vector3d& a) {
  VectorXd z = p.h.cwiseProduct(at.u) + jacobian(p, a).transpose() * at.y;
  if (p.barrier > 0.0) z += barrier_gradient(p, at.u);
  return z;
}

}  // namespace diffsim::hover_system
