// Dense kernels on 8 x 8 tiles for the Cholesky factorisation.
//
// A tile stores `width` columns of 8 doubles one after the other; rows beyond the matrix are zero.
#pragma once

#include <cmath>

#include "kernels/linalg/simd.h"

namespace diffsim::tiles {

constexpr int kSize = 8;
constexpr int kParts = kSize / simd::kLanes;  // registers per tile column

// Register blocking of `multiply`: rows x columns that keep the multipliers busy and fit the
// register file (32 registers with AVX-512, 16 without).
constexpr int kRowTiles = simd::kLanes == 8 ? 3 : 1;
constexpr int kColumns = simd::kLanes == 8 ? 8 : simd::kLanes;

/// C_t -= sum_k A_t[:, k] B[:, k]' for `R` vertically adjacent tiles t, over panels [q0, q1).
/// @param[in,out] c  first tile of C; the next one follows after 8 * width doubles
/// @param width      columns of C that exist
/// @param a, b       callables: panel q -> tile of the first row of A, tile of B
/// @param depth      callable: panel q -> its number of columns (and tile stride / 8)
template <int R, typename A, typename B, typename Depth>
inline void multiply(double* c, int width, int q0, int q1, const A& a, const B& b,
                     const Depth& depth) {
  using simd::Vec;
  for (int first = 0; first < width; first += kColumns) {
    Vec sum[R][kParts][kColumns] = {};
    for (int q = q0; q < q1; ++q) {
      const double* left = a(q);
      const double* right = b(q) + first;
      const int columns = depth(q);
      const int stride = columns * kSize;
#pragma GCC unroll 2
      for (int k = 0; k < columns; ++k) {
        for (int r = 0; r < R; ++r) {
          for (int h = 0; h < kParts; ++h) {
            const Vec l = simd::load(left + r * stride + k * kSize + h * simd::kLanes);
            for (int j = 0; j < kColumns; ++j) sum[r][h][j] += l * right[k * kSize + j];
          }
        }
      }
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
