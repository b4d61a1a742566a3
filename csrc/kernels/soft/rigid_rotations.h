// The body's rotations, which the constant factor takes for deformations.
//
// A resists every gradient of a displacement, a solid only the symmetric part: to turn the body as
// a whole costs A a hundred times what it costs H where a step is long beside the body's
// vibrations. Conjugate gradients would spend half of their iterations on these three directions.
// With W the rotations, held where contact holds the body, A^-1 + W (W^T H W)^-1 W^T has no such
// outliers (an additive coarse correction: Nicolaides 1987; Dryja and Widlund 1987).
#pragma once

#include <functional>
#include <memory>

#include "kernels/soft/step_problem.h"

namespace diffsim {

class RigidRotations {
 public:
  /// Takes the rotations of x (num_nodes, 3) about its mean; none where a node is fixed, or where
  /// H is not positive definite on them.
  /// @param[in] hold  moves a displacement onto what contact leaves free; empty: free flight
  void prepare(StepProblem& problem, const ConstantSystem& system, const Vector& x,
               const std::function<void(Vector&)>& hold = {});
  void forget() { count_ = 0; }
  /// z += W (W^T H W)^-1 W^T r.
  void add(const Vector& r, Vector& z, VectorOps& ops) const;

 private:
  static constexpr int kAxes = 3;
  struct Energy;        // the factor of W^T H W; Eigen stays out of what includes this
  Vector turn_[kAxes];  // W
  std::shared_ptr<const Energy> energy_;
  int count_ = 0;  // kAxes or none
};

}  // namespace diffsim
