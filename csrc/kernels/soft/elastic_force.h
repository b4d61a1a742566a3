// The elastic, damping and pressure force as a function of its own, for explicit stepping and for
// energies.
#pragma once

#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Gradient of E + D - p V [N] and, in energy[0], that sum [J].
void elastic_gradient(const SoftModel& model, const StepInputs& inputs, const double* x,
                      double* gradient, double* energy, int num_threads);

/// grad_x = d^2(E + D - p V)/dx^2 z, and z . d(gradient)/dp for the parameters p.
void elastic_gradient_adjoint(const SoftModel& model, const StepInputs& inputs, const double* x,
                              const double* z, double* grad_x, const ParameterAdjoint& out,
                              int num_threads);

}  // namespace diffsim
