// Rows of 3x3 blocks times 3-vectors, the inner loop of every product with a stiffness matrix.
//
// A block lies column by column. So lane i of four holds row i, a product needs no sum across lanes
// and no copy of the vector, and what the fourth lane gathers is never read. Blocks follow one
// another without gaps: the product streams them, and the last one needs room behind it.
#pragma once

#include <cstdint>
#include <cstring>

#include "kernels/linalg/lanes.h"

namespace diffsim {

constexpr int kBlock3 = 9;         ///< numbers of a block
constexpr int kBehindBlocks3 = 1;  ///< numbers behind the last block that may be read

/// Row i, column k of a block.
DIFFSIM_INLINE constexpr int block3_place(int i, int k) { return 3 * k + i; }

namespace detail {
// Four numbers, or as many of them as a register holds.
template <typename T, int kBytes>
struct Rows;  // GCC ignores vector sizes of dependent types
template <>
struct Rows<double, 32> {
  using type = double __attribute__((vector_size(32)));
};
template <>
struct Rows<double, 16> {
  using type = double __attribute__((vector_size(16)));
};
template <>
struct Rows<float, 16> {
  using type = float __attribute__((vector_size(16)));
};
}  // namespace detail

/// Sum over entries [begin, end) of a row of the blocks times their columns' 3-vectors in x.
template <typename T>
DIFFSIM_INLINE void block3_row(const T* blocks, const std::int32_t* column, std::int64_t begin,
                               std::int64_t end, const T* x, T out[3]) {
  constexpr int kFour = 4 * static_cast<int>(sizeof(T));
  constexpr int kBytes = kFour < kNativeBytes ? kFour : kNativeBytes, kNum = kFour / kBytes;
  constexpr int kWidth = kBytes / static_cast<int>(sizeof(T));
  // How far ahead of its use a block is asked for: past what the hardware's own streams, which end
  // at pages of 4 KiB, have fetched by then.
  constexpr int kAhead = 4096 / static_cast<int>(sizeof(T));
  using Vector = typename detail::Rows<T, kBytes>::type;
  Vector total[3][kNum] = {};
  for (std::int64_t e = begin; e < end; ++e) {
    const T* block = blocks + kBlock3 * e;
    const T* from = x + 3 * static_cast<std::int64_t>(column[e]);
    __builtin_prefetch(block + kAhead);
    for (int k = 0; k < 3; ++k)
      for (int n = 0; n < kNum; ++n) {
        Vector rows;
        std::memcpy(&rows, block + block3_place(n * kWidth, k), sizeof(rows));
        total[k][n] += rows * from[k];
      }
  }
  T sums[4];
  for (int n = 0; n < kNum; ++n) {
    const Vector sum = (total[0][n] + total[1][n]) + total[2][n];
    std::memcpy(sums + n * kWidth, &sum, sizeof(sum));
  }
  for (int i = 0; i < 3; ++i) out[i] = sums[i];
}

}  // namespace diffsim
