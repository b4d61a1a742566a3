#include "kernels/soft/rigid_rotations.h"

#include <Eigen/Cholesky>
#include <algorithm>

namespace diffsim {

struct RigidRotations::Energy {
  Eigen::LLT<Eigen::Matrix3d> factor;
};

namespace {

/// Displacements e_axis x (x - mean x).
void rotate(const Vector& x, int axis, Vector& out) {
  double mean[3] = {0.0, 0.0, 0.0};
  const std::size_t nodes = x.size() / 3;
  for (std::size_t i = 0; i < x.size(); ++i) mean[i % 3] += x[i] / static_cast<double>(nodes);
  const std::size_t b = static_cast<std::size_t>(axis + 1) % 3, c = (b + 1) % 3;
  out.assign(x.size(), 0.0);
  for (std::size_t i = 0; i < x.size(); i += 3) {
    out[i + b] = -(x[i + c] - mean[c]);
    out[i + c] = x[i + b] - mean[b];
  }
}

bool any_fixed(const ConstantSystem& system) {
  const std::uint8_t* end = system.fixed() + 3 * system.model().num_nodes;
  return std::find(system.fixed(), end, std::uint8_t{1}) != end;
}

}  // namespace

void RigidRotations::prepare(StepProblem& problem, const ConstantSystem& system, const Vector& x,
                             const std::function<void(Vector&)>& hold) {
  count_ = 0;
  if (any_fixed(system)) return;
  Eigen::Matrix3d energy;
  Vector image;
  for (int a = 0; a < kAxes; ++a) {
    rotate(x, a, turn_[a]);
    if (hold) hold(turn_[a]);
    problem.multiply(turn_[a], image);
    for (int b = 0; b <= a; ++b) energy(a, b) = problem.ops().dot(turn_[b], image);
  }
  const auto made = std::make_shared<Energy>();
  made->factor.compute(energy);  // reads the lower triangle
  energy_ = made;
  if (made->factor.info() == Eigen::Success) count_ = kAxes;
}

void RigidRotations::add(const Vector& r, Vector& z, VectorOps& ops) const {
  if (count_ == 0) return;
  Eigen::Vector3d amount;
  for (int a = 0; a < kAxes; ++a) amount[a] = ops.dot(turn_[a], r);
  energy_->factor.solveInPlace(amount);
  for (int a = 0; a < kAxes; ++a) ops.add(amount[a], turn_[a], z);
}

}  // namespace diffsim
