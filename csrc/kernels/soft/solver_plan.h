// Which preconditioner a step should start with, decided once per constant system.
//
// Conjugate gradients on the constant factor cost little per iteration but need more of them as the
// material nears incompressibility; a factor of the tangent costs much once and then needs few. The
// plan measures the iterations at rest and weighs them by a model of the two costs. It depends on
// the system alone, never on clocks or history, so results are reproducible.
#pragma once

#include "kernels/soft/elasticity.h"

namespace diffsim {

class ConstantSystem;

// Iterations of a plan are those to 10^-digits.
constexpr double kProbeDigits = 2.0;
// On factors of the tangent, over a whole forward step.
constexpr double kTangentIterations = 12.0;

/// Costs in seconds on a model machine; only their ratios matter.
struct SolverPlan {
  double iterations = 0.0;         // of conjugate gradients at rest, to 1e-2
  double constant_cost = 0.0;      // one iteration on the constant factor
  double tangent_cost = 0.0;       // one iteration on a factor of the tangent
  double factorize_cost = 0.0;     // of the tangent; infinite where memory forbids it
  double jacobi_iterations = 0.0;  // as `iterations`, preconditioned by 3x3 diagonal blocks
  double jacobi_cost = 0.0;        // one of these

  /// Whether a forward step (an adjoint) to relative tolerance rtol should factorize the tangent.
  bool factorize_step(double rtol) const;
  bool factorize_adjoint(double rtol) const;
  /// Iterations at this cost after which a factor of the tangent would have been cheaper.
  int patience(double cost) const;
  /// Iterations on an old factor of the tangent after which a new one is worth making.
  int refactor_after() const;
};

/// Modeled seconds to stream bytes, and to do arithmetic in blocked kernels.
double streaming_cost(double bytes);
double flop_cost(double flops);
/// Decimal digits that a relative tolerance asks for, at least one.
double decades(double rtol);

/// @param[in] parameters  the system's; activation is ignored (fibers at rest)
SolverPlan make_solver_plan(const ConstantSystem& system, const SoftParameters& parameters,
                            ThreadPool& pool);

}  // namespace diffsim
