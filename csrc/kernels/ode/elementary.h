// Sines, exponentials and their like of every lane, within 1 ulp of the value (tanh: 2).
//
// A lane's bits depend on its own argument alone, whatever stands beside it. Arguments that are far
// out, infinite or no numbers go to the C library one by one.
#pragma once

#include <cmath>

#include "kernels/linalg/lanes.h"

namespace diffsim {

/// f of every lane by itself.
template <class F>
DIFFSIM_INLINE Native each_lane(const Native& a, F f) {
  Native r;
  for (int i = 0; i < kNativeLanes; ++i) r[i] = f(a[i]);
  return r;
}
template <class F>
DIFFSIM_INLINE Native each_lane(const Native& a, const Native& b, F f) {
  Native r;
  for (int i = 0; i < kNativeLanes; ++i) r[i] = f(a[i], b[i]);
  return r;
}

namespace detail {

/// `found`, but f(x) by itself in lanes where |x| < limit does not hold.
template <class F>
DIFFSIM_INLINE Native or_alone(const Native& x, double limit, const Native& found, F f) {
  const NativeMask usual = less<Native>(abs(x), broadcast<Native>(limit));
  if (all(usual)) return found;
  return select<Native>(usual, found, each_lane(x, f));
}

constexpr double kRounding = 6755399441055744.0;  // 2^52 + 2^51: what is added to it is rounded

/// a - b as a rounded difference and what that leaves (Knuth).
DIFFSIM_INLINE Native difference(const Native& a, const Native& b, Native& left) {
  const Native d = a - b, taken = d - a;
  left = (a - (d - taken)) - (b + taken);
  return d;
}

/// x less the nearest multiple of pi/2, as a sum, |x| < 1e6; two bits of the multiple.
///
/// pi/2 in four parts of 33 bits (Cody and Waite; fdlibm): multiples of the first three are exact.
DIFFSIM_INLINE Native quarter_turns(const Native& x, Native& low, BitsOf<Native>& count) {
  const Native shifted = x * 6.36619772367581382433e-01 + kRounding;
  const Native n = shifted - kRounding;
  count = (BitsOf<Native>)shifted & 3;
  Native left, more;
  const Native first = x - n * 1.57079632673412561417e+00;
  const Native second = difference(first, n * 6.07710050630396597660e-11, left);
  const Native third = difference(second, n * 2.02226624871116645580e-21, more);
  const Native rest = (left + more) - n * 8.47842766036889956997e-32;
  const Native high = third + rest;
  low = rest - (high - third);
  return high;
}

/// sin(x + y) and cos(x + y), |x| <= pi/4, y below an ulp of x; polynomials of fdlibm.
DIFFSIM_INLINE Native sin_near(const Native& x, const Native& y) {
  const Native z = x * x, v = z * x;
  Native r = z * 1.58969099521155010221e-10 - 2.50507602534068634195e-08;
  r = z * r + 2.75573137070700676789e-06;
  r = z * r - 1.98412698298579493134e-04;
  r = z * r + 8.33333333332248946124e-03;
  return x - ((z * (0.5 * y - v * r) - y) + v * 1.66666666666666324348e-01);
}
DIFFSIM_INLINE Native cos_near(const Native& x, const Native& y) {
  const Native z = x * x, half = 0.5 * z, w = 1.0 - half;
  Native r = z * -1.13596475577881948265e-11 + 2.08757232129817482790e-09;
  r = z * r - 2.75573143513906633035e-07;
  r = z * r + 2.48015872894767294178e-05;
  r = z * r - 1.38888888888741095749e-03;
  r = z * r + 4.16666666666666019037e-02;
  return w + (((1.0 - w) - half) + (z * (z * r) - x * y));
}

/// Sine of x plus some quarter turns.
DIFFSIM_INLINE Native sin_turned(const Native& x, std::uint64_t turns) {
  Native low;
  BitsOf<Native> count;
  const Native high = quarter_turns(x, low, count);
  count += turns;
  const NativeMask odd = -(NativeMask)(count & 1);
  const Native found = select<Native>(odd, cos_near(high, low), sin_near(high, low));
  return (Native)((BitsOf<Native>)found ^ ((count & 2) << 62));
}

}  // namespace detail

// Not inlined: one piece of code has the same bits wherever it is called.
#define DIFFSIM_ALONE inline __attribute__((noinline))

DIFFSIM_ALONE Native sin(const Native& x) {
  const Native tiny = broadcast<Native>(0x1p-28);
  const Native found = select<Native>(less<Native>(abs(x), tiny), x, detail::sin_turned(x, 0));
  return detail::or_alone(x, 1e6, found, [](double a) { return std::sin(a); });
}

DIFFSIM_ALONE Native cos(const Native& x) {
  return detail::or_alone(x, 1e6, detail::sin_turned(x, 1), [](double a) { return std::cos(a); });
}

/// After fdlibm: x = k ln 2 + r, exp(r) = 1 + r + r c / (2 - c).
DIFFSIM_ALONE Native exp(const Native& x) {
  const Native shifted = x * 1.44269504088896338700e+00 + detail::kRounding;
  const Native k = shifted - detail::kRounding;
  const Native high = x - k * 6.93147180369123816490e-01, low = k * 1.90821492927058770002e-10;
  const Native r = high - low, t = r * r;
  Native c = t * 4.13813679705723846039e-08 - 1.65339022054652515390e-06;
  c = t * c + 6.61375632143793436117e-05;
  c = t * c - 2.77777777770155933842e-03;
  c = t * c + 1.66666666666666019037e-01;
  c = r - t * c;
  const Native near = 1.0 - ((low - r * c / (2.0 - c)) - high);
  const Native scale = (Native)(((BitsOf<Native>)shifted + 1023) << 52);  // 2^k
  return detail::or_alone(x, 708.0, near * scale, [](double a) { return std::exp(a); });
}

/// After Cephes (Moshier): a rational function near zero, else 1 - 2 / (exp(2 |x|) + 1).
DIFFSIM_ALONE Native tanh(const Native& x) {
  const Native far = min(abs(x), broadcast<Native>(32.0)), z = x * x;
  Native p = z * -9.64399179425052238628e-01 - 9.92877231001918586564e+01;
  p = z * p - 1.61468768441708447952e+03;
  Native q = z + 1.12811678491632931402e+02;
  q = z * q + 2.23548839060100448583e+03;
  q = z * q + 4.84406305325125486048e+03;
  const Native outer = 1.0 - 2.0 / (exp(2.0 * far) + 1.0), inner = far + far * (z * p / q);
  const Native size = select<Native>(less<Native>(far, broadcast<Native>(0.625)), inner, outer);
  return detail::or_alone(x, 1e6, copysign(size, x), [](double a) { return std::tanh(a); });
}

#undef DIFFSIM_ALONE

}  // namespace diffsim
