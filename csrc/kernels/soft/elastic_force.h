// The elastic, damping and pressure force as a function of its own, for explicit stepping and for
// energies.
#pragma once

#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Gradients of E + D - p V [N] and, in energy (batch,), these sums [J], of a batch of positions.
void elastic_gradient(const SoftModel& model, const StepInputs& inputs, std::int64_t batch,
                      const double* x, double* gradient, double* energy, int num_threads);

/// grad_x = d^2(E + D - p V)/dx^2 z, and z . d(gradient)/dp for the parameters p.
void elastic_gradient_adjoint(const SoftModel& model, const StepInputs& inputs, const double* x,
                              const double* z, double* grad_x, const ParameterAdjoint& out,
                              int num_threads);

/// The gradient along one direction of positions and parameters [N], overwritten.
/// @param[in]  dx   (num_nodes, 3) [m]; null: positions do not move
/// @param[out] out  (num_nodes, 3)
void elastic_gradient_tangent(const SoftModel& model, const StepInputs& inputs, const double* x,
                              const double* dx, const ParameterDirections& directions, double* out,
                              int num_threads);

/// d(E - p V)/dp [J] by the parameters of one item, without damping.
void elastic_energy_slopes(const SoftModel& model, const StepInputs& inputs, const double* x,
                           const ParameterAdjoint& out, int num_threads);

}  // namespace diffsim
