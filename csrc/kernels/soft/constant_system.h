// The constant system of projective dynamics, A = diag(inertia) + sum of kappa G^T G (eq. 4.15),
// factorized once and used by the forward step and by its adjoint. Where multigrid on the tangent
// is the better preconditioner, A is not factorized at all.
//
// A acts on each coordinate alone, so one scalar factor (n x n) serves three right-hand sides. An
// axis with its own Dirichlet set needs its own factor; axes with equal sets share one.
#pragma once

#include <memory>
#include <mutex>

#include "kernels/linalg/cholesky.h"
#include "kernels/soft/inverse_columns.h"
#include "kernels/soft/small_tangent.h"
#include "kernels/soft/soft_model.h"
#include "kernels/soft/solver_plan.h"
#include "kernels/soft/step_memory.h"
#include "kernels/vector_ops.h"

namespace diffsim {

/// How a small body is factored.
struct SmallTables {
  SmallPattern pattern;
  SmallPlaces places;
};

/// A model with the symbolic factorizations of its scalar and 3x3-block patterns, made when needed.
class SoftPattern {
 public:
  SoftPattern(SoftModel model, const double* coords);
  const SoftModel& model() const { return model_; }
  const double* coords() const { return coords_.data(); }  // (num_nodes, 3) rest positions [m]
  std::shared_ptr<const CholeskySymbolic> scalar() const;
  std::shared_ptr<const CholeskySymbolic> blocks() const;
  std::shared_ptr<const RigidHierarchy> hierarchy() const;
  /// Null where a body is too large for it, or has chambers, whose stiffness it leaves out.
  const SmallTables* small() const;
  StepMemories& memories() const { return memories_; }
  IdleMemories<SmallCholesky>& small_memories() const { return small_memories_; }

 private:
  SoftModel model_;
  std::vector<double> coords_;
  mutable std::once_flag scalar_once_, blocks_once_, hierarchy_once_, small_once_;
  mutable std::shared_ptr<const CholeskySymbolic> scalar_, blocks_;
  mutable std::shared_ptr<const RigidHierarchy> hierarchy_;
  mutable std::unique_ptr<const SmallTables> small_;
  mutable StepMemories memories_;
  mutable IdleMemories<SmallCholesky> small_memories_;
};

/// What A is made of and what the plan is for; everything the content depends on.
struct ConstantSystemInputs {
  const std::uint8_t* fixed = nullptr;  // (num_nodes, 3), 1 where Dirichlet
  const double* inertia = nullptr;      // (num_nodes,) [N/m]
  const double* kappa = nullptr;        // (num_elements,) [Pa]
  const double* fiber_kappa = nullptr;  // (num_fibers,) [Pa]
  SoftParameters parameters;            // of the energy; activation unused
  Preconditioner preconditioner = Preconditioner::kAuto;
  bool in_contact = false;  // whether the plan is for steps in contact
};

/// Immutable once made; throws NotPositiveDefinite for a body that nothing holds.
class ConstantSystem {
 public:
  struct Scratch {
    CholeskyWorkspace cholesky;
    Vector column;
  };

  ConstantSystem(std::shared_ptr<const SoftPattern> pattern, const ConstantSystemInputs& inputs,
                 ThreadPool& pool);
  ConstantSystem(const ConstantSystem&) = delete;
  ConstantSystem& operator=(const ConstantSystem&) = delete;

  const SoftModel& model() const { return pattern_->model(); }
  const SoftPattern& pattern() const { return *pattern_; }
  const std::uint8_t* fixed() const { return fixed_.data(); }
  const double* inertia() const { return inertia_.data(); }
  const double* diagonal() const { return diagonal_.data(); }  // of A, (num_nodes,) [N/m]
  const SolverPlan& plan() const { return plan_; }
  std::int64_t factor_bytes() const;

  /// z = A^-1 r on free unknowns, zero on fixed ones, where the plan is on the constant factor; r
  /// is (num_nodes, 3), zero on fixed ones.
  void solve(const Vector& r, Vector& z, Scratch& scratch, ThreadPool& pool) const;

  /// Scalar factors: axes with equal Dirichlet sets share one.
  int num_factors() const { return static_cast<int>(factors_.size()); }
  const CholeskyFactor& factor(int f) const { return factors_[static_cast<std::size_t>(f)].factor; }
  int factor_of_axis(int axis) const;
  /// What rounding alone leaves of the gradient at x (num_nodes, 3) [N]: a relative error eps of
  /// the positions appears in each node's force as eps |x| times the node's stiffness. No iteration
  /// gets below it.
  double rounding_floor(const Vector& x) const;
  InverseColumns& inverse_columns() const { return inverse_columns_; }
  KeptSteps& kept_steps() const { return kept_steps_; }

 private:
  struct AxisFactor {
    std::vector<int> axes;
    CholeskyFactor factor;
  };
  void factorize(const Vector& values, ThreadPool& pool);

  std::shared_ptr<const SoftPattern> pattern_;
  std::vector<std::uint8_t> fixed_;
  Vector inertia_, diagonal_;
  std::vector<AxisFactor> factors_;
  SolverPlan plan_;
  mutable InverseColumns inverse_columns_;
  mutable KeptSteps kept_steps_;
};

}  // namespace diffsim
