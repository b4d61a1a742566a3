// One SIMD register of doubles, as wide as this binary's instruction set has.
#pragma once

#include <cstddef>

namespace diffsim::simd {

#if defined(__AVX512F__)
constexpr int kLanes = 8;
#elif defined(__AVX__)
constexpr int kLanes = 4;
#else
constexpr int kLanes = 2;
#endif

typedef double Vec __attribute__((vector_size(kLanes * sizeof(double)), may_alias));
typedef float FloatVec __attribute__((vector_size(kLanes * sizeof(float)), may_alias));

/// Loads and stores need alignment to the register.
inline Vec load(const double* p) { return *reinterpret_cast<const Vec*>(p); }
inline Vec load(const float* p) {
  return __builtin_convertvector(*reinterpret_cast<const FloatVec*>(p), Vec);
}
inline void store(double* p, Vec v) { *reinterpret_cast<Vec*>(p) = v; }
inline Vec broadcast(double a) { return a - Vec{}; }  // -0.0 stays -0.0

inline double sum(Vec v) {
  double total = 0;
  for (int i = 0; i < kLanes; ++i) total += v[i];
  return total;
}

}  // namespace diffsim::simd
