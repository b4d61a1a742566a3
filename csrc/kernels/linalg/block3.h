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
// How far ahead of its use a block is asked for: past what the hardware's own streams, which end at
// pages of 4 KiB, have fetched by then.
constexpr int kBytesAhead3 = 4096;

/// Row i, column k of a block.
DIFFSIM_INLINE constexpr int block3_place(int i, int k) { return 3 * k + i; }

constexpr float kShortUnit = 65536.0F;     ///< what one of a block of 16-bit integers stands for
constexpr float kLargestShort = 32767.0F;  ///< the largest of these

namespace detail {
// Four doubles, or as many of them as a register holds; GCC ignores vector sizes of dependent
// types.
#if defined(__AVX__)
using Doubles = double __attribute__((vector_size(32)));
#else
using Doubles = double __attribute__((vector_size(16)));
#endif
using Floats = float __attribute__((vector_size(16)));

template <typename Vector, typename T>
DIFFSIM_INLINE Vector load_rows(const T* from) {
  Vector rows;
  std::memcpy(&rows, from, sizeof(rows));
  return rows;
}
/// Four integers times kShortUnit: above a zero each is one of 32 bits.
DIFFSIM_INLINE Floats load_shorts(const std::int16_t* from) {
  using Shorts = std::int16_t __attribute__((vector_size(16)));
  using Halves = std::int64_t __attribute__((vector_size(16)));
  using Integers = std::int32_t __attribute__((vector_size(16)));
  std::int64_t bits;
  std::memcpy(&bits, from, sizeof(bits));
  const auto four = reinterpret_cast<Shorts>(Halves{bits, 0});
  const auto wide = __builtin_shufflevector(Shorts{}, four, 0, 8, 1, 9, 2, 10, 3, 11);
  return __builtin_convertvector(reinterpret_cast<Integers>(wide), Floats);
}
/// Rounds a number that 16 bits hold, and returns bits of which these are the last: a sum with
/// kRounds has no digits below one.
template <typename Bits, typename T>
DIFFSIM_INLINE Bits to_short(const T& number, T& rounded) {
  constexpr float kRounds = 0x1.8p23F;
  const T sum = number + kRounds;
  rounded = sum - kRounds;
  Bits bits;
  std::memcpy(&bits, &sum, sizeof(bits));
  return bits;
}

/// A block's numbers in float32.
struct Numbers3 {
  Floats first = {}, second = {};
  float last = 0.0F;

  Numbers3() = default;
  DIFFSIM_INLINE explicit Numbers3(const double* block) {
    float numbers[kBlock3];
    for (int k = 0; k < kBlock3; ++k) numbers[k] = static_cast<float>(block[k]);
    first = load_rows<Floats>(numbers), second = load_rows<Floats>(numbers + 4), last = numbers[8];
  }
};
}  // namespace detail

/// Sum over entries [begin, end) of a row of the blocks times their columns' 3-vectors in x.
DIFFSIM_INLINE void block3_row(const double* blocks, const std::int32_t* column, std::int64_t begin,
                               std::int64_t end, const double* x, double out[3]) {
  using Vector = detail::Doubles;
  constexpr int kWidth = sizeof(Vector) / sizeof(double), kNum = 4 / kWidth;
  constexpr int kAhead = kBytesAhead3 / sizeof(double);
  Vector total[3][kNum] = {};
  for (std::int64_t e = begin; e < end; ++e) {
    const double* block = blocks + kBlock3 * e;
    const double* from = x + 3 * static_cast<std::int64_t>(column[e]);
    __builtin_prefetch(block + kAhead);
    for (int k = 0; k < 3; ++k)
      for (int n = 0; n < kNum; ++n)
        total[k][n] += detail::load_rows<Vector>(block + block3_place(n * kWidth, k)) * from[k];
  }
  double sums[4];
  for (int n = 0; n < kNum; ++n) {
    const Vector sum = (total[0][n] + total[1][n]) + total[2][n];
    std::memcpy(sums + n * kWidth, &sum, sizeof(sum));
  }
  for (int i = 0; i < 3; ++i) out[i] = sums[i];
}

/// The largest magnitude among the numbers of some blocks.
class Largest3 {
 public:
  DIFFSIM_INLINE void take(const double* block) {
    const detail::Numbers3 n(block);
    raise(n.first, most_.first), raise(-n.first, most_.first);
    raise(n.second, most_.second), raise(-n.second, most_.second);
    raise(n.last, most_.last), raise(-n.last, most_.last);
  }
  float value() const {
    float most = most_.last;
    for (int k = 0; k < 4; ++k) raise(most_.first[k], most), raise(most_.second[k], most);
    return most;
  }

 private:
  template <typename T>
  DIFFSIM_INLINE static void raise(const T& number, T& most) {
    most = number > most ? number : most;
  }
  detail::Numbers3 most_;
};

/// Writes unit times a block in float32.
DIFFSIM_INLINE void scale_block3(const double* block, float unit, float* out) {
  const detail::Numbers3 n(block);
  const detail::Floats first = unit * n.first, second = unit * n.second;
  std::memcpy(out, &first, sizeof(first));
  std::memcpy(out + 4, &second, sizeof(second));
  out[8] = unit * n.last;
}

/// Rounds blocks to 16-bit integers, and adds up what that takes off them.
class Rounding3 {
 public:
  /// Writes unit times a block, whose numbers 16 bits must hold.
  /// @param[in] weight  of what is lost in its sum
  DIFFSIM_INLINE void write(const double* block, float unit, float weight, std::int16_t* to) {
    using Shorts = std::int16_t __attribute__((vector_size(16)));
    const detail::Numbers3 n(block);
    detail::Numbers3 kept;
    const auto low = detail::to_short<Shorts>(unit * n.first, kept.first);
    const auto high = detail::to_short<Shorts>(unit * n.second, kept.second);
    const auto last = detail::to_short<std::int32_t>(unit * n.last, kept.last);
    const Shorts eight = __builtin_shufflevector(low, high, 0, 2, 4, 6, 8, 10, 12, 14);
    std::memcpy(to, &eight, sizeof(eight));
    to[8] = static_cast<std::int16_t>(last);
    lost_.first += (unit * n.first - kept.first) * weight;
    lost_.second += (unit * n.second - kept.second) * weight;
    lost_.last += (unit * n.last - kept.last) * weight;
  }
  /// At a place of a block, in integers times weights.
  float lost(int place) const {
    return place < 4 ? lost_.first[place] : place < 8 ? lost_.second[place - 4] : lost_.last;
  }

 private:
  detail::Numbers3 lost_;
};

/// The same of blocks of 16-bit integers that stand for kShortUnit each, and of the row's own block
/// on the diagonal, which is float32 and has zeros among the integers.
DIFFSIM_INLINE void short_block3_row(const std::int16_t* blocks, const float* diagonal,
                                     const std::int32_t* column, std::int64_t row,
                                     std::int64_t begin, std::int64_t end, const float* x,
                                     float out[3]) {
  using Vector = detail::Floats;
  constexpr int kAhead = kBytesAhead3 / sizeof(std::int16_t);
  Vector total[3];
  for (int k = 0; k < 3; ++k)
    total[k] = detail::load_rows<Vector>(diagonal + kBlock3 * row + 3 * k) * x[3 * row + k];
  for (std::int64_t e = begin; e < end; ++e) {
    const std::int16_t* block = blocks + kBlock3 * e;
    const float* from = x + 3 * static_cast<std::int64_t>(column[e]);
    __builtin_prefetch(block + kAhead);
    for (int k = 0; k < 3; ++k) total[k] += detail::load_shorts(block + 3 * k) * from[k];
  }
  const Vector sum = (total[0] + total[1]) + total[2];
  for (int i = 0; i < 3; ++i) out[i] = sum[i];
}

}  // namespace diffsim
