// Solves with the tangent of a small body.
#pragma once

#include "kernels/soft/step_problem.h"

namespace diffsim {

/// A system H z = b on free unknowns, b being zero on fixed ones.
struct SmallSystem {
  Vector b, z;
  Vector product;  // H z, what fixed unknowns feel included
  double tolerance = 0.0;
  KrylovResult result;  // num_iters counts solves with the factor
};

/// The matrix of a system with its memory, which is given back at the end.
class SmallSolver {
 public:
  explicit SmallSolver(const ConstantSystem& system)
      : system_(system), memory_(system.pattern().small_memories().take()) {}
  ~SmallSolver() {
    if (memory_) system_.pattern().small_memories().give_back(std::move(memory_));
  }
  SmallSolver(const SmallSolver&) = delete;
  SmallSolver& operator=(const SmallSolver&) = delete;

  /// Gives the matrix and its factor away; nothing can be solved any more.
  std::unique_ptr<SmallCholesky> release() { return std::move(memory_); }
  /// Takes a matrix that is factored.
  void adopt(std::unique_ptr<SmallCholesky> factored) {
    std::swap(memory_, factored);
    system_.pattern().small_memories().give_back(std::move(factored));
    is_factored_ = true;
  }
  /// Takes the tangent of a problem at x; of bodies without chambers.
  void assemble(StepProblem& problem, const Vector& x) {
    is_factored_ = false;
    memory_->clear(tables().pattern);
    problem.add_small_tangent(x, tables(), *memory_);
  }
  /// Factors it; false where it is not positive definite.
  bool factor() { return is_factored_ || memory_->factor(tables().pattern, system_.fixed()); }
  void solve(const Vector& b, Vector& x) {
    x.resize(b.size());
    memory_->solve(tables().pattern, b.data(), x.data());
  }
  void multiply(const Vector& x, Vector& y) {
    y.resize(x.size());
    memory_->multiply(tables().pattern, x.data(), y.data());
  }
  /// Factors and solves, with iterative refinement; not where the matrix is not definite.
  void solve_refined(SmallSystem& s, VectorOps& ops);

 private:
  const SmallTables& tables() const { return *system_.pattern().small(); }

  const ConstantSystem& system_;
  std::unique_ptr<SmallCholesky> memory_;
  bool is_factored_ = false;
};

}  // namespace diffsim
