// Eight doubles side by side: one element per lane, the same arithmetic for all.
//
// GCC/Clang vector extensions. The same source is compiled once per instruction set, and the
// compiler lowers a Lane to one AVX-512 register, two AVX2 registers or four SSE2 and NEON ones.
// A vector wider than a register lives in memory, whatever is done with it (comparisons and `?:`
// are even taken apart lane by lane). So a Lane is what memory holds, and kernels are templates
// over the vector type, instantiated with Native, one register, and applied to each part of a Lane
// with split() and join().
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

#define DIFFSIM_INLINED __attribute__((always_inline))  // of lambdas
#define DIFFSIM_INLINE inline DIFFSIM_INLINED

namespace diffsim {

/// Bytes of the widest register that this build may use.
#if defined(__AVX512F__)
constexpr int kNativeBytes = 64;
#elif defined(__AVX__)
constexpr int kNativeBytes = 32;
#else
constexpr int kNativeBytes = 16;
#endif

// Vector types are aligned to their size without being told.
using Lane = double __attribute__((vector_size(64)));
using LaneMask = std::int64_t __attribute__((vector_size(64)));  // 0 or -1 in each lane
using Native = double __attribute__((vector_size(kNativeBytes)));
using NativeMask = std::int64_t __attribute__((vector_size(kNativeBytes)));

constexpr int kLanes = 8;
constexpr int kNativeLanes = kNativeBytes / 8;
constexpr int kParts = kLanes / kNativeLanes;  ///< registers per Lane

namespace detail {
template <int kBytes>
struct MaskOfSize;
template <>
struct MaskOfSize<16> {
  using type = std::int64_t __attribute__((vector_size(16)));
};
template <>
struct MaskOfSize<32> {
  using type = std::int64_t __attribute__((vector_size(32)));
};
template <>
struct MaskOfSize<64> {
  using type = std::int64_t __attribute__((vector_size(64)));
};
template <int kBytes>
struct BitsOfSize;
template <>
struct BitsOfSize<16> {
  using type = std::uint64_t __attribute__((vector_size(16)));
};
template <>
struct BitsOfSize<32> {
  using type = std::uint64_t __attribute__((vector_size(32)));
};
template <>
struct BitsOfSize<64> {
  using type = std::uint64_t __attribute__((vector_size(64)));
};
}  // namespace detail

/// The mask type of a vector of doubles, and its bits as unsigned integers.
template <class V>
using MaskOf = typename detail::MaskOfSize<sizeof(V)>::type;
template <class V>
using BitsOf = typename detail::BitsOfSize<sizeof(V)>::type;

/// Number of doubles in a vector type.
template <class V>
constexpr int width() {
  return static_cast<int>(sizeof(V) / sizeof(double));
}

/// Part i in [0, kParts) of a Lane, and back.
DIFFSIM_INLINE Native split(const Lane& a, int i) {
  Native part;
  std::memcpy(&part, reinterpret_cast<const char*>(&a) + i * kNativeBytes, kNativeBytes);
  return part;
}
DIFFSIM_INLINE void join(Lane& a, int i, Native part) {
  std::memcpy(reinterpret_cast<char*>(&a) + i * kNativeBytes, &part, kNativeBytes);
}

namespace detail {
template <class To, class From>
DIFFSIM_INLINE To part_of(const From& a, int i) {
  To part;
  std::memcpy(&part, reinterpret_cast<const char*>(&a) + i * static_cast<int>(sizeof(To)),
              sizeof(To));
  return part;
}
template <class To, class Part>
DIFFSIM_INLINE void put_part(To& a, int i, const Part& part) {
  std::memcpy(reinterpret_cast<char*>(&a) + i * static_cast<int>(sizeof(Part)), &part,
              sizeof(Part));
}
}  // namespace detail

template <class V = Lane>
DIFFSIM_INLINE V broadcast(double value) {
  return value - V{};  // folds to a broadcast; V{} + value would not, for -0.0 + 0.0 is 0.0
}
template <class V = Lane>
DIFFSIM_INLINE V load(const double* p) {  // any alignment
  V a;
  std::memcpy(&a, p, sizeof(V));
  return a;
}
template <class V>
DIFFSIM_INLINE void store(double* p, const V& a) {
  std::memcpy(p, &a, sizeof(V));
}

/// a < b, lane by lane; false where either is NaN.
template <class V>
DIFFSIM_INLINE MaskOf<V> less(const V& a, const V& b) {
  if constexpr (sizeof(V) <= kNativeBytes) {
    return a < b;
  } else {
    MaskOf<V> m;
    for (int i = 0; i < kParts; ++i) {
      const NativeMask part = detail::part_of<Native>(a, i) < detail::part_of<Native>(b, i);
      detail::put_part(m, i, part);
    }
    return m;
  }
}
template <class V>
DIFFSIM_INLINE MaskOf<V> greater(const V& a, const V& b) {
  return less(b, a);
}

/// mask ? a : b, lane by lane.
template <class V>
DIFFSIM_INLINE V select(const MaskOf<V>& mask, const V& a, const V& b) {
  if constexpr (sizeof(V) <= kNativeBytes) {
    return mask ? a : b;
  } else {
    using M = MaskOf<V>;
    return (V)((mask & (M)a) | (~mask & (M)b));
  }
}

template <class V>
DIFFSIM_INLINE V sqrt(const V& a) {
  if constexpr (sizeof(V) > kNativeBytes) {
    V r;
    for (int i = 0; i < kParts; ++i) {
      detail::put_part(r, i, sqrt<Native>(detail::part_of<Native>(a, i)));
    }
    return r;
  } else {
#if defined(__clang__)
#if __has_builtin(__builtin_elementwise_sqrt)
    return __builtin_elementwise_sqrt(a);
#endif
#else
#if defined(__AVX512F__)
    if constexpr (sizeof(V) == 64) {  // all lanes, rounded as the processor is set (4)
      return (V)__builtin_ia32_sqrtpd512_mask(a, V{}, -1, 4);
    }
#endif
#if defined(__AVX__)
    if constexpr (sizeof(V) == 32) return (V)__builtin_ia32_sqrtpd256(a);
#endif
#if defined(__SSE2__)
    if constexpr (sizeof(V) == 16) return (V)__builtin_ia32_sqrtpd(a);
#endif
#endif
    V r = a;
    for (int i = 0; i < width<V>(); ++i) r[i] = std::sqrt(a[i]);
    return r;
  }
}

template <class V>
DIFFSIM_INLINE V abs(const V& a) {
  using M = MaskOf<V>;
  return (V)((M)a & INT64_C(0x7fffffffffffffff));
}
/// |a| with the sign of b.
template <class V>
DIFFSIM_INLINE V copysign(const V& a, const V& b) {
  using M = MaskOf<V>;
  return (V)(((M)a & INT64_C(0x7fffffffffffffff)) | ((M)b & INT64_MIN));
}
/// The larger (smaller) one; b where either is NaN.
template <class V>
DIFFSIM_INLINE V max(const V& a, const V& b) {
  return select<V>(less(b, a), a, b);
}
template <class V>
DIFFSIM_INLINE V min(const V& a, const V& b) {
  return select<V>(less(a, b), a, b);
}
/// a where the mask is set, +0 elsewhere.
template <class V>
DIFFSIM_INLINE V keep(const MaskOf<V>& mask, const V& a) {
  using M = MaskOf<V>;
  return (V)(mask & (M)a);
}

/// The power of two at or below x and its inverse; x is normal, positive and below 2^1023.
template <class V>
DIFFSIM_INLINE void binary_scale(const V& x, V& scale, V& inverse) {
  const MaskOf<V> exponent = (MaskOf<V>)x & INT64_C(0x7ff0000000000000);
  scale = (V)exponent;
  inverse = (V)(INT64_C(0x7fe0000000000000) - exponent);
}

namespace detail {
template <class M>
DIFFSIM_INLINE std::int64_t fold_or(const M& mask) {
#if defined(__AVX512DQ__)
  using Longs = long long __attribute__((vector_size(64)));
  if constexpr (sizeof(M) == 64) return __builtin_ia32_cvtq2mask512((Longs)mask);
#endif
#if defined(__AVX__)
  using Doubles4 = double __attribute__((vector_size(32)));
  if constexpr (sizeof(M) == 32) return __builtin_ia32_movmskpd256((Doubles4)mask);
#endif
#if defined(__SSE2__)
  using Doubles2 = double __attribute__((vector_size(16)));
  if constexpr (sizeof(M) == 16) return __builtin_ia32_movmskpd((Doubles2)mask);
#endif
  std::int64_t r = 0;
  for (unsigned i = 0; i < sizeof(M) / 8; ++i) r |= mask[i];
  return r;
}
}  // namespace detail

/// Whether any (every) lane of a mask is set.
template <class M>
DIFFSIM_INLINE bool any(const M& mask) {
  return detail::fold_or(mask) != 0;
}
template <class M>
DIFFSIM_INLINE bool all(const M& mask) {
  const M none = ~mask;
  return detail::fold_or(none) == 0;
}

/// Sum of the lanes in one fixed order. A Lane's is that of its registers, added up pairwise from
/// the halves: the same in every build.
DIFFSIM_INLINE double sum(const Lane& a) {
  return ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
}
template <class V, std::enable_if_t<width<V>() < kLanes, int> = 0>
DIFFSIM_INLINE double sum(const V& a) {
  if constexpr (width<V>() == 2)
    return a[0] + a[1];
  else
    return (a[0] + a[2]) + (a[1] + a[3]);
}
/// The registers of a Lane added up in the order of sum(), so that sum(fold(parts)) is the Lane's.
DIFFSIM_INLINE Native fold(const Native part[kParts]) {
  if constexpr (kParts == 1)
    return part[0];
  else if constexpr (kParts == 2)
    return part[0] + part[1];
  else
    return (part[0] + part[2]) + (part[1] + part[3]);
}

namespace detail {
// rows[i][j] <-> rows[j][i] for a square of width() vectors.
template <class V>
DIFFSIM_INLINE void transpose_square(V* rows) {
  if constexpr (width<V>() == 2) {
    const V a = rows[0], b = rows[1];
    rows[0] = __builtin_shufflevector(a, b, 0, 2);
    rows[1] = __builtin_shufflevector(a, b, 1, 3);
  } else if constexpr (width<V>() == 4) {
    const V a = __builtin_shufflevector(rows[0], rows[1], 0, 4, 2, 6);
    const V b = __builtin_shufflevector(rows[0], rows[1], 1, 5, 3, 7);
    const V c = __builtin_shufflevector(rows[2], rows[3], 0, 4, 2, 6);
    const V d = __builtin_shufflevector(rows[2], rows[3], 1, 5, 3, 7);
    rows[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5);
    rows[1] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
    rows[2] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
    rows[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
  } else {
    V a[8], b[8];
    for (int i = 0; i < 8; i += 2) {  // 1x1 blocks
      a[i] = __builtin_shufflevector(rows[i], rows[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
      a[i + 1] = __builtin_shufflevector(rows[i], rows[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i += 4) {  // 2x2 blocks
      for (int j = i; j < i + 2; ++j) {
        b[j] = __builtin_shufflevector(a[j], a[j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
        b[j + 2] = __builtin_shufflevector(a[j], a[j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
      }
    }
    for (int j = 0; j < 4; ++j) {  // 4x4 blocks
      rows[j] = __builtin_shufflevector(b[j], b[j + 4], 0, 1, 2, 3, 8, 9, 10, 11);
      rows[j + 4] = __builtin_shufflevector(b[j], b[j + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
  }
}
}  // namespace detail

/// The sums of width<V>() vectors, as the lanes of one; each in the order of sum().
template <class V>
DIFFSIM_INLINE V sum_each(const V* v) {
  V row[width<V>()];
  for (int i = 0; i < width<V>(); ++i) row[i] = v[i];
  detail::transpose_square(row);
  if constexpr (width<V>() == 2)
    return row[0] + row[1];
  else if constexpr (width<V>() == 4)
    return (row[0] + row[2]) + (row[1] + row[3]);
  else
    return ((row[0] + row[4]) + (row[2] + row[6])) + ((row[1] + row[5]) + (row[3] + row[7]));
}

/// Reads width<V>() consecutive records of kSize doubles; out[k] holds entry k of every record.
template <int kSize, class V>
DIFFSIM_INLINE void load_records(const double* p, V* out) {
  if constexpr (sizeof(V) > kNativeBytes) {
    for (int i = 0; i < kParts; ++i) {
      Native part[kSize];
      load_records<kSize, Native>(p + i * kNativeLanes * kSize, part);
      for (int k = 0; k < kSize; ++k) detail::put_part(out[k], i, part[k]);
    }
  } else {
    constexpr int w = width<V>();
    constexpr int whole = kSize / w * w;
    for (int k = 0; k < whole; k += w) {
      for (int i = 0; i < w; ++i) out[k + i] = load<V>(p + i * kSize + k);
      detail::transpose_square(out + k);
    }
    for (int k = whole; k < kSize; ++k) {
      double column[w];
      for (int i = 0; i < w; ++i) column[i] = p[i * kSize + k];
      out[k] = load<V>(column);
    }
  }
}

/// The inverse of load_records.
template <int kSize, class V>
DIFFSIM_INLINE void store_records(double* p, const V* in) {
  if constexpr (sizeof(V) > kNativeBytes) {
    for (int i = 0; i < kParts; ++i) {
      Native part[kSize];
      for (int k = 0; k < kSize; ++k) part[k] = detail::part_of<Native>(in[k], i);
      store_records<kSize, Native>(p + i * kNativeLanes * kSize, part);
    }
  } else {
    constexpr int w = width<V>();
    constexpr int whole = kSize / w * w;
    for (int k = 0; k < whole; k += w) {
      V square[w];
      for (int i = 0; i < w; ++i) square[i] = in[k + i];
      detail::transpose_square(square);
      for (int i = 0; i < w; ++i) store(p + i * kSize + k, square[i]);
    }
    for (int k = whole; k < kSize; ++k) {
      for (int i = 0; i < w; ++i) p[i * kSize + k] = in[k][i];
    }
  }
}

}  // namespace diffsim
