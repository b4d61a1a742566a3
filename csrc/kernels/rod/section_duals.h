// Numbers of several members, one in each lane, with their derivatives along the directions that a
// section has: its strains, the force beyond it and a factor of its tensions.
#pragma once

#include "kernels/rod/section.h"

namespace diffsim::rod {

constexpr int kDirections = 7;

struct SectionDuals {
  Native value = {}, along[kDirections] = {};

  /// The same with f(k) along direction k.
  template <class F>
  DIFFSIM_INLINE static SectionDuals of(const Native& value, F&& f) {
    SectionDuals out;
    out.value = value;
#pragma GCC unroll 7
    for (int k = 0; k < kDirections; ++k) out.along[k] = f(k);
    return out;
  }
  /// A function of x, from its value and slope there.
  DIFFSIM_INLINE static SectionDuals chained(const SectionDuals& x, const Native& value,
                                             const Native& slope) {
    return of(value, [&](int k) { return slope * x.along[k]; });
  }

  DIFFSIM_INLINE SectionDuals& operator+=(const SectionDuals& b) { return *this = *this + b; }
  DIFFSIM_INLINE SectionDuals& operator-=(const SectionDuals& b) { return *this = *this - b; }
  DIFFSIM_INLINE friend SectionDuals operator+(const SectionDuals& a, const SectionDuals& b) {
    return of(a.value + b.value, [&](int k) { return a.along[k] + b.along[k]; });
  }
  DIFFSIM_INLINE friend SectionDuals operator-(const SectionDuals& a, const SectionDuals& b) {
    return of(a.value - b.value, [&](int k) { return a.along[k] - b.along[k]; });
  }
  DIFFSIM_INLINE friend SectionDuals operator*(const SectionDuals& a, const SectionDuals& b) {
    return of(a.value * b.value,
              [&](int k) { return a.along[k] * b.value + a.value * b.along[k]; });
  }
  DIFFSIM_INLINE friend SectionDuals operator/(const SectionDuals& a, const SectionDuals& b) {
    const Native inverse = 1.0 / b.value, value = a.value * inverse;
    return of(value, [&](int k) { return (a.along[k] - value * b.along[k]) * inverse; });
  }
  DIFFSIM_INLINE friend SectionDuals operator/(double a, const SectionDuals& b) {
    const Native inverse = 1.0 / b.value, value = a * inverse;
    return chained(b, value, -value * inverse);
  }
  DIFFSIM_INLINE friend SectionDuals sqrt(const SectionDuals& a) {
    const Native root = diffsim::sqrt(a.value);
    return chained(a, root, 0.5 / root);
  }
  DIFFSIM_INLINE friend SectionDuals at_least(double least, const SectionDuals& x) {
    const Native bound = broadcast<Native>(least);
    const auto above = greater(x.value, bound);
    return of(select(above, x.value, bound), [&](int k) { return keep(above, x.along[k]); });
  }
};

/// Numbers without derivatives, of one or of all lanes.
template <class S>
using IfNumber = std::enable_if_t<std::is_same_v<S, double> || std::is_same_v<S, Native>, int>;

template <class S, IfNumber<S> = 0>
DIFFSIM_INLINE SectionDuals operator+(const S& a, const SectionDuals& b) {
  return SectionDuals::of(a + b.value, [&](int k) { return b.along[k]; });
}
template <class S, IfNumber<S> = 0>
DIFFSIM_INLINE SectionDuals operator+(const SectionDuals& a, const S& b) {
  return b + a;
}
template <class S, IfNumber<S> = 0>
DIFFSIM_INLINE SectionDuals operator-(const SectionDuals& a, const S& b) {
  return SectionDuals::of(a.value - b, [&](int k) { return a.along[k]; });
}
template <class S, IfNumber<S> = 0>
DIFFSIM_INLINE SectionDuals operator*(const S& a, const SectionDuals& b) {
  return SectionDuals::of(a * b.value, [&](int k) { return a * b.along[k]; });
}
template <class S, IfNumber<S> = 0>
DIFFSIM_INLINE SectionDuals operator*(const SectionDuals& a, const S& b) {
  return b * a;
}
DIFFSIM_INLINE SectionDuals operator/(const SectionDuals& a, const Native& b) {
  return (1.0 / b) * a;
}

}  // namespace diffsim::rod
