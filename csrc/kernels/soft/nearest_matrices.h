// The two projections of projective dynamics without singular values, near rest: the nearest
// rotation R of F, and the nearest matrix of determinant one B, see pd_material.h.
//
// With the stretch U = (F^T F)^(1/2), R = F U^-1. With B = R T and F - B = l cof(B),
//   T + l cof(T) = U,  det T = 1,
// for a symmetric T near U. All of these commute, so that Newton's equations are solved by products
// of symmetric matrices. Where only stresses are asked for (a line search needs no tangent) this
// replaces singular values and what follows them.
#pragma once

#include "kernels/linalg/lanes.h"

namespace diffsim {
namespace detail {

// A change of Newton's method after which the next, about its square, is rounding.
constexpr double kLastChange = 1e-8;

/// A symmetric matrix by its entries 00, 11, 22, 01, 02, 12.
template <class T>
struct Symmetric {
  T at[6];
};

template <class T>
DIFFSIM_INLINE Symmetric<T> cofactors(const Symmetric<T>& a) {
  const T* m = a.at;
  return {{m[1] * m[2] - m[5] * m[5], m[0] * m[2] - m[4] * m[4], m[0] * m[1] - m[3] * m[3],
           m[4] * m[5] - m[3] * m[2], m[3] * m[5] - m[4] * m[1], m[3] * m[4] - m[0] * m[5]}};
}
template <class T>
DIFFSIM_INLINE T determinant(const Symmetric<T>& a, const Symmetric<T>& cofactors_of_a) {
  return a.at[0] * cofactors_of_a.at[0] + a.at[3] * cofactors_of_a.at[3] +
         a.at[4] * cofactors_of_a.at[4];
}
/// Trace of a product.
template <class T>
DIFFSIM_INLINE T contract(const Symmetric<T>& a, const Symmetric<T>& b) {
  const T beside = a.at[3] * b.at[3] + a.at[4] * b.at[4] + a.at[5] * b.at[5];
  return a.at[0] * b.at[0] + a.at[1] * b.at[1] + a.at[2] * b.at[2] + (beside + beside);
}
/// The product of two that commute.
template <class T>
DIFFSIM_INLINE Symmetric<T> multiply(const Symmetric<T>& a, const Symmetric<T>& b) {
  const T *m = a.at, *n = b.at;
  return {{m[0] * n[0] + m[3] * n[3] + m[4] * n[4], m[3] * n[3] + m[1] * n[1] + m[5] * n[5],
           m[4] * n[4] + m[5] * n[5] + m[2] * n[2], m[0] * n[3] + m[3] * n[1] + m[4] * n[5],
           m[0] * n[4] + m[3] * n[5] + m[4] * n[2], m[3] * n[4] + m[1] * n[5] + m[5] * n[2]}};
}

/// U of S = U^2 by Newton's method, cofactors and determinant of it; false in lanes that are not
/// near rest or have not converged. There S is within 0.3 of one, so that no eigenvalue is
/// beyond 1.9 or below 0.1: the start has positive ones, and what rounding adds does not grow much.
template <class T>
DIFFSIM_INLINE auto root_stretch(const Symmetric<T>& S, Symmetric<T>& U, Symmetric<T>& C, T& J) {
  constexpr int kMostSteps = 6;
  Symmetric<T> E = S;
  T largest{};
  for (int i = 0; i < 6; ++i) {
    if (i < 3) E.at[i] = E.at[i] - 1.0;
    largest = max(abs(E.at[i]), largest);
  }
  const auto near_rest = less(largest, constant<T>(0.3));
  auto done = ~near_rest;
  const Symmetric<T> squared = multiply(E, E);
  for (int i = 0; i < 6; ++i) {
    U.at[i] = 0.5 * E.at[i] - 0.125 * squared.at[i];
    if (i < 3) U.at[i] = U.at[i] + 1.0;
  }
  for (int step = 0; step < kMostSteps && !all(done); ++step) {
    C = cofactors(U);
    const T half = 0.5 / determinant(U, C);
    const Symmetric<T> other = multiply(S, C);
    T change{};
    for (int i = 0; i < 6; ++i) {
      const T next = 0.5 * U.at[i] + half * other.at[i];
      change = max(abs(next - U.at[i]), change);
      U.at[i] = next;
    }
    done = done | less(change, constant<T>(kLastChange));
  }
  C = cofactors(U);
  J = determinant(U, C);
  return near_rest & done;
}

/// T of a stretch U with cofactors C and determinant J; false in lanes that have not converged. The
/// start is that of first order in J - 1.
template <class T>
DIFFSIM_INLINE auto unit_stretch(const Symmetric<T>& U, Symmetric<T> C, const T& J,
                                 Symmetric<T>& stretch) {
  constexpr int kMostSteps = 6;
  const T one = constant<T>(1.0), share = (J - 1.0) / contract(C, C);
  T l = share * J;
  for (int i = 0; i < 6; ++i) stretch.at[i] = U.at[i] - share * C.at[i];
  auto converged = less(one, one);
  for (int step = 0; step < kMostSteps && !all(converged); ++step) {
    C = cofactors(stretch);
    const T missing = one - determinant(stretch, C);
    Symmetric<T> rest, W = multiply(C, C);
    for (int i = 0; i < 6; ++i) {
      rest.at[i] = stretch.at[i] + l * C.at[i] - U.at[i];
      W.at[i] = (i < 3 ? one : T{}) - l * W.at[i];
    }
    const Symmetric<T> M = cofactors(W);  // over its determinant, the inverse of W
    const Symmetric<T> N = multiply(C, M), along = multiply(M, rest);
    const T volume = determinant(W, M), inverse = 1.0 / volume;
    const T dl = (missing + contract(N, rest) * inverse) / contract(N, C);
    T change{};
    for (int i = 0; i < 6; ++i) {
      const T move = dl * N.at[i] - along.at[i] * inverse;
      stretch.at[i] = stretch.at[i] + move;
      change = max(abs(move), change);
    }
    l = l - dl * volume - l * missing;
    converged = less(change, constant<T>(kLastChange));
  }
  return converged;
}

/// out = A s.
template <class T>
DIFFSIM_INLINE void multiply(const T* A, const Symmetric<T>& s, T* out) {
  const T* m = s.at;
  for (int i = 0; i < 9; i += 3) {
    out[i] = A[i] * m[0] + A[i + 1] * m[3] + A[i + 2] * m[4];
    out[i + 1] = A[i] * m[3] + A[i + 1] * m[1] + A[i + 2] * m[5];
    out[i + 2] = A[i] * m[4] + A[i + 1] * m[5] + A[i + 2] * m[2];
  }
}

}  // namespace detail

/// R and B of F, (3, 3) row-major; returns the lanes that are near rest and have converged. Out of
/// line: it is large.
template <class T>
__attribute__((noinline)) auto nearest_matrices(const T* F, T* R, T* B) {
  detail::Symmetric<T> S, U, C, stretch;
  constexpr int kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
  for (int n = 0; n < 6; ++n) {
    const int i = kRow[n], j = kColumn[n];
    S.at[n] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
  }
  T J;
  auto found = detail::root_stretch(S, U, C, J);
  found =
      found & less(T{}, F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) +
                            F[2] * (F[3] * F[7] - F[4] * F[6]));
  if (!any(found)) return found;
  found = found & detail::unit_stretch(U, C, J, stretch);
  const T inverse = 1.0 / J;
  for (int i = 0; i < 6; ++i) C.at[i] = C.at[i] * inverse;
  detail::multiply(F, C, R);
  detail::multiply(R, stretch, B);
  return found;
}

}  // namespace diffsim
