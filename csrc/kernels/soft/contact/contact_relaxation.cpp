#include "kernels/soft/contact/contact_relaxation.h"

#include <Eigen/Dense>

namespace diffsim {
namespace {

using Vec3 = Eigen::Vector3d;
using Mat3 = Eigen::Matrix3d;

constexpr int kMaxSweeps = 2000, kMaxLocal = 100;
constexpr double kTolerance = 1e-12;

/// Nearest force in Coulomb's cone about n.
Vec3 project_cone(const Vec3& force, const Vec3& n, double friction) {
  const double normal = n.dot(force);
  const Vec3 along = force - normal * n;
  const double size = along.norm();
  if (size <= friction * normal) return force;
  if (friction * size <= -normal) return Vec3::Zero();
  const double onto = (normal + friction * size) / (1.0 + friction * friction);
  return onto * n + (friction * onto / size) * along;
}

/// Force of one contact whose relative displacement is w + W force, all others held.
/// Fixed point of the cone projection with de Saxce's correction of the displacement.
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
        project_cone(force - step * (u + (friction * slip - offset) * n), n, friction);
    const double change = (next - force).norm();
    force = next;
    if (change <= 0.1 * kTolerance * force.norm()) break;
  }
  return force;
}

}  // namespace

bool relax_contacts(StepProblem& problem, ContactSpace& space,
                    const std::vector<std::size_t>& contacts, const Vector& gradient, Vector& x,
                    Vector& limits) {
  problem.assemble(x, true);
  if (!problem.factorize()) return false;
  const ContactInputs& in = space.inputs();
  const Eigen::Index m = static_cast<Eigen::Index>(contacts.size());
  Vector step, column, unit(problem.size(), 0.0);
  problem.solve_factorized(gradient, step);
  Vector free = x;
  problem.ops().add(-1.0, step, free);

  Eigen::MatrixXd W(3 * m, 3 * m);
  Eigen::VectorXd w(3 * m), force = Eigen::VectorXd::Zero(3 * m);
  for (Eigen::Index j = 0; j < m; ++j) {
    const std::size_t k = contacts[static_cast<std::size_t>(j)];
    for (std::size_t a = 0; a < 3; ++a) {
      const std::size_t entry = 3 * space.node(k) + a;
      w(3 * j + static_cast<Eigen::Index>(a)) = free[entry] - in.reference[3 * k + a];
      unit[entry] = 1.0;
      problem.solve_factorized(unit, column);
      unit[entry] = 0.0;
      for (Eigen::Index i = 0; i < m; ++i)
        for (std::size_t b = 0; b < 3; ++b)
          W(3 * i + static_cast<Eigen::Index>(b), 3 * j + static_cast<Eigen::Index>(a)) =
              column[3 * space.node(contacts[static_cast<std::size_t>(i)]) + b];
    }
  }
  bool settled = false;
  for (int sweep = 0; sweep < kMaxSweeps && !settled; ++sweep) {
    double change = 0.0;
    for (Eigen::Index j = 0; j < m; ++j) {
      const std::size_t k = contacts[static_cast<std::size_t>(j)];
      const Mat3 own = W.block<3, 3>(3 * j, 3 * j);
      const Vec3 before = force.segment<3>(3 * j);
      const Vec3 others = w.segment<3>(3 * j) + W.middleRows<3>(3 * j) * force - own * before;
      const Vec3 n = Eigen::Map<const Vec3>(space.normal(k));
      const Vec3 after = solve_one(own, others, n, in.offset[k], in.friction[k], before);
      change += (after - before).squaredNorm();
      force.segment<3>(3 * j) = after;
    }
    settled = std::sqrt(change) <= kTolerance * force.norm();
  }
  Vector load(problem.size(), 0.0);
  std::fill(space.status.begin(), space.status.end(), ContactStatus::kSeparate);
  limits.assign(space.size(), 0.0);
  for (Eigen::Index j = 0; j < m; ++j) {
    const std::size_t k = contacts[static_cast<std::size_t>(j)];
    const Vec3 f = force.segment<3>(3 * j), n = Eigen::Map<const Vec3>(space.normal(k));
    for (std::size_t a = 0; a < 3; ++a)
      load[3 * space.node(k) + a] = f(static_cast<Eigen::Index>(a));
    if (f.isZero(0.0)) continue;
    const double pressing = n.dot(f);
    limits[k] = in.friction[k] * pressing;
    const bool slips = (f - pressing * n).norm() >= (1.0 - 1e-9) * limits[k];
    space.status[k] = slips ? ContactStatus::kSlip : ContactStatus::kStick;
  }
  problem.solve_factorized(load, step);
  x = free;
  problem.ops().add(1.0, step, x);
  return settled;
}

}  // namespace diffsim
