// The minimal state of 12 that a linear feedback reads, and the clamped thrust commands.
//
// x12: position, roll, pitch, yaw (R = Rz Ry Rx), velocity in the body frame, rates of roll, pitch,
// yaw. Roll and yaw of x12 - reference are taken the short way round. At pitch +-90 degrees the
// angles do not exist and the rates are infinite.
#pragma once

#include "kernels/copter/flight_layout.h"
#include "kernels/copter/flight_math.h"

namespace diffsim::flight {

template <class T>
struct FeedbackTrace {
  T R[9];
  T cos_pitch, sin_roll, cos_roll, tan_pitch, turn;  // turn: rate about the body's lean
};

inline V angle(const V& y, const V& x) {
  return each(y, x, [](double a, double b) { return std::atan2(a, b); });
}
/// Adds the gradients of atan2(y, x).
DIFFSIM_INLINE void angle_vjp(const V& y, const V& x, V grad, V& grad_y, V& grad_x) {
  const V scaled = grad / (x * x + y * y);
  grad_y += scaled * x;
  grad_x -= scaled * y;
}

template <class T>
inline void feedback_state(const T* x, FeedbackTrace<T>& tr, T* x12) {
  const T *v = x + kVelocity, *w = x + kRates;
  rotation(x + kQuaternion, tr.R);
  const T* R = tr.R;
  tr.cos_pitch = sqrt(R[7] * R[7] + R[8] * R[8]);
  tr.sin_roll = R[7] / tr.cos_pitch;
  tr.cos_roll = R[8] / tr.cos_pitch;
  tr.tan_pitch = -R[6] / tr.cos_pitch;
  tr.turn = tr.sin_roll * w[1] + tr.cos_roll * w[2];
  for (int k = 0; k < 3; ++k) x12[k] = x[k];
  x12[3] = angle(R[7], R[8]);
  x12[4] = angle(-R[6], tr.cos_pitch);
  x12[5] = angle(R[3], R[0]);
  for (int k = 0; k < 3; ++k) x12[6 + k] = T{};
  add_transposed(R, v, x12 + 6);
  x12[9] = w[0] + tr.tan_pitch * tr.turn;
  x12[10] = tr.cos_roll * w[1] - tr.sin_roll * w[2];
  x12[11] = tr.turn / tr.cos_pitch;
}

inline void feedback_state_vjp(const V* x, const FeedbackTrace<V>& tr, const V* g, V* grad_x) {
  const V *v = x + kVelocity, *w = x + kRates, *R = tr.R;
  V* grad_w = grad_x + kRates;
  V grad_R[9] = {};
  const V inverse = 1.0 / tr.cos_pitch;
  const V grad_turn = g[9] * tr.tan_pitch + g[11] * inverse;
  const V grad_sin = grad_turn * w[1] - g[10] * w[2], grad_cos = grad_turn * w[2] + g[10] * w[1];
  grad_w[0] += g[9];
  grad_w[1] += grad_turn * tr.sin_roll + g[10] * tr.cos_roll;
  grad_w[2] += grad_turn * tr.cos_roll - g[10] * tr.sin_roll;
  const V grad_tan = g[9] * tr.turn;
  V grad_cos_pitch = -inverse * (g[11] * tr.turn * inverse + grad_sin * tr.sin_roll +
                                 grad_cos * tr.cos_roll + grad_tan * tr.tan_pitch);
  V grad_minus_R6 = grad_tan * inverse;
  grad_R[7] += grad_sin * inverse;
  grad_R[8] += grad_cos * inverse;
  angle_vjp(R[7], R[8], g[3], grad_R[7], grad_R[8]);
  angle_vjp(-R[6], tr.cos_pitch, g[4], grad_minus_R6, grad_cos_pitch);
  angle_vjp(R[3], R[0], g[5], grad_R[3], grad_R[0]);
  grad_R[6] -= grad_minus_R6;
  grad_R[7] += grad_cos_pitch * tr.sin_roll;
  grad_R[8] += grad_cos_pitch * tr.cos_roll;
  add(broadcast<V>(1.0), g, grad_x);
  add_product(R, g + 6, grad_x + kVelocity);
  add_outer(broadcast<V>(1.0), v, g + 6, grad_R);
  rotation_vjp(x + kQuaternion, grad_R, grad_x + kQuaternion);
}

/// An angle the short way round.
inline V wrapped(const V& a) {
  constexpr double kTurn = 6.283185307179586476925286766559;
  return each(a, a, [](double x, double) { return x - kTurn * std::nearbyint(x / kTurn); });
}

/// x12 - reference, angles the short way round.
template <class T>
inline void feedback_error(const T* x12, const T* reference, T* error) {
  for (int k = 0; k < kFeedback; ++k) error[k] = x12[k] - reference[k];
  for (int k : {3, 5}) error[k] = wrapped(error[k]);
}

}  // namespace diffsim::flight
