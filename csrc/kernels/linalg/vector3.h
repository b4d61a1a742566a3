// Three-vectors, and 3x3 matrices row by row, of numbers, SIMD lanes, or either with a derivative.
#pragma once

#include "kernels/linalg/lanes.h"

namespace diffsim {

template <class T>
DIFFSIM_INLINE T dot(const T* a, const T* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
/// y += scale x
template <class S, class T>
DIFFSIM_INLINE void add(const S& scale, const T* x, T* y) {
  for (int k = 0; k < 3; ++k) y[k] += scale * x[k];
}
/// y += a x b
template <class S, class T, class U>
DIFFSIM_INLINE void add_cross(const S* a, const T* b, U* y) {
  y[0] += a[1] * b[2] - a[2] * b[1];
  y[1] += a[2] * b[0] - a[0] * b[2];
  y[2] += a[0] * b[1] - a[1] * b[0];
}
/// y += A x, and y += A' x
template <class T>
DIFFSIM_INLINE void add_product(const T* A, const T* x, T* y) {
  for (int i = 0; i < 3; ++i) y[i] += dot(A + 3 * i, x);
}
template <class T>
DIFFSIM_INLINE void add_transposed(const T* A, const T* x, T* y) {
  for (int i = 0; i < 3; ++i) y[i] += A[i] * x[0] + A[3 + i] * x[1] + A[6 + i] * x[2];
}
/// A += scale x y'
template <class S, class T>
DIFFSIM_INLINE void add_outer(const S& scale, const T* x, const T* y, T* A) {
  for (int i = 0; i < 3; ++i) add(scale * x[i], y, A + 3 * i);
}

}  // namespace diffsim
