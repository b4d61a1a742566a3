// Initial value problems x' = f(t, x, u, p), y = g(t, x, u, p) with f and g as tapes.
//
// Classical Runge-Kutta of fourth order with a fixed number of steps between two samples, inputs
// linear or held between samples, states kept within limits after each step. The adjoint goes back
// through the same steps (discretize, then differentiate), so it is exact for what was computed.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/ode/tape.h"
#include "kernels/stop.h"

namespace diffsim {

/// What one problem is made of. Given registers: t, x (n), u (m), p (q), then constants.
struct OdeProblem {
  Tape tape;                        ///< f and g
  const std::int64_t* rate_out;     ///< (num_states) registers of f
  const std::int64_t* reading_out;  ///< (num_channels) registers of g
  const double* constants;          ///< (num_constants)
  const double* times;              ///< (batch or 1, num_samples), none before the last [s]
  const double* lower;              ///< (num_states) limits, -inf: none
  const double* upper;              ///< (num_states)
  const std::int64_t* held;         ///< (num_inputs) 1: constant until the next sample, 0: linear
  std::int64_t num_states, num_inputs, num_parameters, num_constants, num_channels;
  std::int64_t num_samples, num_steps, batch;  ///< num_steps between two samples
  std::int64_t input_stride;  ///< from one member's inputs to the next one's; 0: shared
  std::int64_t time_stride;   ///< from one member's times to the next one's; 0: shared
};

/// @param[in]  start      (batch, num_states)
/// @param[in]  inputs     (batch or 1, num_samples, num_inputs)
/// @param[in]  parameters (batch, num_parameters)
/// @param[out] readings   (batch, num_samples, num_channels)
/// @param[out] states     (batch, num_samples, num_states)
void integrate(const OdeProblem& problem, const double* start, const double* inputs,
               const double* parameters, double* readings, double* states, int num_threads,
               Stop& stop);

/// dL/d(start, inputs, parameters) from dL/d(readings, states).
/// @param[in]  states          as `integrate` gave them
/// @param[out] grad_start      (batch, num_states)
/// @param[out] grad_inputs     (batch, num_samples, num_inputs), also where inputs are shared
/// @param[out] grad_parameters (batch, num_parameters)
void integrate_vjp(const OdeProblem& problem, const double* inputs, const double* parameters,
                   const double* states, const double* grad_readings, const double* grad_states,
                   double* grad_start, double* grad_inputs, double* grad_parameters,
                   int num_threads, Stop& stop);

/// Readings and states along one direction of start, inputs and parameters.
/// @param[in]  d_start, d_inputs, d_parameters  of the sizes of start, inputs and parameters
/// @param[out] d_readings  (batch, num_samples, num_channels)
/// @param[out] d_states    (batch, num_samples, num_states)
void integrate_tangent(const OdeProblem& problem, const double* start, const double* inputs,
                       const double* parameters, const double* d_start, const double* d_inputs,
                       const double* d_parameters, double* d_readings, double* d_states,
                       int num_threads, Stop& stop);

}  // namespace diffsim
