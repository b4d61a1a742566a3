// Which preconditioner a step should start with, decided once per constant system.
//
// Conjugate gradients on the constant factor cost little per iteration but need more of them as the
// body grows, as its stiffness varies from place to place and as the material nears
// incompressibility. A multigrid cycle on the tangent (rigid_multigrid.h) costs more and needs few,
// whatever the size and the contrast. A factor of the tangent costs much once and then needs
// hardly any. The plan measures the iterations at rest and weighs them by a model of the costs. It
// depends on the system alone, never on clocks or history, so results are reproducible.
#pragma once

#include "kernels/soft/elasticity.h"

namespace diffsim {

class ConstantSystem;
struct ConstantSystemInputs;

// Iterations of a plan are those to 10^-digits.
constexpr double kProbeDigits = 2.0;
// On factors of the tangent, over a whole forward step.
constexpr double kTangentIterations = 12.0;
// Tangents that a step preconditions on, one after the other.
constexpr double kSetupsPerStep = 3.0;

/// What conjugate gradients are preconditioned by where no factor of the tangent pays.
enum class Preconditioner { kAuto, kConstant, kMultigrid };

/// Costs in seconds on a model machine; only their ratios matter.
struct SolverPlan {
  Preconditioner preconditioner = Preconditioner::kConstant;  // never kAuto
  double iterations = 0.0;      // of conjugate gradients on it at rest, to 1e-2
  double iteration_cost = 0.0;  // one of these
  double setup_cost = 0.0;      // of the preconditioner, on each new tangent
  double tangent_cost = 0.0;    // one iteration on a factor of the tangent
  double factorize_cost = 0.0;  // of the tangent; infinite where memory forbids it
  // Of plans for contact only:
  double contact_iterations = 0.0;  // on the constant factor with the body's rotations beside it
  double jacobi_iterations = 0.0;   // as `iterations`, preconditioned by 3x3 diagonal blocks
  double jacobi_cost = 0.0;         // one of these

  /// Whether a forward step to relative tolerance rtol should factorize the tangent.
  bool factorize_step(double rtol) const;
  /// Seconds of a step in contact to relative tolerance rtol without a factor of the tangent.
  double contact_cost(double rtol) const;
  /// Iterations to relative tolerance rtol with the tangent of an answer, of those at rest.
  static double answer_iterations(double at_rest, double rtol);
  /// Seconds of so many solves with a factor of that tangent.
  double factorized_cost(double count = 1.0) const;
  /// Whether so many solves with the tangent of an answer should.
  bool factorize_adjoint(double rtol, double count = 1.0) const;
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

/// Whether multigrid is worth trying on a body.
bool suits_multigrid(const SoftModel& model);

/// The plan on one of the two preconditioners.
/// @param[in] inputs  the system's; activation is ignored (fibers at rest)
SolverPlan make_solver_plan(const ConstantSystem& system, const ConstantSystemInputs& inputs,
                            Preconditioner preconditioner, ThreadPool& pool);

}  // namespace diffsim
