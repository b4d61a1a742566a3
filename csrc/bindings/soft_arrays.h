// Arrays of a soft body as Python hands them over.
#pragma once

#include "bindings/bindings.h"
#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Addresses that Python fills by name; zero means absent. The names and sizes are those of
/// diffsim/soft/_arrays.py; here and there every array is passed on by its name.
struct SoftArrays {
  Address weights = 0, fiber_stiffness = 0, activation = 0, damp_mu = 0, damp_lambda = 0;
  Address pressure = 0, tables = 0;
  Address y = 0, force = 0, target = 0, guess = 0, inertia = 0, x_frame = 0, x_velocity = 0;

  bool per_member = false;  // parameters and inertia have a batch axis

  StepInputs inputs() const {
    StepInputs step;
    step.per_member = per_member;
    step.parameters.weights = in(weights);
    step.parameters.fiber_stiffness = in(fiber_stiffness);
    step.parameters.activation = in(activation);
    step.parameters.damp_mu = in(damp_mu);
    step.parameters.damp_lambda = in(damp_lambda);
    step.parameters.pressure = in(pressure);
    step.y = in(y);
    step.force = in(force);
    step.target = in(target);
    step.guess = in(guess);
    step.inertia = in(inertia);
    step.x_frame = in(x_frame);
    step.x_velocity = in(x_velocity);
    return step;
  }

  StepAdjoint adjoint() const {
    StepAdjoint grads;
    grads.y = out(y);
    grads.force = out(force);
    grads.target = out(target);
    grads.guess = out(guess);
    grads.inertia = out(inertia);
    grads.parameters.weights = out(weights);
    grads.parameters.fiber_stiffness = out(fiber_stiffness);
    grads.parameters.activation = out(activation);
    grads.parameters.damp_mu = out(damp_mu);
    grads.parameters.damp_lambda = out(damp_lambda);
    grads.parameters.x_frame = out(x_frame);
    grads.parameters.x_velocity = out(x_velocity);
    grads.parameters.pressure = out(pressure);
    grads.parameters.tables = out(tables);
    return grads;
  }

  StepDirections directions(std::int64_t count) const {
    StepDirections rates;
    rates.count = count;
    rates.y = in(y);
    rates.force = in(force);
    rates.target = in(target);
    rates.inertia = in(inertia);
    rates.guess = in(guess);
    rates.parameters.weights = in(weights);
    rates.parameters.fiber_stiffness = in(fiber_stiffness);
    rates.parameters.activation = in(activation);
    rates.parameters.damp_mu = in(damp_mu);
    rates.parameters.damp_lambda = in(damp_lambda);
    rates.parameters.x_frame = in(x_frame);
    rates.parameters.x_velocity = in(x_velocity);
    rates.parameters.pressure = in(pressure);
    rates.parameters.tables = in(tables);
    return rates;
  }
};

}  // namespace diffsim
