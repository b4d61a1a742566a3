// A number with its derivatives along as many directions as a register has lanes: forward mode
// whose values are computed once for all of them.
#pragma once

#include <cmath>

#include "kernels/linalg/lanes.h"

namespace diffsim {

struct LaneDual {
  double value = 0.0;
  Native along = {};

  LaneDual() = default;
  DIFFSIM_INLINE LaneDual(double v) : value(v) {}  // NOLINT: constants mix freely
  DIFFSIM_INLINE LaneDual(double v, const Native& a) : value(v), along(a) {}

  DIFFSIM_INLINE LaneDual& operator+=(const LaneDual& b) { return *this = *this + b; }
  DIFFSIM_INLINE LaneDual& operator-=(const LaneDual& b) { return *this = *this - b; }
  DIFFSIM_INLINE friend LaneDual operator+(const LaneDual& a, const LaneDual& b) {
    return {a.value + b.value, a.along + b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator+(double a, const LaneDual& b) {
    return {a + b.value, b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator+(const LaneDual& a, double b) { return b + a; }
  DIFFSIM_INLINE friend LaneDual operator-(const LaneDual& a, const LaneDual& b) {
    return {a.value - b.value, a.along - b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator-(double a, const LaneDual& b) {
    return {a - b.value, -b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator-(const LaneDual& a, double b) { return -b + a; }
  DIFFSIM_INLINE friend LaneDual operator*(const LaneDual& a, const LaneDual& b) {
    return {a.value * b.value, a.along * b.value + a.value * b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator*(double a, const LaneDual& b) {
    return {a * b.value, a * b.along};
  }
  DIFFSIM_INLINE friend LaneDual operator*(const LaneDual& a, double b) { return b * a; }
  DIFFSIM_INLINE friend LaneDual operator/(const LaneDual& a, const LaneDual& b) {
    const double inverse = 1.0 / b.value, value = a.value * inverse;
    return {value, (a.along - value * b.along) * inverse};
  }
  DIFFSIM_INLINE friend LaneDual operator/(const LaneDual& a, double b) {
    const double inverse = 1.0 / b;
    return {a.value * inverse, a.along * inverse};
  }
  DIFFSIM_INLINE friend LaneDual operator/(double a, const LaneDual& b) {
    const double inverse = 1.0 / b.value, value = a * inverse;
    return {value, (-value * inverse) * b.along};
  }
  DIFFSIM_INLINE friend LaneDual sqrt(const LaneDual& a) {
    const double root = std::sqrt(a.value);
    return {root, (0.5 / root) * a.along};
  }
  /// A function of x, from its value and slope there.
  DIFFSIM_INLINE friend LaneDual chain(const LaneDual& x, double value, double slope) {
    return {value, slope * x.along};
  }
  DIFFSIM_INLINE friend double value_of(const LaneDual& x) { return x.value; }
};

inline double chain(double, double value, double) { return value; }
inline double value_of(double x) { return x; }
DIFFSIM_INLINE Native chain(const Native&, const Native& value, const Native&) { return value; }
DIFFSIM_INLINE Native value_of(const Native& x) { return x; }

}  // namespace diffsim
