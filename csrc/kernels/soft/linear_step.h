// A linearly implicit step and its adjoint: one Newton step from the guess, one linear solve.
//
// With g of implicit_step.h, linearized at the guess q (the old positions),
//   grad g(q) + H(q) (x - q) = 0 on free unknowns, x = target on fixed ones.
// No line search and no iteration over it: x is a smooth function of the inputs and of q, and
//   H z = dL/dx,  dL/dp = -z . d(grad g(q) + H(q) (x - q))/dp,
// where dL/dq needs the third derivative of the energy along z and x - q (elastic_second.h).
// Forward mode is the transpose, H dx = -d(grad g(q) + H(q) (x - q))/dp dp, see
// implicit_tangent.cpp. For implicit Euler this is the linearly implicit (Rosenbrock-) Euler
// method.
#pragma once

#include "kernels/soft/implicit_step.h"
#include "kernels/soft/step_problem.h"

namespace diffsim {

/// @param[out] x  (num_nodes, 3) [m]
StepStats linear_step(const ConstantSystem& system, const StepInputs& inputs,
                      const StepOptions& options, double* x, ThreadPool& pool);
/// @param[in] x       (num_nodes, 3) answer of the step [m]
/// @param[in] grad_x  (num_nodes, 3) dL/dx [1/m]
StepStats linear_step_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                              const StepOptions& options, const double* x, const double* grad_x,
                              const StepAdjoint& out, ThreadPool& pool);

/// The right-hand side of a linearly implicit step.
struct LinearProblem {
  Vector q, moved;  // where it is linearized; how fixed unknowns move, else zero
  Vector b;         // -grad g(q), without what the moved ones push
  bool is_pushed = false;

  LinearProblem(const ConstantSystem& system, StepProblem& problem, const StepInputs& inputs);
  /// Takes H times the moved unknowns off.
  void push(const StepProblem& problem, const Vector& pushed);
  /// Positions from the solution z on free unknowns.
  void finish(const Vector& z, double* x) const;
  StepStats begin_stats(StepProblem& problem, const StepOptions& options);
};

}  // namespace diffsim
