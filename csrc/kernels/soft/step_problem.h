// The objective of one implicit step, its derivatives on free unknowns, and linear solves with
// them.
#pragma once

#include <functional>

#include "kernels/linalg/krylov.h"
#include "kernels/soft/block_matrix.h"
#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Whether a method's iterations are preconditioned by multigrid; the baselines' are not.
inline bool uses_multigrid(const ConstantSystem& system, StepMethod method) {
  return system.plan().preconditioner == Preconditioner::kMultigrid &&
         (method == StepMethod::kAuto || method == StepMethod::kNewtonPcg ||
          method == StepMethod::kLinearlyImplicit);
}

class StepProblem {
 public:
  /// @param by_multigrid  whether precondition() is a multigrid cycle, else the constant system
  StepProblem(const ConstantSystem& system, const StepInputs& inputs, ThreadPool& pool,
              bool by_multigrid = false);
  ~StepProblem();
  StepProblem(const StepProblem&) = delete;
  StepProblem& operator=(const StepProblem&) = delete;

  std::size_t size() const { return size_; }
  VectorOps& ops() { return ops_; }
  ElasticityScratch& scratch() { return memory_->elastic; }
  /// |inertia (y - mean y)| + |force| over free unknowns [N]: translation-invariant, and the norm
  /// that published implementations call the right-hand side.
  double scale() const { return scale_; }

  /// g(x) [J], its gradient with fixed entries zeroed [N], and the magnitude of the terms summed.
  double value_gradient(const Vector& x, Vector& gradient);
  double magnitude() const { return magnitude_; }
  double elastic_energy() const { return energy_; }

  /// Assembles d^2 g/dx^2 at x.
  /// @param by_old_multigrid  whether multigrid of an earlier one, if there is any, serves on
  void assemble(const Vector& x, bool clamp, bool by_old_multigrid = false);
  /// Where it was assembled last, or what multigrid is kept of (num_nodes, 3) [m].
  const Vector& assembled_at() const { return assembled_at_; }
  /// Adds the same, not clamped, to a matrix of a small body without chambers.
  void add_small_tangent(const Vector& x, const SmallTables& tables, SmallCholesky& to);
  /// out = H in on free unknowns; fixed entries of `in` must be zero, those of `out` are zeroed.
  void multiply(const Vector& in, Vector& out);
  /// The same without zeroing: forces that fixed unknowns feel.
  void multiply_all(const Vector& in, Vector& out);
  /// dL/dx - H z at fixed unknowns, of which it is the gradient that is left; zero elsewhere.
  Vector left_at_fixed(const double* grad_x, const Vector& z);
  void zero_fixed(Vector& v) const;
  /// -z . d(grad g)/dp for every input p, overwritten (eq. 4.10), and the targets' gradient.
  /// @param[in] rest  dL/dx - H z, read at fixed unknowns
  void input_gradients(const Vector& x, const Vector& z, const Vector& rest,
                       const StepAdjoint& out);

  /// The same of a linearly implicit step that led from the guess to x; see linear_step.h.
  void linear_input_gradients(const Vector& x, const Vector& z, const Vector& rest,
                              const StepAdjoint& out);

  /// d(grad g)/dp along directions in the parameters of the energy, pressures not, overwritten.
  /// @param[out] out  (count, size())
  void parameter_tangent(const Vector& x, std::int64_t count, const ParameterDirections& directions,
                         double* out);

  /// -d(grad g)/dp along each direction but the targets' [N], overwritten, fixed unknowns too.
  /// @param[out] out  (count, size())
  void load_tangents(const Vector& x, const StepDirections& directions, double* out);

  /// The same of a linearly implicit step that led from the guess to x; see linear_step.h.
  void linear_load_tangents(const Vector& x, const StepDirections& directions, double* out);

  /// z = A^-1 r.
  void solve_constant(const Vector& r, Vector& z);
  /// z = P^-1 r, P the constant system, or a multigrid cycle on the tangent that was assembled last
  /// (which must have been).
  void precondition(const Vector& r, Vector& z);
  bool by_multigrid() const { return by_multigrid_; }
  /// Nodes that multigrid holds from here on; precondition() then needs r, and gives z, within what
  /// they may do (rigid_multigrid.h).
  void hold_nodes(std::vector<HeldNode> held);
  /// The tangent that was assembled last serves to precondition from here on, whatever comes.
  void keep_multigrid();
  /// z = (3x3 diagonal blocks of H)^-1 r, zero on fixed unknowns; r is read there, too.
  void solve_jacobi(const Vector& r, Vector& z);
  /// Factorizes H; false where it is not positive definite.
  /// @param[in] edit   changes the (num_blocks, 3, 3) blocks first, if not empty
  /// @param precision  of the factor as it is stored, the same every time
  bool factorize(const std::function<void(double*)>& edit = {},
                 FactorPrecision precision = FactorPrecision::kFloat64);
  /// The same for what only preconditions or approximates: a large one is of single precision.
  bool factorize_roughly(const std::function<void(double*)>& edit = {});
  void solve_factorized(const Vector& r, Vector& z);
  /// In place, (size(), count) row-major.
  void solve_factorized_many(double* columns, int count);
  /// Rows and columns of H^-1 at some nodes, (3 count, 3 count), from its factor.
  void inverse_among(const std::vector<std::int64_t>& nodes, double* inverse);

  int num_solves = 0;
  int num_factorizations = 0;

 private:
  /// Those of inertia, loads, targets and damping, whose energies are quadratic: the same of both
  /// kinds of steps.
  /// @return -z
  Vector quadratic_gradients(const Vector& x, const Vector& z, const Vector& rest,
                             const StepAdjoint& out);
  void prepare_multigrid();
  void prepare_jacobi();
  /// The diagonal block of node i (block3.h).
  const double* diagonal_block(std::int64_t i) const;
  const double* inertia() const { return in_.inertia ? in_.inertia : system_.inertia(); }

  const ConstantSystem& system_;
  const StepInputs& in_;
  ThreadPool& pool_;
  VectorOps ops_;
  std::size_t size_;
  double scale_ = 0.0, magnitude_ = 0.0, energy_ = 0.0;
  DampingFrames frames_;
  std::unique_ptr<StepMemory> memory_;
  ConstantSystem::Scratch constant_;
  CholeskyWorkspace cholesky_;
  AlignedBuffer<double> blocks_;
  Vector jacobi_;  // (num_nodes, 6) of H as assembled: lower triangles by rows; or empty
  std::vector<CholeskyFactor> factor_;  // none or one
  Vector assembled_at_;
  std::vector<HeldNode> held_;
  bool by_multigrid_, is_multigrid_stale_ = true, is_multigrid_kept_ = false;
};

}  // namespace diffsim
