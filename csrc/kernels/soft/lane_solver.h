// Solves with the tangents of several small bodies, one in each lane of a register.
#pragma once

#include "kernels/soft/step_problem.h"

namespace diffsim {

/// One system H z = b on free unknowns, b being zero on fixed ones.
struct LaneSystem {
  Vector b, z, residual;
  Vector product;  // H z, what fixed unknowns feel included
  double tolerance = 0.0;
  KrylovResult result;  // num_iters counts solves with the factor

  bool is_active() const { return !result.converged && !result.negative_curvature; }
};

/// A problem and where its tangent is asked for.
struct LanePoint {
  StepProblem* problem = nullptr;
  const Vector* x = nullptr;
};

/// Matrices of a system's members with their memory, which is given back at the end.
class LaneSolver {
 public:
  explicit LaneSolver(const ConstantSystem& system)
      : system_(system), memory_(system.pattern().lane_memories().take()) {
    memory_->matrices.clear(tables().pattern);
  }
  ~LaneSolver() { system_.pattern().lane_memories().give_back(std::move(memory_)); }
  LaneSolver(const LaneSolver&) = delete;
  LaneSolver& operator=(const LaneSolver&) = delete;

  /// Adds tangents to lanes that are still zero.
  /// @param points  problem and where, by lane; a lane without a problem stays as it is
  void assemble(const std::vector<LanePoint>& points);
  void clear(int lane) { memory_->matrices.clear_lane(tables().pattern, lane); }
  /// Bit l is set where the matrix of lane l is positive definite.
  unsigned factor() { return memory_->matrices.factor(tables().pattern, system_.fixed()); }

  void put(const Vector& v, int lane) {
    LaneCholesky::put(tables().pattern, v.data(), lane, memory_->columns);
  }
  void get(int lane, Vector& v) const { get(memory_->columns, lane, v); }
  void solve() { memory_->matrices.solve(tables().pattern, memory_->columns); }
  /// What was put, times the matrices.
  void multiply() {
    memory_->matrices.multiply(tables().pattern, memory_->columns, memory_->product);
  }
  void get_product(int lane, Vector& v) const { get(memory_->product, lane, v); }

  /// Solves with iterative refinement; those of matrices that are not definite are left alone.
  /// @param definite  as factor() returned it
  void solve_refined(std::vector<LaneSystem>& systems, unsigned definite, VectorOps& ops);

 private:
  const LaneTables& tables() const { return *system_.pattern().lanes(); }
  void get(const LaneCholesky::Columns& from, int lane, Vector& v) const {
    v.resize(static_cast<std::size_t>(3 * tables().pattern.num_nodes()));
    LaneCholesky::get(tables().pattern, from, lane, v.data());
  }

  const ConstantSystem& system_;
  std::unique_ptr<LaneMemory> memory_;
};

}  // namespace diffsim
