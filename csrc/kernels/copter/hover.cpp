#include "kernels/copter/hover.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels/copter/box_qp.h"
#include "kernels/copter/hover_system.h"
#include "kernels/linalg/dense.h"

namespace diffsim {
namespace {

using namespace hover_system;

constexpr double kLeastDelta = 1e-9;  // of the search for a hover
constexpr int kMaxStalls = 6;         // of that search
constexpr double kRankDrop = 1e-9;    // relative pivot of dc/du that counts as zero

/// min 1/2 u'Gu - q'u + barrier by Newton's method with a line search inside the box.
bool solve_barrier_qp(const View& p, const MatrixXd& G, const VectorXd& q, VectorXd& u) {
  const auto value = [&](const VectorXd& at) {
    double logs = 0.0;
    for (int i = 0; i < p.n; ++i) logs += std::log(at[i]) + std::log(p.upper[i] - at[i]);
    return 0.5 * at.dot(dense::apply(G, at)) - q.dot(at) - p.barrier * logs;
  };
  for (int iter = 0; iter < 200; ++iter) {
    const VectorXd gradient = dense::apply(G, u) - q + barrier_gradient(p, u);
    MatrixXd hessian = G;
    hessian.diagonal() += barrier_curvature(p, u);
    const VectorXd step = -dense::solve_positive(hessian, gradient);
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
    MatrixXd G = dense::transposed_product(C, C) / delta;
    G.diagonal() += p.h;
    const VectorXd q = dense::apply_transposed(C, d / delta - y);
    const bool solved = p.barrier > 0.0 ? solve_barrier_qp(p, G, q, at.u)
                                        : solve_box_qp(G, q, p.upper, at.u, at.state);
    if (!solved) return false;
    const Vector4d r = dense::apply(C, at.u) - d;
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
    const Vector3d f = p.net_force(next.u);
    const double lift = f.norm();
    if (!(lift > 1e-12)) return false;
    const VectorXd z = stationarity(p, next, f / lift);
    VectorXd r(m + 4);
    r.head(m) = entries(z, free);
    r[m] = lift - 1.0;
    r.tail<3>() = p.net_torque(next.u);
    if (!next.feasible) r.tail<4>() -= kDelta * next.y;
    if (!r.allFinite()) return false;
    // What rounding of u leaves of a barrier's gradient next to a bound.
    VectorXd tolerance = VectorXd::Constant(p.n, 1e-12 * (1.0 + next.y.norm()));
    if (p.barrier > 0.0)
      tolerance += 1e-15 * barrier_curvature(p, next.u).cwiseProduct(next.u + p.upper);
    // At least one step: a residual within tolerance leaves up to 1e-10 in the thrusts.
    if (iter > 0 && (r.head(m).array().abs() <= entries(tolerance, free).array()).all() &&
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
    const Vector3d f = p.net_force(at.u);
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
  const Vector3d net = p.net_force(at.u);
  if (net.norm() > 1e-12) a = net.normalized();
  const MatrixXd C = jacobian(p, a);
  const int free_rank = dense::rank(columns(C, free), kRankDrop);
  if (status == HoverStatus::kOptimal && free_rank < 4) status = HoverStatus::kRankDeficient;
  std::copy_n(at.u.data(), p.n, u);
  std::copy_n(at.y.data(), 4, multipliers);
  for (int i = 0; i < p.n; ++i) state[i] = static_cast<std::int64_t>(at.state[i]);
  info[0] = static_cast<std::int64_t>(status);
  info[1] = dense::rank(C, kRankDrop);
  info[2] = free_rank;
  info[3] = iter + 1;
}

}  // namespace diffsim
