// Two vectors that go through the same arithmetic side by side.
//
// Chains of square roots and divisions leave the processor waiting; a second, independent chain
// interleaved with the first fills the gaps. Offers what the templates of svd3.h use of a vector.
#pragma once

#include <type_traits>

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
DIFFSIM_INLINE Pair<V>& operator+=(Pair<V>& x, const Pair<V>& y) {
  return x = x + y;
}
template <class V>
DIFFSIM_INLINE Pair<V>& operator-=(Pair<V>& x, const Pair<V>& y) {
  return x = x - y;
}
template <class V>
DIFFSIM_INLINE Pair<V> operator-(const Pair<V>& x) {
  return {-x.a, -x.b};
}
template <class M>
DIFFSIM_INLINE PairMask<M> operator|(const PairMask<M>& x, const PairMask<M>& y) {
  return {x.a | y.a, x.b | y.b};
}
template <class M>
DIFFSIM_INLINE PairMask<M> operator&(const PairMask<M>& x, const PairMask<M>& y) {
  return {x.a & y.a, x.b & y.b};
}
template <class M>
DIFFSIM_INLINE PairMask<M> operator~(const PairMask<M>& x) {
  return {~x.a, ~x.b};
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
DIFFSIM_INLINE bool all(const PairMask<M>& m) {
  const M both = m.a & m.b;
  return all(both);
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

namespace detail {

// One or two registers, starting at the first-th, of consecutive arrays of n Lanes each.
struct OneRegister {
  using T = Native;
  static constexpr int kCount = 1;
  int first;

  template <int n>
  DIFFSIM_INLINE void get(const Lane* A, T* out) const {
    for (int k = 0; k < n; ++k) out[k] = split(A[first / kParts * n + k], first % kParts);
  }
  template <int n>
  DIFFSIM_INLINE void set(Lane* A, const T* in) const {
    for (int k = 0; k < n; ++k) join(A[first / kParts * n + k], first % kParts, in[k]);
  }
};
struct TwoRegisters {
  using T = Pair<Native>;
  static constexpr int kCount = 2;
  int first;

  template <int n>
  DIFFSIM_INLINE void get(const Lane* A, T* out) const {
    Native a[n], b[n];
    OneRegister{first}.get<n>(A, a);
    OneRegister{first + 1}.get<n>(A, b);
    for (int k = 0; k < n; ++k) out[k] = {a[k], b[k]};
  }
  template <int n>
  DIFFSIM_INLINE void set(Lane* A, const T* in) const {
    Native a[n], b[n];
    for (int k = 0; k < n; ++k) a[k] = in[k].a, b[k] = in[k].b;
    OneRegister{first}.set<n>(A, a);
    OneRegister{first + 1}.set<n>(A, b);
  }
};

// Calls f on the registers of kGroups Lanes, two at a time where there are two.
template <int kGroups, class F>
DIFFSIM_INLINE void for_registers(F&& f) {
  using R = std::conditional_t<kGroups * kParts % 2 == 0, TwoRegisters, OneRegister>;
  for (int i = 0; i < kGroups * kParts; i += R::kCount) f(R{i});
}

}  // namespace detail
}  // namespace diffsim
