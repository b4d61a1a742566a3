// Two vectors that go through the same arithmetic side by side.
//
// Chains of square roots and divisions leave the processor waiting; a second, independent chain
// interleaved with the first fills the gaps. Offers what the templates of svd3.h use of a vector.
#pragma once

#include "kernels/linalg/lanes.h"

namespace diffsim {

template <class V>
struct Pair {
  V a, b;
};
template <class M>
struct PairMask {
  M a, b;
};

template <class V>
DIFFSIM_INLINE Pair<V> operator+(const Pair<V>& x, const Pair<V>& y) {
  return {x.a + y.a, x.b + y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator-(const Pair<V>& x, const Pair<V>& y) {
  return {x.a - y.a, x.b - y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator*(const Pair<V>& x, const Pair<V>& y) {
  return {x.a * y.a, x.b * y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator/(const Pair<V>& x, const Pair<V>& y) {
  return {x.a / y.a, x.b / y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator+(const Pair<V>& x, double y) {
  return {x.a + y, x.b + y};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator-(const Pair<V>& x, double y) {
  return {x.a - y, x.b - y};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator*(const Pair<V>& x, double y) {
  return {x.a * y, x.b * y};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator+(double x, const Pair<V>& y) {
  return {x + y.a, x + y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator-(double x, const Pair<V>& y) {
  return {x - y.a, x - y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator*(double x, const Pair<V>& y) {
  return {x * y.a, x * y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator/(double x, const Pair<V>& y) {
  return {x / y.a, x / y.b};
}
template <class V>
DIFFSIM_INLINE Pair<V> operator-(const Pair<V>& x) {
  return {-x.a, -x.b};
}
template <class M>
DIFFSIM_INLINE PairMask<M> operator|(const PairMask<M>& x, const PairMask<M>& y) {
  return {x.a | y.a, x.b | y.b};
}

template <class V>
DIFFSIM_INLINE PairMask<MaskOf<V>> less(const Pair<V>& x, const Pair<V>& y) {
  return {less(x.a, y.a), less(x.b, y.b)};
}
template <class V>
DIFFSIM_INLINE PairMask<MaskOf<V>> greater(const Pair<V>& x, const Pair<V>& y) {
  return less(y, x);
}
template <class V>
DIFFSIM_INLINE Pair<V> select(const PairMask<MaskOf<V>>& m, const Pair<V>& x, const Pair<V>& y) {
  return {select(m.a, x.a, y.a), select(m.b, x.b, y.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> keep(const PairMask<MaskOf<V>>& m, const Pair<V>& x) {
  return {keep(m.a, x.a), keep(m.b, x.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> sqrt(const Pair<V>& x) {
  return {sqrt(x.a), sqrt(x.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> abs(const Pair<V>& x) {
  return {abs(x.a), abs(x.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> copysign(const Pair<V>& x, const Pair<V>& y) {
  return {copysign(x.a, y.a), copysign(x.b, y.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> max(const Pair<V>& x, const Pair<V>& y) {
  return {max(x.a, y.a), max(x.b, y.b)};
}
template <class V>
DIFFSIM_INLINE Pair<V> min(const Pair<V>& x, const Pair<V>& y) {
  return {min(x.a, y.a), min(x.b, y.b)};
}
template <class M>
DIFFSIM_INLINE bool any(const PairMask<M>& m) {
  const M either = m.a | m.b;
  return any(either);
}
template <class V>
DIFFSIM_INLINE void binary_scale(const Pair<V>& x, Pair<V>& scale, Pair<V>& inverse) {
  binary_scale(x.a, scale.a, inverse.a);
  binary_scale(x.b, scale.b, inverse.b);
}

}  // namespace diffsim
