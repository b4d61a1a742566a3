// Stretch and moment of one section under the force beyond it and its tendons.
//
//   y = max(v_0, 1/5),  v = e_0 + (n - sum pull) / (S (secant, 1, 1)),
//   pull = T t / |t|,   t = v + u x (w r) + r',
//   m = (twist, flexural, flexural) B (u - u0) (1 + k (R |bends of u - u0|)^2) + sum w r x pull
//
// in a fixed number of rounds from v = e_0 + n / S, with the factors w (width), secant, flexural
// and twist that pressed rubber has; the last ones are those of the last v.
#pragma once

#include "kernels/rod/turn.h"

namespace diffsim::rod {

constexpr int kRounds = 4;            // each gains about two digits: tendons press by a few percent
constexpr double kMostPressed = 0.2;  // rubber stiffens no further: solvers pass through it

/// One section's share of a rod's numbers, or of dL/d(these). Tendon t's are `stride` elements on.
template <class Pointer>
struct SectionNumbers {
  Pointer bending, stretch, rest, stiffening, offset, slope, rubber;
};

/// Factors by which a section that is pressed to the share y differs, as rubber that keeps its
/// volume does.
template <class T>
struct Pressed {
  T width, secant, twist, flexural;
};

/// The larger of both; a number that is not one becomes `least`.
template <class T>
DIFFSIM_INLINE T at_least(double least, const T& x) {
  return value_of(x) > least ? x : T(least);
}
DIFFSIM_INLINE Native at_least(double least, const Native& x) {
  const Native bound = broadcast<Native>(least);
  return select(greater(x, bound), x, bound);
}

template <class T, class Number>
DIFFSIM_INLINE Pressed<T> pressed(const T& stretch, const Number& rubber) {
  const T y = at_least(kMostPressed, stretch);
  const T i = 1.0 / y, square = i * i;
  return {1.0 + rubber * (sqrt(i) - 1.0),
          1.0 + rubber * ((1.0 + i + square) * (1.0 / 3.0) - 1.0),  // P / (E (y - 1))
          1.0 + rubber * (i - 1.0),
          1.0 + rubber * ((i + 2.0 * square * square) * (1.0 / 3.0) - 1.0)};
}

/// y where x is above a bound, zero elsewhere.
DIFFSIM_INLINE double where_above(double bound, double x, double y) { return x > bound ? y : 0.0; }
DIFFSIM_INLINE Native where_above(double bound, const Native& x, const Native& y) {
  return keep(greater(x, broadcast<Native>(bound)), y);
}

/// dL/d(stretch, rubber) of the factors, added; `grad` holds dL/d(factors).
template <class T>
DIFFSIM_INLINE void pressed_vjp(const T& stretch, const T& rubber, const Pressed<T>& grad,
                                T* grad_stretch, T* grad_rubber) {
  const Pressed<T> whole = pressed(stretch, 1.0);
  *grad_rubber += grad.width * (whole.width - 1.0) + grad.secant * (whole.secant - 1.0) +
                  grad.twist * (whole.twist - 1.0) + grad.flexural * (whole.flexural - 1.0);
  const T i = 1.0 / at_least(kMostPressed, stretch), square = i * i;
  *grad_stretch -= where_above(
      kMostPressed, stretch,
      rubber * (grad.width * 0.5 * i * sqrt(i) + grad.secant * (square + 2.0 * square * i) / 3.0 +
                grad.twist * square + grad.flexural * (square + 8.0 * square * square * i) / 3.0));
}

/// One section; its numbers may be of a type without derivatives.
template <class T, class Number = T>
struct Section {
  std::int64_t num_tendons, stride;  ///< from one tendon's offset to the next one's
  Number radius;
  const T* u;        ///< (3)
  const T* force;    ///< (3) beyond, in the frame of the section
  const T* tension;  ///< (num_tendons)
  SectionNumbers<const Number*> of;

  /// t and |t| of a tendon, and its lever without the width.
  DIFFSIM_INLINE T tangent(std::int64_t tendon, const T* v, const T& width, T* t) const {
    T lever[3];
    const Number *r = of.offset + tendon * stride, *slope = of.slope + tendon * stride;
    for (int k = 0; k < 3; ++k) lever[k] = width * r[k], t[k] = v[k] + slope[k];
    add_cross(u, lever, t);
    return sqrt(dot(t, t));
  }

  /// @param[out] rounds (kRounds + 1, 3) v of the rounds, the last one of all
  /// @param[out] moment (3)
  DIFFSIM_INLINE void solve(T* rounds, T* moment) const {
    T levers[3];
    for (int k = 0; k < 3; ++k) rounds[k] = (k == 0 ? 1.0 : 0.0) + force[k] / of.stretch[k];
    for (int round = 0; round < kRounds; ++round) {
      const T* v = rounds + 3 * round;
      T* next = rounds + 3 * (round + 1);
      const Pressed<T> now = pressed(v[0], *of.rubber);
      T left[3] = {force[0], force[1], force[2]};
      for (int k = 0; k < 3; ++k) levers[k] = T{};
      for (std::int64_t i = 0; i < num_tendons; ++i) {
        T t[3];
        const T norm = tangent(i, v, now.width, t);
        const T share = tension[i] / norm;
        for (int k = 0; k < 3; ++k) t[k] = share * t[k], left[k] -= t[k];
        if (round + 1 == kRounds) add_cross(of.offset + i * stride, t, levers);
      }
      left[0] = left[0] / now.secant;
      for (int k = 0; k < 3; ++k) next[k] = (k == 0 ? 1.0 : 0.0) + left[k] / of.stretch[k];
    }
    const Pressed<T> end = pressed(rounds[3 * kRounds], *of.rubber);
    T bent[3];
    for (int k = 0; k < 3; ++k) bent[k] = u[k] - of.rest[k];
    const T grown =
        1.0 + *of.stiffening * ((bent[1] * bent[1] + bent[2] * bent[2]) * (radius * radius));
    for (int k = 0; k < 3; ++k)
      moment[k] = (k == 0 ? end.twist : end.flexural) * of.bending[k] * bent[k] * grown +
                  end.width * levers[k];
  }
};

/// dL/d(all that a section depends on), added, from dL/d(v, moment).
/// @param grad_v (3) used up
template <class T>
void section_vjp(const Section<T>& s, const T* rounds, T* grad_v, const T* grad_moment, T* grad_u,
                 T* grad_force, T* grad_tension, const SectionNumbers<T*>& grad) {
  const auto& of = s.of;
  const T rubber = *of.rubber;
  const T* v = rounds + 3 * kRounds;
  const Pressed<T> end = pressed(v[0], rubber);
  Pressed<T> grad_end{};
  // of the body
  T bent[3], grad_bent[3], grad_grown = T{};
  for (int k = 0; k < 3; ++k) bent[k] = s.u[k] - of.rest[k];
  const T area = s.radius * s.radius;
  const T strain = (bent[1] * bent[1] + bent[2] * bent[2]) * area;
  const T grown = 1.0 + *of.stiffening * strain;
  for (int k = 0; k < 3; ++k) {
    const T factor = k == 0 ? end.twist : end.flexural, g = grad_moment[k];
    (k == 0 ? grad_end.twist : grad_end.flexural) += g * of.bending[k] * bent[k] * grown;
    grad.bending[k] += g * factor * bent[k] * grown;
    grad_bent[k] = g * factor * of.bending[k] * grown;
    grad_grown += g * factor * of.bending[k] * bent[k];
  }
  *grad.stiffening += grad_grown * strain;
  for (int k = 1; k < 3; ++k) grad_bent[k] += grad_grown * *of.stiffening * 2.0 * area * bent[k];
  for (int k = 0; k < 3; ++k) grad_u[k] += grad_bent[k], grad.rest[k] -= grad_bent[k];
  // of the factors at the end: levers of the last round's pulls
  const T* last = rounds + 3 * (kRounds - 1);
  const T width = pressed(last[0], rubber).width;
  for (std::int64_t i = 0; i < s.num_tendons; ++i) {
    T t[3], lever[3] = {};
    const T norm = s.tangent(i, last, width, t);
    add_cross(of.offset + i * s.stride, t, lever);
    grad_end.width += s.tension[i] / norm * dot(grad_moment, lever);
  }
  pressed_vjp(v[0], rubber, grad_end, grad_v, grad.rubber);
  // of the tendons, rounds from the last one back
  for (int round = kRounds - 1; round >= 0; --round) {
    const bool is_last = round + 1 == kRounds;
    const T *before = rounds + 3 * round, *after = before + 3;
    const Pressed<T> now = pressed(before[0], rubber);
    Pressed<T> grad_now{};
    T grad_left[3], grad_before[3] = {};
    for (int k = 0; k < 3; ++k) {
      const T secant = k == 0 ? now.secant : T{} + 1.0, stiff = of.stretch[k] * secant;
      const T over = grad_v[k] * (after[k] - (k == 0 ? 1.0 : 0.0)) / stiff;
      grad_left[k] = grad_v[k] / stiff;
      grad.stretch[k] -= over * secant;
      if (k == 0) grad_now.secant -= over * of.stretch[0];
      grad_force[k] += grad_left[k];
    }
    for (std::int64_t i = 0; i < s.num_tendons; ++i) {
      const T* r = of.offset + i * s.stride;
      T *grad_r = grad.offset + i * s.stride, *grad_slope = grad.slope + i * s.stride;
      T t[3], lever[3], grad_lever[3] = {};
      const T norm = s.tangent(i, before, now.width, t);
      T g[3];  // dL/d(pull)
      for (int k = 0; k < 3; ++k) {
        t[k] /= norm, g[k] = -grad_left[k];
        lever[k] = now.width * r[k];
      }
      if (is_last) {
        T of_lever[3] = {}, wide[3];
        for (int k = 0; k < 3; ++k) wide[k] = end.width * r[k];
        add_cross(grad_moment, wide, g);
        add_cross(t, grad_moment, of_lever);
        add(s.tension[i] * end.width, of_lever, grad_r);
      }
      const T along = dot(t, g);
      grad_tension[i] += along;
      for (int k = 0; k < 3; ++k) g[k] = s.tension[i] / norm * (g[k] - along * t[k]);  // dL/dt
      add(1.0, g, grad_before), add(1.0, g, grad_slope);
      add_cross(lever, g, grad_u), add_cross(g, s.u, grad_lever);
      add(now.width, grad_lever, grad_r);
      grad_now.width += dot(grad_lever, r);
    }
    pressed_vjp(before[0], rubber, grad_now, grad_before, grad.rubber);
    for (int k = 0; k < 3; ++k) grad_v[k] = grad_before[k];
  }
  for (int k = 0; k < 3; ++k) {
    grad_force[k] += grad_v[k] / of.stretch[k];
    grad.stretch[k] -= grad_v[k] * (rounds[k] - (k == 0 ? 1.0 : 0.0)) / of.stretch[k];
  }
}

}  // namespace diffsim::rod
