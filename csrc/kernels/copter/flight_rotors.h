// From the rotors' thrust states to the thrusts that act: battery, thrust curve, interference,
// ground; and back.
#pragma once

#include "kernels/copter/flight.h"
#include "kernels/copter/flight_math.h"

namespace diffsim::flight {

/// What the thrusts of one instant came from.
template <class T>
struct RotorTrace {
  T curve[kMaxRotors];   // after the thrust curve [N]
  T bench[kMaxRotors];   // ... and the battery: the thrust that a bench would show [N]
  T freed[kMaxRotors];   // ... and interference [N]
  T factor[kMaxRotors];  // of the ground
  T height[kMaxRotors];  // above the ground, at least half a radius [m]
  T thrust[kMaxRotors];  // that acts [N]
  T drawn[kMaxRotors];   // s^alpha
  T current, voltage, sag;
};

constexpr double kLeastVoltage = 0.05;  // of the nominal one; below it thrusts stay as they are

template <class T>
inline void battery_sag(const FlightLayout& at, const T* P, const T* s, const T& charge,
                        RotorTrace<T>& tr) {
  tr.current = P[at.idle_current];
  for (int i = 0; i < at.num_rotors; ++i) {
    tr.drawn[i] = power(s[i], P[at.current_exponent + i]);
    tr.current += P[at.current_coefficient + i] * tr.drawn[i];
  }
  const T* c = P + at.open_circuit;
  const T open = c[0] + charge * (c[1] + charge * (c[2] + charge * c[3]));
  tr.voltage = open - P[at.resistance] * tr.current;
  const T relative = tr.voltage / P[at.nominal_voltage];
  tr.sag = power(max(relative, constant<T>(kLeastVoltage)), P[at.sag_exponent]);
}

/// Adds to grad_s, grad_charge, grad_P.
inline void battery_sag_vjp(const FlightLayout& at, const V* P, const V* s, V charge,
                            const RotorTrace<V>& tr, V grad_sag, V grad_current, V* grad_s,
                            V& grad_charge, V* grad_P) {
  const V nominal = P[at.nominal_voltage];
  const V relative = tr.voltage / nominal, least = broadcast<V>(kLeastVoltage);
  const MaskOf<V> alive = greater(relative, least);
  grad_P[at.sag_exponent] += grad_sag * tr.sag * logarithm(max(relative, least));
  const V grad_relative = keep<V>(alive, grad_sag * P[at.sag_exponent] * tr.sag / relative);
  grad_P[at.nominal_voltage] -= grad_relative * relative / nominal;
  const V grad_voltage = grad_relative / nominal;
  const V* c = P + at.open_circuit;
  V power_of_charge = grad_voltage;
  for (int j = 0; j < 4; ++j) {
    grad_P[at.open_circuit + j] += power_of_charge;
    power_of_charge *= charge;
  }
  grad_charge += grad_voltage * (c[1] + charge * (2.0 * c[2] + charge * 3.0 * c[3]));
  grad_P[at.resistance] -= grad_voltage * tr.current;
  grad_current -= grad_voltage * P[at.resistance];
  grad_P[at.idle_current] += grad_current;
  for (int i = 0; i < at.num_rotors; ++i) {
    const V a = P[at.current_coefficient + i], alpha = P[at.current_exponent + i];
    grad_P[at.current_coefficient + i] += grad_current * tr.drawn[i];
    grad_P[at.current_exponent + i] += grad_current * a * tr.drawn[i] * logarithm(s[i]);
    grad_s[i] += grad_current * a * alpha * ratio(tr.drawn[i], s[i]);
  }
}

/// @param[in] s   thrust states: the command, or what the lagging motor has made of it [N]
/// @param[in] R   world from body
template <class T>
inline void rotor_thrusts(const FlightLayout& at, const FlightOptions& on, const T* P, const T* x,
                          const T* s, const T* R, RotorTrace<T>& tr) {
  const int n = at.num_rotors;
  tr.sag = constant<T>(1.0);
  if (on.battery) battery_sag(at, P, s, x[kCharge], tr);
  for (int i = 0; i < n; ++i) {
    const T reference = P[at.curve_reference + i];
    tr.curve[i] =
        on.thrust_curve ? reference * power(s[i] / reference, P[at.curve_exponent + i]) : s[i];
    tr.bench[i] = tr.sag * tr.curve[i];
  }
  for (int i = 0; i < n; ++i) {
    tr.freed[i] = tr.bench[i];
    if (on.interference) {
      for (int j = 0; j < n; ++j) tr.freed[i] -= P[at.interference + n * i + j] * tr.bench[j];
    }
    tr.thrust[i] = tr.freed[i];
    if (on.ground_effect) {
      // Cheeseman and Bennett 1955 with a coefficient: 1 / (1 - k (radius / 4 height)^2)
      const T radius = P[at.radii + i];
      const T height = -(x[2] + dot(R + 6, P + at.arms + 3 * i)) - P[at.terrain_height];
      tr.height[i] = max(height, T(0.5 * radius));
      const T near = radius / (4.0 * tr.height[i]);
      tr.factor[i] = 1.0 / (1.0 - P[at.ground_coefficient] * near * near);
      tr.thrust[i] = tr.freed[i] * tr.factor[i];
    }
  }
}

/// @param[in]     grad_bench, grad_thrust, grad_current  of what the trace holds; grad_bench is
/// used
///                as working space
/// @param[in,out] grad_x, grad_s, grad_R, grad_P         added to
inline void rotor_thrusts_vjp(const FlightLayout& at, const FlightOptions& on, const V* P,
                              const V* x, const V* s, const V* R, const RotorTrace<V>& tr,
                              V* grad_bench, const V* grad_thrust, V grad_current, V* grad_x,
                              V* grad_s, V* grad_R, V* grad_P) {
  const int n = at.num_rotors;
  for (int i = 0; i < n; ++i) {
    V grad_freed = grad_thrust[i];
    if (on.ground_effect) {
      const V radius = P[at.radii + i], h = tr.height[i];
      const V near = radius / (4.0 * h), near2 = near * near;
      const V grad_product = grad_thrust[i] * tr.freed[i] * tr.factor[i] * tr.factor[i];
      grad_freed = grad_thrust[i] * tr.factor[i];
      grad_P[at.ground_coefficient] += grad_product * near2;
      const MaskOf<V> free = greater(h, V(0.5 * radius));
      const V slope = keep<V>(free, 2.0 * grad_product * P[at.ground_coefficient] * near2);
      grad_P[at.radii + i] += slope / radius;
      const V rise = slope / h;  // minus the gradient of the height
      grad_x[2] += rise;
      grad_P[at.terrain_height] += rise;
      add(rise, P + at.arms + 3 * i, grad_R + 6);
      add(rise, R + 6, grad_P + at.arms + 3 * i);
    }
    grad_bench[i] += grad_freed;
    if (on.interference) {
      for (int j = 0; j < n; ++j) {
        grad_P[at.interference + n * i + j] -= grad_freed * tr.bench[j];
        grad_bench[j] -= grad_freed * P[at.interference + n * i + j];
      }
    }
  }
  V grad_sag = V{};
  for (int i = 0; i < n; ++i) {
    grad_sag += grad_bench[i] * tr.curve[i];
    const V grad_curve = grad_bench[i] * tr.sag;
    if (on.thrust_curve) {
      const V reference = P[at.curve_reference + i], e = P[at.curve_exponent + i];
      grad_s[i] += grad_curve * e * ratio(tr.curve[i], s[i]);
      grad_P[at.curve_exponent + i] += grad_curve * tr.curve[i] * logarithm(s[i] / reference);
      grad_P[at.curve_reference + i] += grad_curve * (1.0 - e) * tr.curve[i] / reference;
    } else {
      grad_s[i] += grad_curve;
    }
  }
  if (on.battery) {
    battery_sag_vjp(at, P, s, x[kCharge], tr, grad_sag, grad_current, grad_s, grad_x[kCharge],
                    grad_P);
  }
}

}  // namespace diffsim::flight
