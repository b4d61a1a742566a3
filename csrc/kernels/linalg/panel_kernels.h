// Kernels of the triangular solves: one panel of L against a few right-hand sides at once.
//
// A panel is `width` <= 8 columns of L in tiles of 8 rows, tile by tile, column by column within a
// tile. A local vector holds right-hand side r at w + r * ld, aligned to 64 bytes.
#pragma once

#include <cstdint>
#include <type_traits>

#include "kernels/linalg/simd.h"

namespace diffsim::panels {

constexpr int kRows = 8;                      // rows of a tile
constexpr int kParts = kRows / simd::kLanes;  // registers per tile column
// Registers that one pass may fill with multipliers or partial sums.
constexpr int kRegisters = simd::kLanes == 8 ? 24 : 12;

// How far ahead of its use a panel is asked for [bytes]; panels follow one another in memory.
constexpr int kAhead = 2048;

/// Asks for the K columns of a tile `kAhead` further on.
template <int K, typename T>
inline void prefetch_columns(const T* tile) {
  constexpr int kLine = 64 / static_cast<int>(sizeof(T));  // entries of a cache line
  for (int i = 0; i < K * kRows; i += kLine)
    __builtin_prefetch(tile + i + kAhead / static_cast<int>(sizeof(T)));
}

/// w[tiles] -= L[tiles, K columns] z
/// @param tiles  first tile, at the first of the K columns; tiles are `stride` apart
/// @param z      (NR, K) values, right-hand side r at z + r * ld
template <int NR, int K, typename T>
inline void subtract_columns(const T* tiles, std::int64_t stride, int num_tiles, const double* z,
                             double* w, std::int64_t ld) {
  using simd::Vec;
  Vec factor[K][NR];
  for (int k = 0; k < K; ++k) {
    for (int r = 0; r < NR; ++r) factor[k][r] = simd::broadcast(z[r * ld + k]);
  }
  for (int t = 0; t < num_tiles; ++t, tiles += stride, w += kRows) {
    prefetch_columns<K>(tiles);
    for (int h = 0; h < kParts; ++h) {
      Vec sum[NR];
      for (int r = 0; r < NR; ++r) sum[r] = simd::load(w + r * ld + h * simd::kLanes);
      for (int k = 0; k < K; ++k) {
        const Vec l = simd::load(tiles + k * kRows + h * simd::kLanes);
        for (int r = 0; r < NR; ++r) sum[r] -= l * factor[k][r];
      }
      for (int r = 0; r < NR; ++r) simd::store(w + r * ld + h * simd::kLanes, sum[r]);
    }
  }
}

/// z -= L[tiles, K columns]' w
template <int NR, int K, typename T>
inline void subtract_dots(const T* tiles, std::int64_t stride, int num_tiles, const double* w,
                          std::int64_t ld, double* z) {
  using simd::Vec;
  Vec sum[NR][K] = {};
  for (int t = 0; t < num_tiles; ++t, tiles += stride, w += kRows) {
    prefetch_columns<K>(tiles);
    for (int h = 0; h < kParts; ++h) {
      Vec x[NR];
      for (int r = 0; r < NR; ++r) x[r] = simd::load(w + r * ld + h * simd::kLanes);
      for (int k = 0; k < K; ++k) {
        const Vec l = simd::load(tiles + k * kRows + h * simd::kLanes);
        for (int r = 0; r < NR; ++r) sum[r][k] += l * x[r];
      }
    }
  }
  for (int r = 0; r < NR; ++r) {
    double* const target = z + r * ld;
    if constexpr (K % simd::kLanes == 0) {
      for (int k = 0; k < K; k += simd::kLanes) {
        simd::store(target + k, simd::load(target + k) - simd::sum_each(sum[r] + k));
      }
    } else {
      static_assert(K < simd::kLanes, "column groups are powers of two");
      Vec padded[simd::kLanes] = {};
      for (int k = 0; k < K; ++k) padded[k] = sum[r][k];
      const Vec sums = simd::sum_each(padded);
      for (int k = 0; k < K; ++k) target[k] -= sums[k];
    }
  }
}

/// Calls f with (first column, std::integral_constant<int, K>) for groups that cover `width`.
template <int NR, typename F>
inline void for_column_groups(int width, const F& f) {
  int k = 0;
  if constexpr (NR * 8 <= kRegisters) {
    if (width == 8) return f(0, std::integral_constant<int, 8>());
  }
  if constexpr (NR * 4 <= kRegisters) {
    for (; k + 4 <= width; k += 4) f(k, std::integral_constant<int, 4>());
  }
  for (; k + 2 <= width; k += 2) f(k, std::integral_constant<int, 2>());
  if (k < width) f(k, std::integral_constant<int, 1>());
}

/// Forward substitution with one panel: w's first `width` entries become z = D^-1 b, the rows below
/// lose L z.
/// @param panel     its first tile holds D^-1, the inverse of the triangular block
/// @param num_tiles tiles in the panel, the first one included
template <int NR, typename T>
inline void forward(const T* panel, int width, int num_tiles, double* w, std::int64_t ld) {
  using simd::Vec;
  Vec z[NR][kParts] = {};
  for (int k = 0; k < width; ++k) {
    for (int h = 0; h < kParts; ++h) {
      const Vec l = simd::load(panel + k * kRows + h * simd::kLanes);
      for (int r = 0; r < NR; ++r) z[r][h] += l * w[r * ld + k];
    }
  }
  for (int r = 0; r < NR; ++r) {
    for (int h = 0; h < kParts; ++h) simd::store(w + r * ld + h * simd::kLanes, z[r][h]);
  }
  const std::int64_t stride = std::int64_t{width} * kRows;
  for_column_groups<NR>(width, [&](int k, auto count) {
    subtract_columns<NR, count()>(panel + stride + k * kRows, stride, num_tiles - 1, w + k,
                                  w + kRows, ld);
  });
}

/// w's first tile z becomes D^-T z; `Full` panels have 8 columns.
template <int NR, bool Full, typename T>
inline void multiply_transposed(const T* inverse, int width, double* w, std::int64_t ld) {
  using simd::Vec;
  for (int r = 0; r < NR; ++r) {
    double* const z = w + r * ld;
    Vec dot[kRows];
    for (int k = 0; k < kRows; ++k) {
      dot[k] = Vec{};
      if (!Full && k >= width) continue;
      for (int h = 0; h < kRows; h += simd::kLanes) {
        dot[k] += simd::load(inverse + k * kRows + h) * simd::load(z + h);
      }
    }
    Vec x[kParts];
    for (int h = 0; h < kParts; ++h) x[h] = simd::sum_each(dot + h * simd::kLanes);
    for (int h = 0; h < kParts; ++h) simd::store(z + h * simd::kLanes, x[h]);
  }
}

/// Backward substitution: w's first entries z become x = D^-T (z - L' x_below).
template <int NR, typename T>
inline void backward(const T* panel, int width, int num_tiles, double* w, std::int64_t ld) {
  const std::int64_t stride = std::int64_t{width} * kRows;
  for_column_groups<NR>(width, [&](int k, auto count) {
    subtract_dots<NR, count()>(panel + stride + k * kRows, stride, num_tiles - 1, w + kRows, ld,
                               w + k);
  });
  if (width == kRows) {
    multiply_transposed<NR, true>(panel, width, w, ld);
  } else {
    multiply_transposed<NR, false>(panel, width, w, ld);
  }
}

}  // namespace diffsim::panels
