// One SIMD register of doubles, as wide as this binary's instruction set has.
#pragma once

#include "kernels/linalg/lanes.h"

namespace diffsim::simd {

constexpr int kLanes = kNativeLanes;

typedef double Vec __attribute__((vector_size(kLanes * sizeof(double)), may_alias));
typedef float FloatVec __attribute__((vector_size(kLanes * sizeof(float)), may_alias));

/// Eight floats, or as many of them as a register holds: rows of a column of a tile.
constexpr int kFloatLanes = kNativeBytes >= 32 ? 8 : 4;
typedef float FloatRows __attribute__((vector_size(kFloatLanes * sizeof(float)), may_alias));

/// Loads and stores need alignment to the register.
inline Vec load(const double* p) { return *reinterpret_cast<const Vec*>(p); }
inline Vec load(const float* p) {
  return __builtin_convertvector(*reinterpret_cast<const FloatVec*>(p), Vec);
}
inline void store(double* p, Vec v) { *reinterpret_cast<Vec*>(p) = v; }
inline Vec broadcast(double a) { return a - Vec{}; }  // -0.0 stays -0.0

typedef long long Mask __attribute__((vector_size(kLanes * sizeof(long long))));
#if defined(__clang__)
#define DIFFSIM_SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define DIFFSIM_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, Mask{__VA_ARGS__})
#endif

/// Lane i of the result is the sum over the lanes of v[i], for kLanes registers.
inline Vec sum_each(const Vec* v) {
#if defined(__AVX512F__)
  Vec pair[4], quad[2];
  for (int i = 0; i < 4; ++i) {
    pair[i] = DIFFSIM_SHUFFLE(v[2 * i], v[2 * i + 1], 0, 8, 2, 10, 4, 12, 6, 14) +
              DIFFSIM_SHUFFLE(v[2 * i], v[2 * i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 2; ++i) {
    quad[i] = DIFFSIM_SHUFFLE(pair[2 * i], pair[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13) +
              DIFFSIM_SHUFFLE(pair[2 * i], pair[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
  }
  return DIFFSIM_SHUFFLE(quad[0], quad[1], 0, 1, 2, 3, 8, 9, 10, 11) +
         DIFFSIM_SHUFFLE(quad[0], quad[1], 4, 5, 6, 7, 12, 13, 14, 15);
#elif defined(__AVX__)
  Vec pair[2];
  for (int i = 0; i < 2; ++i) {
    pair[i] = DIFFSIM_SHUFFLE(v[2 * i], v[2 * i + 1], 0, 4, 2, 6) +
              DIFFSIM_SHUFFLE(v[2 * i], v[2 * i + 1], 1, 5, 3, 7);
  }
  return DIFFSIM_SHUFFLE(pair[0], pair[1], 0, 1, 4, 5) +
         DIFFSIM_SHUFFLE(pair[0], pair[1], 2, 3, 6, 7);
#else
  return DIFFSIM_SHUFFLE(v[0], v[1], 0, 2) + DIFFSIM_SHUFFLE(v[0], v[1], 1, 3);
#endif
}
#undef DIFFSIM_SHUFFLE

}  // namespace diffsim::simd
