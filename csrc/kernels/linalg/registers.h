// A few vectors that go through the same arithmetic side by side.
//
// Chains of square roots and divisions leave the processor waiting; independent chains interleaved
// with the first fill the gaps. Offers what the templates of svd3.h use of a vector.
#pragma once

#include <type_traits>

#include "kernels/linalg/lanes.h"

namespace diffsim {

template <class V, int n>
struct Registers {
  V at[n];
};
template <class M, int n>
struct RegistersMask {
  M at[n];
};

// Side by side what f gives of the number of a register.
template <class Out, class F>
DIFFSIM_INLINE Out each(const F& f) {
  Out out;
#pragma GCC unroll 8
  for (int i = 0; i < static_cast<int>(std::extent_v<decltype(out.at)>); ++i) out.at[i] = f(i);
  return out;
}

template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator+(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] + y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator-(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] - y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator*(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] * y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator/(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] / y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator+(const Registers<V, n>& x, double y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] + y; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator-(const Registers<V, n>& x, double y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] - y; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator*(const Registers<V, n>& x, double y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] * y; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator+(double x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x + y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator-(double x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x - y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator*(double x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x * y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator/(double x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return x / y.at[i]; });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n>& operator+=(Registers<V, n>& x, const Registers<V, n>& y) {
  return x = x + y;
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n>& operator-=(Registers<V, n>& x, const Registers<V, n>& y) {
  return x = x - y;
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> operator-(const Registers<V, n>& x) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return -x.at[i]; });
}
template <class M, int n>
DIFFSIM_INLINE RegistersMask<M, n> operator|(const RegistersMask<M, n>& x,
                                             const RegistersMask<M, n>& y) {
  return each<RegistersMask<M, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] | y.at[i]; });
}
template <class M, int n>
DIFFSIM_INLINE RegistersMask<M, n> operator&(const RegistersMask<M, n>& x,
                                             const RegistersMask<M, n>& y) {
  return each<RegistersMask<M, n>>([&](int i) DIFFSIM_INLINED { return x.at[i] & y.at[i]; });
}
template <class M, int n>
DIFFSIM_INLINE RegistersMask<M, n> operator~(const RegistersMask<M, n>& x) {
  return each<RegistersMask<M, n>>([&](int i) DIFFSIM_INLINED { return ~x.at[i]; });
}

template <class V, int n>
DIFFSIM_INLINE RegistersMask<MaskOf<V>, n> less(const Registers<V, n>& x,
                                                const Registers<V, n>& y) {
  return each<RegistersMask<MaskOf<V>, n>>([&](int i)
                                               DIFFSIM_INLINED { return less(x.at[i], y.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE RegistersMask<MaskOf<V>, n> greater(const Registers<V, n>& x,
                                                   const Registers<V, n>& y) {
  return less(y, x);
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> select(const RegistersMask<MaskOf<V>, n>& m,
                                      const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i)
                                   DIFFSIM_INLINED { return select(m.at[i], x.at[i], y.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> keep(const RegistersMask<MaskOf<V>, n>& m,
                                    const Registers<V, n>& x) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return keep(m.at[i], x.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> sqrt(const Registers<V, n>& x) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return sqrt(x.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> abs(const Registers<V, n>& x) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return abs(x.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> copysign(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return copysign(x.at[i], y.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> max(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return max(x.at[i], y.at[i]); });
}
template <class V, int n>
DIFFSIM_INLINE Registers<V, n> min(const Registers<V, n>& x, const Registers<V, n>& y) {
  return each<Registers<V, n>>([&](int i) DIFFSIM_INLINED { return min(x.at[i], y.at[i]); });
}
template <class M, int n>
DIFFSIM_INLINE bool all(const RegistersMask<M, n>& m) {
  M every = m.at[0];
  for (int i = 1; i < n; ++i) every = every & m.at[i];
  return all(every);
}
template <class M, int n>
DIFFSIM_INLINE bool any(const RegistersMask<M, n>& m) {
  M some = m.at[0];
  for (int i = 1; i < n; ++i) some = some | m.at[i];
  return any(some);
}
template <class V, int n>
DIFFSIM_INLINE void binary_scale(const Registers<V, n>& x, Registers<V, n>& scale,
                                 Registers<V, n>& inverse) {
  for (int i = 0; i < n; ++i) binary_scale(x.at[i], scale.at[i], inverse.at[i]);
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
  using T = Registers<Native, 2>;
  static constexpr int kCount = 2;
  int first;

  template <int n>
  DIFFSIM_INLINE void get(const Lane* A, T* out) const {
    Native a[n], b[n];
    OneRegister{first}.get<n>(A, a);
    OneRegister{first + 1}.get<n>(A, b);
    for (int k = 0; k < n; ++k) out[k] = {{a[k], b[k]}};
  }
  template <int n>
  DIFFSIM_INLINE void set(Lane* A, const T* in) const {
    Native a[n], b[n];
    for (int k = 0; k < n; ++k) a[k] = in[k].at[0], b[k] = in[k].at[1];
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
