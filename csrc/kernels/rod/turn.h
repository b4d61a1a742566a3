// Rotations by rotation vectors, R = I + a K + b K K with a = sin(x) / x, b = (1 - cos x) / x^2
// (Rodrigues), smooth through zero.
#pragma once

#include <cmath>

#include "kernels/linalg/lane_dual.h"
#include "kernels/linalg/vector3.h"

namespace diffsim::rod {

using diffsim::sqrt;  // of lanes
using std::sqrt;      // of numbers

/// a and b, and their slopes by x^2.
template <class T>
struct TurnTerms {
  T a, b, a_slope, b_slope;
};

constexpr double kSmallSquare = 0.25;  // of x, up to which the series serves

/// (-x^2)^k over (2k + 1)! and (2k + 2)!; what is left out is below 1e-17.
template <class T>
DIFFSIM_INLINE TurnTerms<T> turn_series(const T& square) {
  constexpr int kTerms = 8;
  double first = 1.0 / 1307674368000.0, second = first / 16.0;  // over 15! and 16!
  first = -first, second = -second;
  TurnTerms<T> t{T{} + first, T{} + second, T{}, T{}};
  for (int k = kTerms - 2; k >= 0; --k) {
    first *= -(2.0 * k + 3.0) * (2.0 * k + 2.0), second *= -(2.0 * k + 4.0) * (2.0 * k + 3.0);
    t.a_slope = t.a_slope * square + t.a, t.b_slope = t.b_slope * square + t.b;
    t.a = t.a * square + first, t.b = t.b * square + second;
  }
  return t;
}

inline TurnTerms<double> turn_terms(double square) {
  if (square < kSmallSquare) return turn_series(square);
  const double x = std::sqrt(square), half = std::sin(0.5 * x);
  const double a = std::sin(x) / x, b = 2.0 * half * half / square;
  return {a, b, 0.5 * (std::cos(x) - a) / square, 0.5 * (a - 2.0 * b) / square};
}
/// A lane's terms are the same whatever the others hold.
inline TurnTerms<Native> turn_terms(const Native& square) {
  TurnTerms<Native> t = turn_series(square);
  if (all(less(square, broadcast<Native>(kSmallSquare)))) return t;
  for (int lane = 0; lane < kNativeLanes; ++lane) {
    if (square[lane] < kSmallSquare) continue;
    const TurnTerms<double> own = turn_terms(square[lane]);
    t.a[lane] = own.a, t.b[lane] = own.b;
    t.a_slope[lane] = own.a_slope, t.b_slope[lane] = own.b_slope;
  }
  return t;
}

/// R of a rotation vector.
template <class T>
DIFFSIM_INLINE void turn(const T* w, T* R) {
  const T square = dot(w, w);
  const auto t = turn_terms(value_of(square));
  const T a = chain(square, t.a, t.a_slope), b = chain(square, t.b, t.b_slope);
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) R[3 * i + k] = b * (w[i] * w[k]);
  const T once = 1.0 - b * square;
  for (int i = 0; i < 3; ++i) {
    R[4 * i] += once;
    const int next = (i + 1) % 3, last = (i + 2) % 3;
    const T skew = a * w[i];
    R[3 * last + next] += skew;
    R[3 * next + last] -= skew;
  }
}

/// grad_w += scale dL/dw, from G = dL/dR.
template <class T>
DIFFSIM_INLINE void turn_vjp(const T* w, const T* G, double scale, T* grad_w) {
  const auto t = turn_terms(dot(w, w));
  const T trace = G[0] + G[4] + G[8], square = dot(w, w);
  const T axial[3] = {G[7] - G[5], G[2] - G[6], G[3] - G[1]};
  T both[3] = {};  // (G + G') w
  add_product(G, w, both), add_transposed(G, w, both);
  const T of_square = t.a_slope * dot(axial, w) + t.b_slope * (0.5 * dot(both, w) - square * trace);
  for (int k = 0; k < 3; ++k)
    grad_w[k] +=
        scale * (t.a * axial[k] + t.b * (both[k] - 2.0 * trace * w[k]) + 2.0 * of_square * w[k]);
}

/// C = A B.
template <class T>
DIFFSIM_INLINE void multiply(const T* A, const T* B, T* C) {
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      C[3 * i + k] = A[3 * i] * B[k] + A[3 * i + 1] * B[3 + k] + A[3 * i + 2] * B[6 + k];
}
/// dL/d(A, B) of C = A B, added.
template <class T>
DIFFSIM_INLINE void multiply_vjp(const T* A, const T* B, const T* grad_C, T* grad_A, T* grad_B) {
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) {
      grad_A[3 * i + k] += dot(grad_C + 3 * i, B + 3 * k);
      for (int j = 0; j < 3; ++j) grad_B[3 * j + k] += A[3 * i + j] * grad_C[3 * i + k];
    }
}

}  // namespace diffsim::rod
