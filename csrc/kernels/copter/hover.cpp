#include "kernels/copter/hover.h"

#include <Eigen/Cholesky>
#include <Eigen/QR>
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels/copter/box_qp.h"

namespace diffsim {
namespace {

using Eigen::MatrixXd;
using Eigen::Vector3d;
using Eigen::Vector4d;
using Eigen::VectorXd;
using Rows3 = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::RowMajor>;

constexpr double kDelta = 1e-6;        // compliance of the constraint where there is no hover
constexpr double kLeastDelta = 1e-9;   // of the search for a hover
constexpr int kMaxStalls = 6;          // of that search
constexpr double kFeasible = 1e-10;    // |c| of a hover, in shares of the weight
constexpr double kRankDrop = 1e-9;     // relative pivot of dc/du that counts as zero
constexpr double kPseudoDrop = 1e-12;  // the same of the KKT matrix

struct View {
  explicit View(const HoverProblem& p)
      : n(p.num_rotors),
        F(p.force, 3, n),
        T(p.torque, 3, n),
        h(p.weights, n),
        upper(p.upper, n),
        barrier(p.barrier) {}
  int n;
  Eigen::Map<const Rows3> F, T;
  Eigen::Map<const VectorXd> h, upper;
  double barrier;
};

/// dc/du where the net thrust has the direction a.
MatrixXd jacobian(const View& p, const Vector3d& a) {
  MatrixXd C(4, p.n);
  C.row(0) = a.transpose() * p.F;
  C.bottomRows<3>() = p.T;
  return C;
}

/// The part of F that turns the net thrust: d2|F u|/du2 = turning' turning / |F u|.
MatrixXd turning(const View& p, const Vector3d& a) { return p.F - a * (a.transpose() * p.F); }

int rank_of(const MatrixXd& C) {
  if (C.cols() == 0) return 0;
  Eigen::ColPivHouseholderQR<MatrixXd> qr(C);
  qr.setThreshold(kRankDrop);
  return static_cast<int>(qr.rank());
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

/// min 1/2 u'Gu - q'u + barrier by Newton's method with a line search inside the box.
bool solve_barrier_qp(const View& p, const MatrixXd& G, const VectorXd& q, VectorXd& u) {
  const auto value = [&](const VectorXd& at) {
    return 0.5 * at.dot(G * at) - q.dot(at) -
           p.barrier * (at.array().log().sum() + (p.upper - at).array().log().sum());
  };
  for (int iter = 0; iter < 200; ++iter) {
    const VectorXd gradient = G * u - q + barrier_gradient(p, u);
    MatrixXd hessian = G;
    hessian.diagonal() += barrier_curvature(p, u);
    const VectorXd step = -hessian.llt().solve(gradient);
    if (!step.allFinite()) return false;
    const double decrement = -gradient.dot(step);
    double length = 1.0;
    for (int i = 0; i < p.n; ++i) {
      const double room = step[i] < 0.0 ? u[i] : p.upper[i] - u[i];
      if (std::abs(step[i]) * length > 0.99 * room) length = 0.99 * room / std::abs(step[i]);
    }
    const double before = value(u);
    // Near the minimum the value no longer resolves the descent, and a full step is right.
    if (decrement > 1e-10 * (1.0 + std::abs(before)))
      while (length > 1e-12 && value(u + length * step) > before - 1e-4 * length * decrement)
        length *= 0.5;
    u += length * step;
    if (step.cwiseQuotient(u.cwiseMin(p.upper - u)).lpNorm<Eigen::Infinity>() < 1e-8) return true;
    if (decrement < 1e-15 * (1.0 + std::abs(before))) return true;
  }
  return false;
}

struct Iterate {
  VectorXd u;
  Vector4d y = Vector4d::Zero();
  std::vector<BoundState> state;
  bool feasible = false;
};

/// Least effort for a net thrust whose part along `a` carries the weight, without torque: the
/// method of multipliers, each step a strictly convex program in the box. Where the residual stops
/// falling the penalty is raised; where that does not help there is no hover along `a`, and the
/// first step, the penalty 1 / kDelta alone, is the answer.
bool solve_direction(const View& p, const Vector3d& a, Iterate& at) {
  const MatrixXd C = jacobian(p, a);
  const Vector4d d = Vector4d::UnitX();
  Iterate first;
  Vector4d y = Vector4d::Zero();
  double delta = kDelta, last = 0.0;
  for (int iter = 0, stalled = 0; stalled < kMaxStalls && iter < 100; ++iter) {
    MatrixXd G = C.transpose() * C / delta;
    G.diagonal() += p.h;
    const VectorXd q = C.transpose() * (d / delta - y);
    const bool solved = p.barrier > 0.0 ? solve_barrier_qp(p, G, q, at.u)
                                        : solve_box_qp(G, q, p.upper, at.u, at.state);
    if (!solved) return false;
    const Vector4d r = C * at.u - d;
    y += r / delta;
    const double residual = r.norm();
    if (iter == 0) {
      first = at;
      first.y = y;
    }
    const bool slow = iter > 0 && residual > 0.5 * last;
    if (residual <= 1e-3 * kFeasible || (residual <= kFeasible && slow)) {
      at.y = y;
      at.feasible = true;
      return true;
    }
    if (slow) {
      ++stalled;
      delta = std::max(0.1 * delta, kLeastDelta);
    }
    last = residual;
  }
  at = first;
  at.feasible = false;
  return true;
}

/// The symmetric matrix of the Newton step in (u_free, y).
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

/// dL/du of the Lagrangian, all rotors.
VectorXd stationarity(const View& p, const Iterate& at, const Vector3d& a) {
  VectorXd z = p.h.cwiseProduct(at.u) + jacobian(p, a).transpose() * at.y;
  if (p.barrier > 0.0) z += barrier_gradient(p, at.u);
  return z;
}

bool bounds_hold(const View& p, const Iterate& at, const VectorXd& z) {
  const double slack = 1e-9 * (1.0 + at.y.norm());
  for (int i = 0; i < p.n; ++i) {
    if (at.u[i] < -1e-12 || at.u[i] > p.upper[i] + 1e-12) return false;
    if (p.upper[i] == 0.0) continue;
    if (at.state[i] == BoundState::kLower && z[i] < -slack) return false;
    if (at.state[i] == BoundState::kUpper && z[i] > slack) return false;
  }
  return true;
}

/// Newton on the optimality conditions with the bounds held as they are; keeps the result only if
/// it is optimal to rounding.
bool polish(const View& p, Iterate& at) {
  Iterate next = at;
  const std::vector<int> free = free_rotors(at.state);
  const int m = static_cast<int>(free.size());
  for (int iter = 0; iter < 12; ++iter) {
    const Vector3d f = p.F * next.u;
    const double lift = f.norm();
    if (!(lift > 1e-12)) return false;
    const VectorXd z = stationarity(p, next, f / lift);
    VectorXd r(m + 4);
    r.head(m) = z(free);
    r[m] = lift - 1.0;
    r.tail<3>() = p.T * next.u;
    if (!next.feasible) r.tail<4>() -= kDelta * next.y;
    if (!r.allFinite()) return false;
    // What rounding of u leaves of a barrier's gradient next to a bound.
    VectorXd tolerance = VectorXd::Constant(p.n, 1e-12 * (1.0 + next.y.norm()));
    if (p.barrier > 0.0)
      tolerance += 1e-15 * barrier_curvature(p, next.u).cwiseProduct(next.u + p.upper);
    if ((r.head(m).array().abs() <= tolerance(free).array()).all() &&
        r.tail<4>().lpNorm<Eigen::Infinity>() <= 1e-13) {
      if (!bounds_hold(p, next, z)) return false;
      next.u = next.u.cwiseMax(0.0).cwiseMin(p.upper);
      at = next;
      return true;
    }
    const VectorXd step = pseudo_solve(kkt_matrix(p, next, free), -r);
    for (int k = 0; k < m; ++k) next.u[free[k]] += step[k];
    next.y += step.tail<4>();
  }
  return false;
}

Iterate start(const View& p) {
  Iterate at;
  at.u = p.barrier > 0.0 ? VectorXd(p.upper.cwiseMin(2.0) / 2.0) : VectorXd::Zero(p.n);
  at.state.assign(p.n, p.barrier > 0.0 ? BoundState::kFree : BoundState::kLower);
  return at;
}

}  // namespace

void solve_hover(const HoverProblem& problem, double* u, double* multipliers, std::int64_t* state,
                 std::int64_t* info) {
  const View p(problem);
  Iterate at = start(p);
  Vector3d a(0.0, 0.0, -1.0);  // level
  HoverStatus status = HoverStatus::kNotConverged;
  int iter = 0;
  // Carrying the weight along a implies |F u| >= 1, so that scaling down to |F u| = 1 is admissible
  // for the next direction: the effort never rises.
  for (constexpr int kMaxTurns = 300; iter < kMaxTurns; ++iter) {
    if (!solve_direction(p, a, at)) break;
    const Vector3d f = p.F * at.u;
    const Vector3d next = f.norm() > 1e-12 ? Vector3d(f.normalized()) : a;
    const double change = (next - a).norm();
    a = next;
    const bool polished = change < 1e-2 && polish(p, at);
    if (polished || change < 1e-13) {
      if (polished || at.feasible) status = HoverStatus::kOptimal;
      if (polished && !at.feasible) status = HoverStatus::kInfeasible;
      break;
    }
  }
  const std::vector<int> free = free_rotors(at.state);
  if (p.n > 0 && (p.F * at.u).norm() > 1e-12) a = (p.F * at.u).normalized();
  const MatrixXd C = jacobian(p, a);
  const int free_rank = rank_of(C(Eigen::all, free));
  if (status == HoverStatus::kOptimal && free_rank < 4) status = HoverStatus::kRankDeficient;
  std::copy_n(at.u.data(), p.n, u);
  std::copy_n(at.y.data(), 4, multipliers);
  for (int i = 0; i < p.n; ++i) state[i] = static_cast<std::int64_t>(at.state[i]);
  info[0] = static_cast<std::int64_t>(status);
  info[1] = rank_of(C);
  info[2] = free_rank;
  info[3] = iter + 1;
}

// With the free rotors' conditions z_F(u, y; design) = 0 and c(u; design) = delta y, the adjoint
// solves K (v, w) = (dL/du_F, 0), and dL/d(design) = -d/d(design) of
//   v' z_F + w' c,  z = h u + dc/du' y + barrier.
void solve_hover_vjp(const HoverProblem& problem, const double* u, const double* multipliers,
                     const std::int64_t* state, const std::int64_t* info, const double* grad_u,
                     double* grad_force, double* grad_torque, double* grad_weights,
                     double* grad_upper) {
  const View p(problem);
  Iterate at;
  at.u = Eigen::Map<const VectorXd>(u, p.n);
  at.y = Eigen::Map<const Vector4d>(multipliers);
  for (int i = 0; i < p.n; ++i) at.state.push_back(static_cast<BoundState>(state[i]));
  at.feasible = info[0] != static_cast<std::int64_t>(HoverStatus::kInfeasible);
  const Eigen::Map<const VectorXd> g(grad_u, p.n);
  Eigen::Map<Rows3> gF(grad_force, 3, p.n), gT(grad_torque, 3, p.n);
  Eigen::Map<VectorXd> gh(grad_weights, p.n), gup(grad_upper, p.n);
  gF.setZero();
  gT.setZero();
  gh.setZero();
  gup.setZero();
  const Vector3d f = p.F * at.u;
  const double lift = f.norm();
  if (!(lift > 0.0)) return;
  const Vector3d a = f / lift;
  const std::vector<int> free = free_rotors(at.state);
  const int m = static_cast<int>(free.size());
  VectorXd rhs = VectorXd::Zero(m + 4);
  rhs.head(m) = g(free);
  const VectorXd adjoint = pseudo_solve(kkt_matrix(p, at, free), rhs);
  VectorXd v = VectorXd::Zero(p.n);
  for (int k = 0; k < m; ++k) v[free[k]] = adjoint[k];
  const Vector4d w = adjoint.tail<4>();
  const MatrixXd turn = turning(p, a);
  gF = -(at.y[0] * (a * v.transpose() + turn * v / lift * at.u.transpose()) +
         w[0] * a * at.u.transpose());
  gT = -(at.y.tail<3>() * v.transpose() + w.tail<3>() * at.u.transpose());
  gh = -v.cwiseProduct(at.u);
  const VectorXd coupling =
      at.y[0] / lift * turn.transpose() * (turn * v) + jacobian(p, a).transpose() * w;
  for (int i = 0; i < p.n; ++i) {
    if (at.state[i] == BoundState::kUpper) gup[i] = g[i] - coupling[i];
    if (p.barrier > 0.0) {
      const double room = p.upper[i] - at.u[i];
      gup[i] = v[i] * p.barrier / (room * room);
    }
  }
}

}  // namespace diffsim
