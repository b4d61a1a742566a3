#include "kernels/soft/contact/contact_cone.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

using Vec3 = Eigen::Vector3d;
using Mat3 = Eigen::Matrix3d;

// Rounds of sweeps and of Newton's method; sweeps in one, iterations of one contact within a sweep,
// and Newton's.
constexpr int kMaxRounds = 20, kMaxSweeps = 100, kMaxLocal = 100, kMaxNewton = 50;
// Change of the forces in a sweep, of the forces; and that of one contact, of a sweep's.
constexpr double kTolerance = 1e-12, kLocalTolerance = 0.1 * kTolerance;
// Decrease of the residual that a step must keep of what Newton promises; shortest step.
constexpr double kDecrease = 1e-4, kLeastStep = 1e-4;

struct Projection {
  Vec3 force;
  Mat3 slope;
};

/// Nearest force in Coulomb's cone about n.
Projection project_cone(const Vec3& force, const Vec3& n, double friction) {
  const double normal = n.dot(force);
  const Vec3 along = force - normal * n;
  const double size = along.norm();
  if (size <= friction * normal) return {force, Mat3::Identity()};
  if (friction * size <= -normal) return {Vec3::Zero(), Mat3::Zero()};
  const double onto = (normal + friction * size) / (1.0 + friction * friction);
  const Vec3 t = along / size, edge = n + friction * t;
  const Mat3 across = Mat3::Identity() - n * n.transpose() - t * t.transpose();
  return {onto * edge, edge * edge.transpose() / (1.0 + friction * friction) +
                           (friction * onto / size) * across};
}

/// Force of one contact whose relative displacement is w + W force, all others held.
Vec3 solve_one(const Mat3& W, const Vec3& w, const Vec3& n, double offset, double friction,
               Vec3 force) {
  if (std::isinf(friction)) {
    const Vec3 stick = W.ldlt().solve(offset * n - w);
    return n.dot(stick) > 0.0 ? stick : Vec3::Zero();
  }
  if (friction == 0.0) return std::max(0.0, (offset - n.dot(w)) / n.dot(W * n)) * n;
  const double step = 1.0 / W.trace();
  for (int iter = 0; iter < kMaxLocal; ++iter) {
    const Vec3 u = w + W * force;
    const double slip = (u - n.dot(u) * n).norm();
    const Vec3 next =
        project_cone(force - step * (u + (friction * slip - offset) * n), n, friction).force;
    const double change = (next - force).norm();
    force = next;
    if (change <= kLocalTolerance * force.norm()) break;
  }
  return force;
}

/// One nonlinear Gauss-Seidel sweep; returns the change of the forces [N].
double sweep(const ConeProblem& p, Eigen::VectorXd& force) {
  double change = 0.0;
  for (Eigen::Index j = 0; j < p.offset.size(); ++j) {
    const Mat3 own = p.W.block<3, 3>(3 * j, 3 * j);
    const Vec3 before = force.segment<3>(3 * j);
    const Vec3 others = p.free.segment<3>(3 * j) + p.W.middleRows<3>(3 * j) * force - own * before;
    const Vec3 after = solve_one(own, others, p.normal.col(j), p.offset(j), p.friction(j), before);
    change += (after - before).squaredNorm();
    force.segment<3>(3 * j) = after;
  }
  return std::sqrt(change);
}

/// f - P_K(...), and its generalized derivative where `slope` is given.
Eigen::VectorXd residual(const ConeProblem& p, const Eigen::VectorXd& force,
                         Eigen::MatrixXd* slope) {
  const Eigen::VectorXd u = p.free + p.W * force;
  Eigen::VectorXd out(force.size());
  if (slope) slope->setIdentity(force.size(), force.size());
  for (Eigen::Index j = 0; j < p.offset.size(); ++j) {
    const Vec3 n = p.normal.col(j), own = u.segment<3>(3 * j);
    const Vec3 along = own - n.dot(own) * n;
    const double slip = along.norm(), friction = p.friction(j);
    const double rho = 1.0 / p.W.block<3, 3>(3 * j, 3 * j).trace();
    const Vec3 trial = force.segment<3>(3 * j) - rho * (own + (friction * slip - p.offset(j)) * n);
    const Projection projected = project_cone(trial, n, friction);
    out.segment<3>(3 * j) = force.segment<3>(3 * j) - projected.force;
    if (!slope) continue;
    Mat3 corrected = Mat3::Identity();
    if (slip > 0.0) corrected += friction * n * (along / slip).transpose();
    slope->middleRows<3>(3 * j) += rho * (projected.slope * corrected) * p.W.middleRows<3>(3 * j);
    slope->block<3, 3>(3 * j, 3 * j) -= projected.slope;
  }
  return out;
}

/// Newton's method, steps halved until the residual falls; true where it settled.
bool newton(const ConeProblem& p, Eigen::VectorXd& force) {
  Eigen::MatrixXd slope;
  for (int iter = 0; iter < kMaxNewton; ++iter) {
    const Eigen::VectorXd before = residual(p, force, &slope);
    if (before.norm() <= kTolerance * force.norm()) return true;
    const Eigen::VectorXd step = slope.partialPivLu().solve(-before);
    if (!step.allFinite()) return false;
    double length = 1.0;
    while (length > kLeastStep && !(residual(p, force + length * step, nullptr).norm() <=
                                    (1.0 - kDecrease * length) * before.norm()))
      length *= 0.5;
    if (length <= kLeastStep) return false;
    force += length * step;
  }
  return false;
}

}  // namespace

bool solve_cones(const ConeProblem& problem, Eigen::VectorXd& force) {
  for (int round = 0; round < kMaxRounds; ++round) {
    for (int i = 0; i < kMaxSweeps; ++i)
      if (sweep(problem, force) <= kTolerance * force.norm()) return true;
    Eigen::VectorXd trial = force;
    if (newton(problem, trial)) {
      force = trial;
      return true;
    }
  }
  return false;
}

}  // namespace diffsim
