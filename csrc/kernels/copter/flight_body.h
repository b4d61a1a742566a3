// Time derivative of the rigid body's state, and its vjp.
//
//   p' = v,  q' = q (0, w) / 2,  v' = g e_z + R F / m,  w' = J^-1 (M - w x J w),  charge' = -I / C
//   F = sum_i e_i - D1 a - D2 |a| a,   M = sum_i r_i x e_i + b_i lambda_i d_i bench_i
//   e_i = u_i (d_i - k (I - d_i d_i') (a + w x r_i)),   a = R' (v - wind)
// The reaction torque follows the bench thrust: what the ground or another rotor does to the thrust
// leaves the torque of the shaft as it is.
#pragma once

#include "kernels/copter/flight_rotors.h"

namespace diffsim::flight {

template <class T>
struct BodyTrace {
  RotorTrace<T> rotors;
  T R[9], world_air[3], air[3], speed;  // velocity relative to the air
  T force[3], torque[3];                // torque: M - w x J w
  T momentum[3];
};

/// Velocity of a hub across its axis, relative to the air.
template <class T>
DIFFSIM_INLINE void across(const T* air, const T* w, const T* arm, const T* axis, T* hub,
                           T* crossing) {
  for (int k = 0; k < 3; ++k) hub[k] = air[k];
  add_cross(w, arm, hub);
  const T along = dot(axis, hub);
  for (int k = 0; k < 3; ++k) crossing[k] = hub[k] - along * axis[k];
}

template <class T>
inline void body_derivative(const FlightLayout& at, const FlightOptions& on, const T* P, const T* x,
                            const T* s, const T* wind, BodyTrace<T>& tr, T* dx) {
  const T *q = x + kQuaternion, *v = x + kVelocity, *w = x + kRates;
  rotation(q, tr.R);
  for (int k = 0; k < 3; ++k) {
    tr.world_air[k] = v[k] - wind[k];
    tr.air[k] = tr.force[k] = tr.torque[k] = tr.momentum[k] = T{};
  }
  add_transposed(tr.R, tr.world_air, tr.air);
  rotor_thrusts(at, on, P, x, s, tr.R, tr.rotors);
  for (int i = 0; i < at.num_rotors; ++i) {
    const T *arm = P + at.arms + 3 * i, *axis = P + at.axes + 3 * i;
    const T u = tr.rotors.thrust[i];
    T e[3] = {u * axis[0], u * axis[1], u * axis[2]};
    if (on.rotor_drag) {
      T hub[3], crossing[3];
      across(tr.air, w, arm, axis, hub, crossing);
      add(-P[at.rotor_drag] * u, crossing, e);
    }
    add(constant<T>(1.0), e, tr.force);
    add_cross(arm, e, tr.torque);
    add(tr.rotors.bench[i], P + at.reactions + 3 * i, tr.torque);
  }
  if (on.body_drag) {
    tr.speed = sqrt(dot(tr.air, tr.air));
    for (int k = 0; k < 3; ++k) {
      const T drag = P[at.drag_linear + k] + P[at.drag_quadratic + k] * tr.speed;
      tr.force[k] -= drag * tr.air[k];
    }
  }
  add_product(P + at.inertia, w, tr.momentum);
  add_cross(tr.momentum, w, tr.torque);  // - w x J w

  for (int k = 0; k < 3; ++k) {
    dx[kPosition + k] = v[k];
    dx[kVelocity + k] = P[at.inverse_mass] * dot(tr.R + 3 * k, tr.force);
    dx[kRates + k] = dot(P + at.inertia_inverse + 3 * k, tr.torque);
  }
  dx[kVelocity + 2] += on.gravity;
  dx[kQuaternion] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]);
  dx[kQuaternion + 1] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
  dx[kQuaternion + 2] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]);
  dx[kQuaternion + 3] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
  dx[kCharge] = on.battery ? -P[at.inverse_capacity] * tr.rotors.current : T{};
}

DIFFSIM_INLINE void spin_vjp(const V* q, const V* w, const V* g, V* grad_q, V* grad_w) {
  grad_q[0] += 0.5 * (g[1] * w[0] + g[2] * w[1] + g[3] * w[2]);
  grad_q[1] += 0.5 * (-g[0] * w[0] - g[2] * w[2] + g[3] * w[1]);
  grad_q[2] += 0.5 * (-g[0] * w[1] + g[1] * w[2] - g[3] * w[0]);
  grad_q[3] += 0.5 * (-g[0] * w[2] - g[1] * w[1] + g[2] * w[0]);
  grad_w[0] += 0.5 * (-g[0] * q[1] + g[1] * q[0] + g[2] * q[3] - g[3] * q[2]);
  grad_w[1] += 0.5 * (-g[0] * q[2] - g[1] * q[3] + g[2] * q[0] + g[3] * q[1]);
  grad_w[2] += 0.5 * (-g[0] * q[3] + g[1] * q[2] - g[2] * q[1] + g[3] * q[0]);
}

/// @param[in]     tr      trace that body_derivative left
/// @param[in]     grad_dx gradient of the derivative
/// @param[in,out] grad_x, grad_s, grad_wind, grad_P  added to
inline void body_derivative_vjp(const FlightLayout& at, const FlightOptions& on, const V* P,
                                const V* x, const V* s, const BodyTrace<V>& tr, const V* grad_dx,
                                V* grad_x, V* grad_s, V* grad_wind, V* grad_P) {
  const V *q = x + kQuaternion, *w = x + kRates;
  V *grad_v = grad_x + kVelocity, *grad_w = grad_x + kRates;
  V grad_R[9] = {}, grad_force[3] = {}, grad_torque[3] = {}, grad_air[3] = {};
  add(broadcast<V>(1.0), grad_dx, grad_v);
  spin_vjp(q, w, grad_dx + kQuaternion, grad_x + kQuaternion, grad_w);

  const V* g_v = grad_dx + kVelocity;
  const V inverse_mass = P[at.inverse_mass];
  add_outer(inverse_mass, g_v, tr.force, grad_R);
  V turned[3] = {};
  add_transposed(tr.R, g_v, turned);
  add(inverse_mass, turned, grad_force);
  grad_P[at.inverse_mass] += dot(turned, tr.force);

  const V* g_w = grad_dx + kRates;
  add_transposed(P + at.inertia_inverse, g_w, grad_torque);
  add_outer(broadcast<V>(1.0), g_w, tr.torque, grad_P + at.inertia_inverse);
  V grad_momentum[3] = {};
  add_cross(w, grad_torque, grad_momentum);
  add_cross(grad_torque, tr.momentum, grad_w);
  add_outer(broadcast<V>(1.0), grad_momentum, w, grad_P + at.inertia);
  add_transposed(P + at.inertia, grad_momentum, grad_w);

  if (on.body_drag) {
    V grad_speed = V{};
    for (int k = 0; k < 3; ++k) {
      const V pull = grad_force[k] * tr.air[k];
      grad_air[k] -= grad_force[k] * (P[at.drag_linear + k] + P[at.drag_quadratic + k] * tr.speed);
      grad_P[at.drag_linear + k] -= pull;
      grad_P[at.drag_quadratic + k] -= pull * tr.speed;
      grad_speed -= pull * P[at.drag_quadratic + k];
    }
    add(ratio(grad_speed, tr.speed), tr.air, grad_air);
  }

  V grad_bench[kMaxRotors], grad_thrust[kMaxRotors];
  for (int i = 0; i < at.num_rotors; ++i) {
    const V *arm = P + at.arms + 3 * i, *axis = P + at.axes + 3 * i;
    V *grad_arm = grad_P + at.arms + 3 * i, *grad_axis = grad_P + at.axes + 3 * i;
    const V u = tr.rotors.thrust[i];
    V e[3] = {u * axis[0], u * axis[1], u * axis[2]};
    V grad_e[3] = {grad_force[0], grad_force[1], grad_force[2]};
    add_cross(grad_torque, arm, grad_e);
    grad_thrust[i] = dot(grad_e, axis);
    add(u, grad_e, grad_axis);
    if (on.rotor_drag) {
      const V k = P[at.rotor_drag];
      V hub[3], crossing[3];
      across(tr.air, w, arm, axis, hub, crossing);
      add(-k * u, crossing, e);
      const V work = dot(grad_e, crossing);
      grad_thrust[i] -= k * work;
      grad_P[at.rotor_drag] -= u * work;
      V grad_hub[3];  // through the projection across the axis
      const V along = dot(axis, grad_e);
      for (int j = 0; j < 3; ++j) grad_hub[j] = -k * u * (grad_e[j] - along * axis[j]);
      add(k * u * dot(axis, hub), grad_e, grad_axis);
      add(k * u * along, hub, grad_axis);
      add(broadcast<V>(1.0), grad_hub, grad_air);
      add_cross(arm, grad_hub, grad_w);
      add_cross(grad_hub, w, grad_arm);
    }
    add_cross(e, grad_torque, grad_arm);
    grad_bench[i] = dot(grad_torque, P + at.reactions + 3 * i);
    add(tr.rotors.bench[i], grad_torque, grad_P + at.reactions + 3 * i);
  }
  V grad_current = V{};
  if (on.battery) {
    grad_current = -P[at.inverse_capacity] * grad_dx[kCharge];
    grad_P[at.inverse_capacity] -= tr.rotors.current * grad_dx[kCharge];
  }
  rotor_thrusts_vjp(at, on, P, x, s, tr.R, tr.rotors, grad_bench, grad_thrust, grad_current, grad_x,
                    grad_s, grad_R, grad_P);

  V grad_world_air[3] = {};
  add_product(tr.R, grad_air, grad_world_air);
  add_outer(broadcast<V>(1.0), tr.world_air, grad_air, grad_R);
  add(broadcast<V>(1.0), grad_world_air, grad_v);
  add(broadcast<V>(-1.0), grad_world_air, grad_wind);
  rotation_vjp(q, grad_R, grad_x + kQuaternion);
}

}  // namespace diffsim::flight
