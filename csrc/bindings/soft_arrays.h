// Arrays of a soft body as Python hands them over.
#pragma once

#include "bindings/bindings.h"
#include "kernels/soft/implicit_step.h"

namespace diffsim {

/// Addresses that Python fills by name; zero means absent.
struct SoftArrays {
  Address w_mu = 0, w_vol = 0, fibre_stiffness = 0, activation = 0, damp_mu = 0, damp_lambda = 0;
  Address pressure = 0;
  Address y = 0, force = 0, target = 0, guess = 0, inertia = 0, x_frame = 0, x_velocity = 0;

  StepInputs inputs() const {
    StepInputs in;
    in.parameters = {diffsim::in(w_mu),       diffsim::in(w_vol),   diffsim::in(fibre_stiffness),
                     diffsim::in(activation), diffsim::in(damp_mu), diffsim::in(damp_lambda),
                     diffsim::in(pressure)};
    in.y = diffsim::in(y);
    in.force = diffsim::in(force);
    in.target = diffsim::in(target);
    in.guess = diffsim::in(guess);
    in.x_frame = diffsim::in(x_frame);
    in.x_velocity = diffsim::in(x_velocity);
    return in;
  }
  StepAdjoint adjoint() const {
    StepAdjoint grads;
    grads.y = out(y);
    grads.force = out(force);
    grads.target = out(target);
    grads.inertia = out(inertia);
    grads.parameters = {out(w_mu),       out(w_vol),      out(fibre_stiffness),
                        out(activation), out(damp_mu),    out(damp_lambda),
                        out(x_frame),    out(x_velocity), out(pressure)};
    return grads;
  }
  StepDirections directions(std::int64_t count) const {
    const StepInputs in = inputs();
    const SoftParameters& p = in.parameters;
    return {count,
            in.y,
            in.force,
            in.target,
            diffsim::in(inertia),
            {p.w_mu, p.w_vol, p.fibre_stiffness, p.activation, p.damp_mu, p.damp_lambda, in.x_frame,
             in.x_velocity, p.pressure}};
  }
};

}  // namespace diffsim
