#include "kernels/copter/hover_system.h"

#include "kernels/linalg/dense.h"

namespace diffsim::hover_system {
namespace {

constexpr double kPseudoDrop = 1e-12;  // relative pivot of the KKT matrix that counts as zero

}  // namespace

MatrixXd jacobian(const View& p, const Vector3d& a) {
  MatrixXd C(4, p.n);
  for (int i = 0; i < p.n; ++i) {
    C(0, i) = a.dot(Vector3d(p.F.col(i)));
    for (int k = 0; k < 3; ++k) C(k + 1, i) = p.T(k, i);
  }
  return C;
}

MatrixXd turning(const View& p, const Vector3d& a) {
  MatrixXd turn(3, p.n);
  for (int i = 0; i < p.n; ++i) {
    const double carried = a.dot(Vector3d(p.F.col(i)));
    for (int k = 0; k < 3; ++k) turn(k, i) = p.F(k, i) - a[k] * carried;
  }
  return turn;
}

MatrixXd columns(const MatrixXd& X, const std::vector<int>& kept) {
  MatrixXd out(X.rows(), static_cast<Eigen::Index>(kept.size()));
  for (std::size_t k = 0; k < kept.size(); ++k) out.col(k) = X.col(kept[k]);
  return out;
}

VectorXd entries(const VectorXd& x, const std::vector<int>& kept) {
  VectorXd out(static_cast<Eigen::Index>(kept.size()));
  for (std::size_t k = 0; k < kept.size(); ++k) out[k] = x[kept[k]];
  return out;
}

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
  const Vector3d f = p.net_force(at.u);
  const double lift = f.norm();
  const Vector3d a = f / lift;
  const MatrixXd turn = columns(turning(p, a), free);
  const MatrixXd C = columns(jacobian(p, a), free);
  const int m = static_cast<int>(free.size());
  MatrixXd K = MatrixXd::Zero(m + 4, m + 4);
  K.topLeftCorner(m, m) = at.y[0] / lift * dense::transposed_product(turn, turn);
  for (int k = 0; k < m; ++k) K(k, k) += p.h[free[k]];
  if (p.barrier > 0.0) {
    const VectorXd curvature = barrier_curvature(p, at.u);
    for (int k = 0; k < m; ++k) K(k, k) += curvature[free[k]];
  }
  K.topRightCorner(m, 4) = C.transpose();
  K.bottomLeftCorner(4, m) = C;
  if (!at.feasible)
    for (int k = m; k < m + 4; ++k) K(k, k) = -kDelta;
  return K;
}

VectorXd pseudo_solve(const MatrixXd& K, const VectorXd& rhs) {
  return dense::solve_least_norm(K, rhs, kPseudoDrop);
}

VectorXd stationarity(const View& p, const Iterate& at, const Vector3d& a) {
  VectorXd z = p.h.cwiseProduct(at.u) + dense::apply_transposed(jacobian(p, a), at.y);
  if (p.barrier > 0.0) z += barrier_gradient(p, at.u);
  return z;
}

}  // namespace diffsim::hover_system
