// The two projections of projective dynamics without singular values, near rest: the nearest
// rotation R of F, and the nearest matrix of determinant one B, see pd_material.h.
//
// With the stretch U = (F^T F)^(1/2), R = F U^-1. With B = R T and F - B = l cof(B),
//   T + l T^-1 = U,  det T = 1,
// for a symmetric T near U. By the theorem of Cayley and Hamilton U is a polynomial of F^T F, and T
// a quotient of polynomials of U, whose coefficients are invariants: Newton's equations are of two
// and of three numbers. Where only stresses are asked for (a line search needs no tangent) this
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

/// Traces of a stretch and of its cofactors less three, and its determinant less one: near rest
/// what rounds them is small as they are.
template <class T>
struct Invariants {
  T trace, of_cofactors, determinant;
};
template <class T>
DIFFSIM_INLINE T trace(const Symmetric<T>& a) {
  return a.at[0] + a.at[1] + a.at[2];
}
/// scale A + share 1.
template <class T>
DIFFSIM_INLINE Symmetric<T> scaled(const T& scale, const Symmetric<T>& a, const T& share) {
  Symmetric<T> out;
  for (int i = 0; i < 6; ++i) out.at[i] = i < 3 ? scale * a.at[i] + share : scale * a.at[i];
  return out;
}

constexpr int kMostSteps = 6;

/// Invariants of U from E = U^2 - 1, by Newton's method on
///   tr(U)^2 = tr U^2 + 2 tr cof(U),  tr(cof U)^2 = tr cof(U^2) + 2 det(U) tr U;
/// false in lanes that are not near rest or have not converged. There E is within 0.3, so that no
/// eigenvalue of U^2 is beyond 1.9 or below 0.1. The start is that of third order in E.
/// @param u  its determinant is given
template <class T>
DIFFSIM_INLINE auto root_invariants(const Symmetric<T>& E, Invariants<T>& u) {
  T largest{};
  for (int i = 0; i < 6; ++i) largest = max(abs(E.at[i]), largest);
  const T j = u.determinant, J = 1.0 + j;
  const auto near_rest = less(largest, constant<T>(0.3)) & less(T{}, J);
  // traces of powers of E, from its invariants
  const T e1 = trace(E), i2 = trace(cofactors(E)), i3 = j * (2.0 + j) - e1 - i2;
  const T e2 = e1 * e1 - 2.0 * i2, e3 = e1 * (e2 - i2) + 3.0 * i3;
  const T known = i2 + 2.0 * e1 + 6.0 * j;
  T p = 0.5 * e1 - 0.125 * e2 + 0.0625 * e3;
  T q = 0.5 * (p * (6.0 + p) - e1);
  auto done = ~near_rest;
  for (int step = 0; step < kMostSteps && !all(done); ++step) {
    const T a = p * (6.0 + p) - e1 - 2.0 * q, b = q * (6.0 + q) - 2.0 * (J * p) - known;
    const T scale = 0.5 / ((3.0 + p) * (3.0 + q) - J);
    const T dp = scale * ((3.0 + q) * a + b), dq = scale * (J * a + (3.0 + p) * b);
    p = p - dp, q = q - dq;
    done = done | less(max(abs(dp), abs(dq)), constant<T>(kLastChange));
  }
  u.trace = p, u.of_cofactors = q;
  return near_rest & done;
}

/// D = U - 1 from E = U^2 - 1 and the invariants of U.
template <class T>
DIFFSIM_INLINE Symmetric<T> root(const Symmetric<T>& E, const Invariants<T>& u) {
  const T p = 3.0 + u.trace, q = 3.0 + u.of_cofactors;
  const T scale = 1.0 / (p * q - (1.0 + u.determinant));
  const T share = scale * ((p + 1.0) * (u.determinant + u.trace - u.of_cofactors));
  Symmetric<T> D = scaled(scale * (p * p - q - 2.0), E, share);
  const Symmetric<T> squared = multiply(E, E);
  for (int i = 0; i < 6; ++i) D.at[i] = D.at[i] - scale * squared.at[i];
  return D;
}

/// T of a stretch U = 1 + D, by Newton's method on a = tr T, b = tr cof(T) and l,
///   tr U = a + l b,  tr cof(U) = b + l (a b - 3) + l^2 a,
///   det U = 1 + l (b^2 - 2 a) + l^2 (a^2 - 2 b) + l^3;
/// false in lanes that have not converged. The start is that of first order in det U - 1.
/// @param E  U^2 - 1
template <class T>
DIFFSIM_INLINE auto unit_stretch(const Symmetric<T>& E, const Symmetric<T>& D,
                                 const Invariants<T>& u, Symmetric<T>& stretch) {
  const T one = constant<T>(1.0), J = 1.0 + u.determinant;
  const T p = 3.0 + u.trace, q = 3.0 + u.of_cofactors;
  const T share = u.determinant / (q * q - 2.0 * (J * p));
  T l = share * J, a = u.trace - share * q;  // a and b less three
  T b = u.of_cofactors - share * (p * q - 3.0 * J) + share * share * (J * p);
  auto converged = less(one, one);
  for (int step = 0; step < kMostSteps && !all(converged); ++step) {
    const T A = 3.0 + a, B = 3.0 + b, la = l * A, lb = l * B;
    const T ab = A * B - 3.0, aa = A * A - 2.0 * B, bb = B * B - 2.0 * A;
    const T r1 = a + lb - u.trace;
    const T r2 = b + l * (ab + la) - u.of_cofactors;
    const T r3 = l * (bb + l * (aa + l)) - u.determinant;
    // the Jacobian's rows by a, b and l: the first is (1, l, b)
    const T a2 = lb + l * l, b2 = 1.0 + la, l2 = ab + 2.0 * la;
    const T a3 = 2.0 * (l * (la - 1.0)), b3 = 2.0 * (lb - l * l);
    const T l3 = bb + l * (2.0 * aa + 3.0 * l);
    const T b2_left = b2 - l * a2, l2_left = l2 - B * a2, r2_left = r2 - a2 * r1;
    const T b3_left = b3 - l * a3, l3_left = l3 - B * a3, r3_left = r3 - a3 * r1;
    const T scale = 1.0 / (b2_left * l3_left - l2_left * b3_left);
    const T db = scale * (r2_left * l3_left - r3_left * l2_left);
    const T dl = scale * (b2_left * r3_left - b3_left * r2_left);
    const T da = r1 - l * db - B * dl;
    a = a - da, b = b - db, l = l - dl;
    converged = less(max(max(abs(da), abs(db)), abs(dl)), constant<T>(kLastChange));
  }
  // (U^2 - tr(T) U + tr cof(T) - l) T = l U + 1 - tr(T) l
  Symmetric<T> M = scaled(-3.0 - a, D, 1.0 + (b - a - l));
  for (int i = 0; i < 6; ++i) M.at[i] = M.at[i] + E.at[i];
  const Symmetric<T> C = cofactors(M);
  const T inverse = 1.0 / determinant(M, C);
  stretch = multiply(C, scaled(l * inverse, D, (1.0 - (2.0 + a) * l) * inverse));
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
  detail::Symmetric<T> E, stretch;
  detail::Invariants<T> u;
  constexpr int kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
  for (int n = 0; n < 6; ++n) {
    const int i = kRow[n], j = kColumn[n];
    E.at[n] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
    if (i == j) E.at[n] = E.at[n] - 1.0;
  }
  const T J = F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) +
              F[2] * (F[3] * F[7] - F[4] * F[6]);
  u.determinant = J - 1.0;
  auto found = detail::root_invariants(E, u);
  if (!any(found)) return found;
  detail::Symmetric<T> D = detail::root(E, u);
  found = found & detail::unit_stretch(E, D, u, stretch);
  for (int i = 0; i < 3; ++i) D.at[i] = D.at[i] + 1.0;
  detail::Symmetric<T> inverse = detail::cofactors(D);
  const T over = 1.0 / J;
  for (int i = 0; i < 6; ++i) inverse.at[i] = inverse.at[i] * over;
  detail::multiply(F, inverse, R);
  detail::multiply(R, stretch, B);
  return found;
}

}  // namespace diffsim
