// Batched flight of multicopters: classical Runge-Kutta of order four, its adjoint and its tangent.
//
// NED. One control step reads the state, computes the thrust commands
//   c = clamp(feed_forward - K (x12 - reference), 0, u_max)
// and holds them for `substeps` steps of `dt`. The gradient of the clamp is one outside of neither
// bound (an entry exactly on a bound counts as inside).
#pragma once

#include <cstdint>

#include "kernels/copter/flight_layout.h"
#include "kernels/stop.h"

namespace diffsim {

/// Rows of numbers per vehicle and control step; a stride of zero shares a row.
struct FlightRows {
  const double* data = nullptr;
  std::int64_t vehicle_stride = 0, step_stride = 0;
};

/// Gradients of such rows, zeroed by the caller. Where vehicles share rows, every group of kGroup
/// vehicles has its own (stride: between groups), to be summed afterwards.
struct FlightGrads {
  double* data = nullptr;
  bool shared = false;
  std::int64_t stride = 0, step_stride = 0;
};

constexpr int kGroup = 8;

struct FlightOptions {
  double dt = 0.0;  ///< of an integration step [s]
  double gravity = 0.0;
  int substeps = 1;
  // which optional effects are there
  bool feedback = false, motor_lag = false, thrust_curve = false, rotor_drag = false;
  bool body_drag = false, ground_effect = false, interference = false, battery = false;
  bool free_thrusts = false;  ///< commands are not clamped to 0..max_thrusts
  bool end_alone = false;     ///< one record per vehicle is wanted, that of the end
};

struct FlightInputs {
  FlightRows start;         ///< kBody + num_rotors
  FlightRows feed_forward;  ///< num_rotors [N]
  FlightRows gain;          ///< num_rotors x 12
  FlightRows reference;     ///< 12
  FlightRows wind;          ///< 3, world frame [m/s]
  FlightRows parameters;    ///< FlightLayout
};

struct FlightInputGrads {
  FlightGrads start, feed_forward, gain, reference, wind, parameters;
};

/// @param[out] records (batch, steps + 1, kBody + num_rotors); record 0 is the start. With
///                     end_alone (batch, 1, kBody + num_rotors)
void flight_rollout(int num_rotors, std::int64_t batch, std::int64_t steps,
                    const FlightOptions& options, const FlightInputs& inputs, double* records,
                    int num_threads, Stop& stop);

/// Adjoint of flight_rollout.
/// @param[in] records      all of them, as checkpoints
/// @param[in] grad_records same shape as what flight_rollout wrote
void flight_rollout_vjp(int num_rotors, std::int64_t batch, std::int64_t steps,
                        const FlightOptions& options, const FlightInputs& inputs,
                        const double* records, const double* grad_records,
                        const FlightInputGrads& grads, int num_threads, Stop& stop);

/// Records along one direction in the inputs.
/// @param[in]  directions  of the same sizes, with strides of their own
/// @param[out] rates       same shape as what flight_rollout writes
void flight_rollout_tangent(int num_rotors, std::int64_t batch, std::int64_t steps,
                            const FlightOptions& options, const FlightInputs& inputs,
                            const FlightInputs& directions, double* rates, int num_threads,
                            Stop& stop);

}  // namespace diffsim
