// One implicit step of a soft body and its adjoint.
//
// Forward: x minimizes over free unknowns, with x = target on fixed ones,
//   g(x) = 1/2 (x - y)^T diag(inertia) (x - y) - force . x + E(x) + D(x) - p V(x)   (thesis
//   eq. 4.5, with the chambers of pressure.h)
// Backward (eq. 4.9, 4.10): with H = d^2 g/dx^2 on free unknowns, H z = dL/dx, and for any
// parameter p
//   dL/dp = -z . d(grad g)/dp.
// Every integrator of diffsim/soft is this problem with its own y, inertia and velocity frame.
#pragma once

#include "kernels/soft/constant_system.h"
#include "kernels/soft/elasticity.h"

namespace diffsim {

/// How the minimum is found; all meet the same tolerance (see implicit_step.cpp).
/// kLinearlyImplicit does not look for the minimum: one Newton step from the guess, linear_step.h.
enum class StepMethod {
  kAuto,
  kQuasiNewton,
  kNewtonPcg,
  kNewtonJacobi,
  kNewtonCholesky,
  kLinearlyImplicit
};

struct StepOptions {
  StepMethod method = StepMethod::kAuto;
  double rtol = 1e-6;  // of |inertia (y - mean y)| + |force|, see StepStats::scale
  double atol = 0.0;   // [N]
  int max_iters = 500;
  bool keep = false;  // whether an adjoint is likely to follow
};

struct StepInputs {
  SoftParameters parameters;
  /// Whether parameters and inertia have a batch axis, as all else has; the constant system is then
  /// one for all members, and serves to precondition only.
  bool per_member = false;
  const double* y = nullptr;           // (num_nodes, 3) [m]
  const double* force = nullptr;       // (num_nodes, 3) [N]
  const double* target = nullptr;      // (num_nodes, 3) [m], read at fixed unknowns
  const double* guess = nullptr;       // (num_nodes, 3) [m], start of the iteration
  const double* inertia = nullptr;     // (num_nodes,) [N/m]; null: the system's
  const double* x_frame = nullptr;     // (num_nodes, 3) [m], with damping only
  const double* x_velocity = nullptr;  // (num_nodes, 3) [m], with damping only
};

struct StepStats {
  double residual_norm = 0.0;       // |grad g| on free unknowns [N]
  double tolerance = 0.0;           // what it had to reach [N]
  double scale = 0.0;               // force scale that rtol refers to [N]
  double num_iters = 0.0;           // outer iterations (adjoint: of the Krylov solve)
  double num_solves = 0.0;          // solves with the constant factor
  double num_factorizations = 0.0;  // of the 3x3-block tangent
  double energy = 0.0;              // E + D at the answer [J]
  double converged = 0.0;           // 1 or 0
  double num_contacts = 0.0;     // nodes in contact at the answer; this and the next: contact only
  double num_slipping = 0.0;     // of these, how many slip
  double num_set_changes = 0.0;  // iterations that changed a contact's status
  double num_cycles = 0.0;       // times that statuses came round again and had to be resolved
};

/// @param[out] x (num_nodes, 3) [m]
StepStats implicit_step(const ConstantSystem& system, const StepInputs& inputs,
                        const StepOptions& options, double* x, ThreadPool& pool);

struct StepAdjoint {
  double* y = nullptr;        // (num_nodes, 3)
  double* force = nullptr;    // (num_nodes, 3)
  double* target = nullptr;   // (num_nodes, 3), zero at free unknowns
  double* guess = nullptr;    // (num_nodes, 3), of linearly implicit steps only
  double* inertia = nullptr;  // (num_nodes,); null where it is not asked for
  ParameterAdjoint parameters;
};

/// @param[in] x       (num_nodes, 3) answer of the forward step [m]
/// @param[in] grad_x  (num_nodes, 3) dL/dx [1/m]
StepStats implicit_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x, const double* grad_x,
                                const StepAdjoint& out, ThreadPool& pool);

/// Directions in the inputs of a step, (count, ...) each; null where none moves.
struct StepDirections {
  std::int64_t count = 0;
  const double* y = nullptr;        // (count, num_nodes, 3)
  const double* force = nullptr;    // (count, num_nodes, 3)
  const double* target = nullptr;   // (count, num_nodes, 3), read at fixed unknowns
  const double* inertia = nullptr;  // (count, num_nodes)
  const double* guess = nullptr;    // (count, num_nodes, 3), of linearly implicit steps only
  ParameterDirections parameters;
};

/// The answer's derivatives along many directions, all with one factor of H:
///   H dx = -d(grad g)/dp dp on free unknowns, dx = dtarget on fixed ones;
/// of a linearly implicit step H is that of its guess, and its right-hand side that of
/// linear_step.h.
/// @param[in]  x   (num_nodes, 3) answer of the forward step [m]
/// @param[out] dx  (count, num_nodes, 3)
/// @return of the worst direction; residual_norm and tolerance are relative to its right-hand side
StepStats implicit_step_tangent(const ConstantSystem& system, const StepInputs& inputs,
                                const StepOptions& options, const double* x,
                                const StepDirections& directions, double* dx, ThreadPool& pool);

/// Pointers of batch item k: leading batch axes on states, forces, activations and pressures;
/// parameters shared but where they are given per member.
StepInputs batch_item(const StepInputs& inputs, const SoftModel& model, std::int64_t k);
StepAdjoint batch_item(const StepAdjoint& adjoint, const SoftModel& model, std::int64_t k);

/// Steps of a batch of states; one item uses all threads, several share them.
/// @param[out] stats  (batch,)
void implicit_step_batch(const ConstantSystem& system, const StepInputs& inputs,
                         const StepOptions& options, std::int64_t batch, double* x,
                         StepStats* stats, int num_threads);
/// Every member of `out` has a leading batch axis, also those of shared parameters.
void implicit_step_adjoint_batch(const ConstantSystem& system, const StepInputs& inputs,
                                 const StepOptions& options, std::int64_t batch, const double* x,
                                 const double* grad_x, const StepAdjoint& out, StepStats* stats,
                                 int num_threads);

}  // namespace diffsim
