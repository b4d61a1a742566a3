// Steps of small bodies, whose tangents small_cholesky.h factors.
//
// A step makes one factor, where it begins, and goes on by it: L-BFGS whose initial inverse Hessian
// is that factor. It is nearly exact, so that two or three gradients end the search.
#pragma once

#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Whether steps (adjoints) of a system go this way.
bool steps_are_small(const ConstantSystem& system, const StepOptions& options);
bool adjoints_are_small(const ConstantSystem& system, const StepOptions& options);

/// Arguments as of implicit_step.
StepStats small_step(const ConstantSystem& system, const StepInputs& inputs,
                     const StepOptions& options, double* x, ThreadPool& pool);
/// A linearly implicit one, linear_step.h.
StepStats small_linear_step(const ConstantSystem& system, const StepInputs& inputs,
                            const StepOptions& options, double* x, ThreadPool& pool);
/// The adjoint of either; arguments as of implicit_step_adjoint.
StepStats small_adjoint(const ConstantSystem& system, const StepInputs& inputs,
                        const StepOptions& options, const double* x, const double* grad_x,
                        const StepAdjoint& out, ThreadPool& pool);

}  // namespace diffsim
