// A logarithm of every lane that keeps its digits where strain energies need them: near 1.
#pragma once

#include <limits>

#include "kernels/linalg/lanes.h"
#include "kernels/linalg/registers.h"

namespace diffsim {

/// e - ln(1 + e) >= 0 within 2 ulp, also near e = 0, where it is e^2/2; +inf where e <= -1 or NaN.
///
/// After fdlibm's log (Sun Microsystems 1993): 1 + e = 2^k (1 + f), sqrt(1/2) <= 1 + f < sqrt(2),
///   f - ln(1 + f) = f^2/2 - z (f^2/2 + R(z^2)),  z = f / (2 + f),
/// with a minimax polynomial R. For k = 0, f is e itself, not the rounded (1 + e) - 1.
/// @param x  1 + e, which has its digits where e is close to -1
template <class T>
DIFFSIM_INLINE T log_gap(const T& e, const T& x) {
  using Bits = BitsOf<T>;
  constexpr std::uint64_t kSqrtHalf = 0x3fe6a09e667f3bcd, kMantissa = 52, kBias = 1024;
  const Bits bits = (Bits)x;
  const Bits k = (bits + ((kBias << kMantissa) - kSqrtHalf)) >> kMantissa;  // kBias + exponent
  const T scaled = (T)(bits - ((k - kBias) << kMantissa));
  // 2^52 + 2^51 in a double leaves its low bits for an integer.
  const T exponent = (T)(k + (std::uint64_t{0x4338000000000000} - kBias)) - 6755399441055744.0;
  const auto same = ~(less(exponent, broadcast<T>(0.0)) | less(broadcast<T>(0.0), exponent));
  const T f = select(same, e, scaled - 1.0);
  const T z = f / (2.0 + f), w = z * z, half = 0.5 * f * f;
  T r = w * 1.479819860511658591e-01 + 1.531383769920937332e-01;
  r = r * w + 1.818357216161805012e-01;
  r = r * w + 2.222219843214978396e-01;
  r = r * w + 2.857142874366239149e-01;
  r = r * w + 3.999999999940941908e-01;
  r = r * w + 6.666666666666735130e-01;
  const T gap = half - z * (half + r * w);
  const T infinity = broadcast<T>(std::numeric_limits<double>::infinity());
  return select(less(broadcast<T>(0.0), x), ((e - f) - exponent * 6.931471805599453094e-01) + gap,
                infinity);
}
template <class T>
DIFFSIM_INLINE T log_gap(const T& e) {
  return log_gap(e, T(1.0 + e));
}

}  // namespace diffsim
