// Eight floats side by side: a row of a block of six, padded.
#pragma once

#include <cstdint>
#include <cstring>

#include "kernels/linalg/lanes.h"

namespace diffsim {

constexpr int kFloatLanes = 8;
constexpr int kFloatBlock = 6 * kFloatLanes;  ///< floats of a block of a coarse level
using FloatLane = float __attribute__((vector_size(4 * kFloatLanes)));

DIFFSIM_INLINE FloatLane load_floats(const float* p) {  // any alignment
  FloatLane v;
  std::memcpy(&v, p, sizeof(v));
  return v;
}
DIFFSIM_INLINE void store_floats(float* p, const FloatLane& v) { std::memcpy(p, &v, sizeof(v)); }
DIFFSIM_INLINE float sum_floats(const FloatLane& v) {
  return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

}  // namespace diffsim
