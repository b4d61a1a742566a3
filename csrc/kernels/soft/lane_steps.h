// Steps of small bodies, several at a time: their tangents are factored in the lanes of a register.
//
// A step makes one factor, where it begins, and goes on by it: L-BFGS whose initial inverse Hessian
// is that factor. It is nearly exact, so that two or three gradients end the search. Members share
// factorizations and solves and nothing else; a member's bits do not depend on the others.
#pragma once

#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Whether steps (adjoints) of a system go by lanes.
bool steps_in_lanes(const ConstantSystem& system, const StepOptions& options);
bool adjoints_in_lanes(const ConstantSystem& system, const StepOptions& options);

/// Members [first, first + count) of a batch, at most LaneCholesky::kCount; arguments as of
/// implicit_step_batch.
void lane_steps(const ConstantSystem& system, const StepInputs& inputs, const StepOptions& options,
                std::int64_t first, int count, double* x, StepStats* stats, ThreadPool& pool);
/// Linearly implicit ones, linear_step.h.
void lane_linear_steps(const ConstantSystem& system, const StepInputs& inputs,
                       const StepOptions& options, std::int64_t first, int count, double* x,
                       StepStats* stats, ThreadPool& pool);
/// Adjoints of either.
void lane_adjoints(const ConstantSystem& system, const StepInputs& inputs,
                   const StepOptions& options, std::int64_t first, int count, const double* x,
                   const double* grad_x, const StepAdjoint& out, StepStats* stats,
                   ThreadPool& pool);

}  // namespace diffsim
