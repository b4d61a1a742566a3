// Rotations and powers of SIMD lanes, one vehicle per lane.
#pragma once

#include <cmath>

#include "kernels/linalg/lanes.h"
#include "kernels/linalg/vector3.h"

namespace diffsim::flight {

using V = Native;

/// The same number in every lane.
template <class T>
DIFFSIM_INLINE T constant(double value) {
  return broadcast<T>(value);
}

/// World from body; scales with |q|^2, so that it is a polynomial and its stages need no root.
template <class T>
DIFFSIM_INLINE void rotation(const T* q, T* R) {
  const T a = q[0], b = q[1], c = q[2], d = q[3];
  R[0] = a * a + b * b - c * c - d * d;
  R[4] = a * a - b * b + c * c - d * d;
  R[8] = a * a - b * b - c * c + d * d;
  R[1] = 2.0 * (b * c - a * d);
  R[3] = 2.0 * (b * c + a * d);
  R[2] = 2.0 * (b * d + a * c);
  R[6] = 2.0 * (b * d - a * c);
  R[5] = 2.0 * (c * d - a * b);
  R[7] = 2.0 * (c * d + a * b);
}
DIFFSIM_INLINE void rotation_vjp(const V* q, const V* grad_R, V* grad_q) {
  const V a = q[0], b = q[1], c = q[2], d = q[3];
  const V* g = grad_R;
  const V yaw = g[3] - g[1], pitch = g[2] - g[6], roll = g[7] - g[5];
  const V bc = g[1] + g[3], bd = g[2] + g[6], cd = g[5] + g[7];
  grad_q[0] += 2.0 * (a * (g[0] + g[4] + g[8]) + d * yaw + c * pitch + b * roll);
  grad_q[1] += 2.0 * (b * (g[0] - g[4] - g[8]) + c * bc + d * bd + a * roll);
  grad_q[2] += 2.0 * (c * (g[4] - g[0] - g[8]) + b * bc + d * cd + a * pitch);
  grad_q[3] += 2.0 * (d * (g[8] - g[0] - g[4]) + b * bd + c * cd + a * yaw);
}

template <class F>
DIFFSIM_INLINE V each(const V& a, const V& b, F f) {
  V r;
  for (int i = 0; i < kNativeLanes; ++i) r[i] = f(a[i], b[i]);
  return r;
}
/// base^exponent and log(base); zero where the base is not positive.
inline V power(const V& base, const V& exponent) {
  return each(base, exponent, [](double b, double e) { return b > 0.0 ? std::pow(b, e) : 0.0; });
}
inline V logarithm(const V& a) {
  return each(a, a, [](double x, double) { return x > 0.0 ? std::log(x) : 0.0; });
}
/// a / b; zero where b is zero.
DIFFSIM_INLINE V ratio(const V& a, const V& b) {
  const MaskOf<V> zero = b == V{};
  return select<V>(zero, V{}, a / select<V>(zero, broadcast<V>(1.0), b));
}

}  // namespace diffsim::flight
