// Dense kernels on 8 x 8 tiles for the Cholesky factorization.
//
// A tile stores `width` columns of 8 doubles one after the other; rows beyond the matrix are zero.
#pragma once

#include <cmath>
#include <cstddef>

#include "kernels/linalg/simd.h"

namespace diffsim::tiles {

constexpr int kSize = 8;
constexpr int kParts = kSize / simd::kLanes;  // registers per tile column

// Register blocking of `multiply`: rows x columns that keep the multipliers busy and fit the
// register file (32 registers with AVX-512, 16 without).
constexpr int kRowTiles = simd::kLanes == 8 ? 3 : 1;
constexpr int kColumns = simd::kLanes == 8 ? 8 : simd::kLanes;

/// Panels of L with K columns in all, seen from two row tiles: where `multiply` finds its operands.
struct PanelRun {
  const double* left;   // tile of the first row group in the first panel
  const double* right;  // tile of the other row in the same panel
  std::ptrdiff_t step;  // from a full panel's tile to the next panel's; shrinks by one tile a panel
  int num_full;         // panels with 8 columns
  const double* last_left;  // tiles in the narrower last panel, where last_width > 0
  const double* last_right;
  int last_width;
};

/// sum[t] += A_t B' for one panel of `width` columns.
template <int R, int C>
inline void multiply_panel(const double* left, const double* right, int width,
                           simd::Vec (&sum)[R][kParts][C]) {
  const int stride = width * kSize;
#pragma GCC unroll 8
  for (int k = 0; k < width; ++k) {
    // Left in registers, one value of the right at a time: 24 sums + 3 + 1 of 32 registers. The
    // other way round, with 8 values of the right, one sum lives in memory.
    simd::Vec l[R][kParts];
    for (int r = 0; r < R; ++r) {
      for (int h = 0; h < kParts; ++h) {
        l[r][h] = simd::load(left + r * stride + k * kSize + h * simd::kLanes);
      }
    }
    for (int j = 0; j < C; ++j) {
      const double value = right[k * kSize + j];
      for (int r = 0; r < R; ++r) {
        for (int h = 0; h < kParts; ++h) sum[r][h][j] += l[r][h] * value;
      }
    }
  }
}

/// C_t -= A_t B' for `R` vertically adjacent tiles t.
/// @param[in,out] c  first tile of C; the next one follows after 8 * width doubles
/// @param width      columns of C that exist
template <int R>
inline void multiply(double* c, int width, const PanelRun& run) {
  using simd::Vec;
  for (int line = 0; line < R * width; ++line) __builtin_prefetch(c + line * kSize, 1);
  for (int first = 0; first < width; first += kColumns) {
    Vec sum[R][kParts][kColumns] = {};
    const double* left = run.left;
    const double* right = run.right + first;
    std::ptrdiff_t step = run.step;
    for (int q = 0; q < run.num_full; ++q) {
      multiply_panel<R, kColumns>(left, right, kSize, sum);
      left += step;
      right += step;
      step -= kSize * kSize;
    }
    if (run.last_width > 0) {
      multiply_panel<R, kColumns>(run.last_left, run.last_right + first, run.last_width, sum);
    }
    for (int r = 0; r < R; ++r) {
      for (int j = 0; j < kColumns; ++j) {
        if (first + j >= width) break;
        for (int h = 0; h < kParts; ++h) {
          double* p = c + r * width * kSize + (first + j) * kSize + h * simd::kLanes;
          simd::store(p, simd::load(p) - sum[r][h][j]);
        }
      }
    }
  }
}

/// Lower Cholesky factor of the first `width` rows and columns of a tile, in place; zeroes the
/// rest. Returns the first column whose squared pivot is not above floor[column], or -1; then
/// *pivot is what was found.
inline int factor_diagonal(double* tile, int width, const double* floor, double* pivot) {
  for (int k = 0; k < width; ++k) {
    double* column = tile + k * kSize;
    if (!(column[k] > floor[k])) {
      *pivot = column[k];
      return k;
    }
    const double root = std::sqrt(column[k]), inverse = 1.0 / root;
    for (int i = 0; i < kSize; ++i) column[i] = i < k || i >= width ? 0.0 : column[i] * inverse;
    column[k] = root;
    for (int j = k + 1; j < width; ++j) {
      const double factor = column[j];
      for (int i = 0; i < kSize; ++i) tile[j * kSize + i] -= column[i] * factor;
    }
  }
  return -1;
}

/// inverse = lower^-1 for a lower triangular tile; zero elsewhere.
inline void invert_lower(const double* lower, int width, double* inverse) {
  for (int j = 0; j < width; ++j) {
    double column[kSize] = {};
    column[j] = 1.0;
    for (int k = j; k < width; ++k) {
      column[k] /= lower[k * kSize + k];
      for (int i = k + 1; i < width; ++i) column[i] -= lower[k * kSize + i] * column[k];
    }
    for (int i = 0; i < kSize; ++i) inverse[j * kSize + i] = column[i];
  }
}

/// C_t <- C_t D^-T for `R` adjacent tiles, D lower triangular; reciprocal[k] = 1 / D_kk.
template <int R>
inline void solve_right(double* c, int width, const double* lower, const double* reciprocal) {
  using simd::Vec;
  for (int k = 0; k < width; ++k) {
    for (int r = 0; r < R; ++r) {
      for (int h = 0; h < kParts; ++h) {
        double* tile = c + r * width * kSize + h * simd::kLanes;
        const Vec solved = simd::load(tile + k * kSize) * reciprocal[k];
        simd::store(tile + k * kSize, solved);
        for (int j = k + 1; j < width; ++j) {
          simd::store(tile + j * kSize,
                      simd::load(tile + j * kSize) - solved * lower[k * kSize + j]);
        }
      }
    }
  }
}

}  // namespace diffsim::tiles
