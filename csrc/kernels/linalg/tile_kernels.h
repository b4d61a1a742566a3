// Dense kernels on 8 x 8 tiles for the Cholesky factorization, in double or single precision.
//
// A tile stores `width` columns of 8 numbers one after the other; rows beyond the matrix are zero.
#pragma once

#include <cmath>
#include <cstddef>

#include "kernels/linalg/simd.h"

namespace diffsim::tiles {

constexpr int kSize = 8;

// Register blocking of `multiply`: rows x columns that keep the multipliers busy and fit the
// register file (32 registers with AVX-512, 16 without).
template <typename T>
struct Blocking;
template <>
struct Blocking<double> {
  using Vec = simd::Vec;
  static constexpr int kLanes = simd::kLanes;
  static constexpr int kRowTiles = kLanes == 8 ? 3 : 1;
  static constexpr int kColumns = kLanes;
};
template <>
struct Blocking<float> {
  using Vec = simd::FloatRows;
  static constexpr int kLanes = simd::kFloatLanes;
  static constexpr int kRowTiles = kLanes == 8 ? 3 : 1;
  static constexpr int kColumns = kNativeBytes == 64 ? 8 : 4;
};
template <typename T>
using Vec = typename Blocking<T>::Vec;
/// Registers of a tile's column.
template <typename T>
constexpr int kParts = kSize / Blocking<T>::kLanes;

template <typename T>
inline Vec<T> load(const T* p) {
  return *reinterpret_cast<const Vec<T>*>(p);
}
template <typename T>
inline void store(T* p, const Vec<T>& v) {
  *reinterpret_cast<Vec<T>*>(p) = v;
}

/// Panels of L with K columns in all, seen from two row tiles: where `multiply` finds its operands.
template <typename T>
struct PanelRun {
  const T* left;        // tile of the first row group in the first panel
  const T* right;       // tile of the other row in the same panel
  std::ptrdiff_t step;  // from a full panel's tile to the next panel's; shrinks by one tile a panel
  int num_full;         // panels with 8 columns
  const T* last_left;   // tiles in the narrower last panel, where last_width > 0
  const T* last_right;
  int last_width;
};

/// sum[t] += A_t B' for one panel of `width` columns.
template <int R, int C, typename T>
inline void multiply_panel(const T* left, const T* right, int width,
                           Vec<T> (&sum)[R][kParts<T>][C]) {
  const int stride = width * kSize;
#pragma GCC unroll 8
  for (int k = 0; k < width; ++k) {
    // Left in registers, one value of the right at a time: 24 sums + 3 + 1 of 32 registers. The
    // other way round, with 8 values of the right, one sum lives in memory.
    Vec<T> l[R][kParts<T>];
    for (int r = 0; r < R; ++r) {
      for (int h = 0; h < kParts<T>; ++h) {
        l[r][h] = load(left + r * stride + k * kSize + h * Blocking<T>::kLanes);
      }
    }
    for (int j = 0; j < C; ++j) {
      const T value = right[k * kSize + j];
      for (int r = 0; r < R; ++r) {
        for (int h = 0; h < kParts<T>; ++h) sum[r][h][j] += l[r][h] * value;
      }
    }
  }
}

/// C_t -= A_t B' for `R` vertically adjacent tiles t.
/// @param[in,out] c  first tile of C; the next one follows after 8 * width numbers
/// @param width      columns of C that exist
template <int R, typename T>
inline void multiply(T* c, int width, const PanelRun<T>& run) {
  constexpr int kColumns = Blocking<T>::kColumns;
  for (int line = 0; line < R * width; ++line) __builtin_prefetch(c + line * kSize, 1);
  for (int first = 0; first < width; first += kColumns) {
    Vec<T> sum[R][kParts<T>][kColumns] = {};
    const T* left = run.left;
    const T* right = run.right + first;
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
        for (int h = 0; h < kParts<T>; ++h) {
          T* p = c + r * width * kSize + (first + j) * kSize + h * Blocking<T>::kLanes;
          store(p, load(p) - sum[r][h][j]);
        }
      }
    }
  }
}

/// Lower Cholesky factor of the first `width` rows and columns of a tile, in place; zeroes the
/// rest. Returns the first column whose squared pivot is not above floor[column], or -1; then
/// *pivot is what was found.
template <typename T>
inline int factor_diagonal(T* tile, int width, const double* floor, double* pivot) {
  for (int k = 0; k < width; ++k) {
    T* column = tile + k * kSize;
    if (!(column[k] > floor[k])) {
      *pivot = column[k];
      return k;
    }
    const T root = std::sqrt(column[k]), inverse = T{1} / root;
    for (int i = 0; i < kSize; ++i) column[i] = i < k || i >= width ? T{0} : column[i] * inverse;
    column[k] = root;
    for (int j = k + 1; j < width; ++j) {
      const T factor = column[j];
      for (int i = 0; i < kSize; ++i) tile[j * kSize + i] -= column[i] * factor;
    }
  }
  return -1;
}

/// inverse = lower^-1 for a lower triangular tile; zero elsewhere.
template <typename T>
inline void invert_lower(const T* lower, int width, T* inverse) {
  for (int j = 0; j < width; ++j) {
    T column[kSize] = {};
    column[j] = T{1};
    for (int k = j; k < width; ++k) {
      column[k] /= lower[k * kSize + k];
      for (int i = k + 1; i < width; ++i) column[i] -= lower[k * kSize + i] * column[k];
    }
    for (int i = 0; i < kSize; ++i) inverse[j * kSize + i] = column[i];
  }
}

/// C_t <- C_t D^-T for `R` adjacent tiles, D lower triangular; reciprocal[k] = 1 / D_kk.
template <int R, typename T>
inline void solve_right(T* c, int width, const T* lower, const T* reciprocal) {
  for (int k = 0; k < width; ++k) {
    for (int r = 0; r < R; ++r) {
      for (int h = 0; h < kParts<T>; ++h) {
        T* tile = c + r * width * kSize + h * Blocking<T>::kLanes;
        const Vec<T> solved = load(tile + k * kSize) * reciprocal[k];
        store(tile + k * kSize, solved);
        for (int j = k + 1; j < width; ++j) {
          store(tile + j * kSize, load(tile + j * kSize) - solved * lower[k * kSize + j]);
        }
      }
    }
  }
}

}  // namespace diffsim::tiles
