// Third derivatives of the elastic energies: numbers, and so stresses, along two directions at
// once.
//
// A Jet is a number with its first derivatives along two directions and the mixed second one, so
// arithmetic on jets of F + a Z + b D gives P, dP[Z], dP[D] and d^2P[Z, D]. All is done in the
// principal axes of F, where F = diag(s) (energies are isotropic, so U and V only turn the result).
// Laws written in F itself (invariants, cofactors) need nothing else. The nearest rotation and the
// nearest matrix of determinant one are not differentiated through singular values, which are not
// smooth where two are equal, but through the equations that define them:
//   R = exp(W), skew W, R^T F symmetric;
//   B - F + l cof B = 0, det B = 1   (l: multiplier of the volume projection, see pd_material.h).
#pragma once

#include "kernels/soft/principal.h"

namespace diffsim {

template <class T>
struct Jet {
  T v, a, b, ab;
};

template <class T>
DIFFSIM_INLINE Jet<T> operator+(const Jet<T>& x, const Jet<T>& y) {
  return {x.v + y.v, x.a + y.a, x.b + y.b, x.ab + y.ab};
}
template <class T>
DIFFSIM_INLINE Jet<T> operator-(const Jet<T>& x, const Jet<T>& y) {
  return {x.v - y.v, x.a - y.a, x.b - y.b, x.ab - y.ab};
}
template <class T>
DIFFSIM_INLINE Jet<T> operator*(const Jet<T>& x, const Jet<T>& y) {
  return {x.v * y.v, x.a * y.v + x.v * y.a, x.b * y.v + x.v * y.b,
          x.ab * y.v + x.a * y.b + x.b * y.a + x.v * y.ab};
}
template <class T>
DIFFSIM_INLINE Jet<T> operator*(double k, const Jet<T>& x) {
  return {k * x.v, k * x.a, k * x.b, k * x.ab};
}
template <class T>
DIFFSIM_INLINE Jet<T> operator+(const Jet<T>& x, double k) {
  return {x.v + k, x.a, x.b, x.ab};
}
/// f(x) from f, f' and f'' at the value of x.
template <class T>
DIFFSIM_INLINE Jet<T> chain(const Jet<T>& x, const T& f, const T& slope, const T& curvature) {
  return {f, slope * x.a, slope * x.b, slope * x.ab + curvature * x.a * x.b};
}
template <class T>
DIFFSIM_INLINE Jet<T> inverse(const Jet<T>& x) {
  const T r = 1.0 / x.v;
  return chain(x, r, -r * r, 2.0 * r * r * r);
}
template <class T>
DIFFSIM_INLINE Jet<T> square_root(const Jet<T>& x) {
  const T f = sqrt(x.v), slope = 0.5 / f;
  return chain(x, f, slope, -0.5 * slope / x.v);
}
/// @param log_v  logarithm of the value
template <class T>
DIFFSIM_INLINE Jet<T> logarithm(const Jet<T>& x, const T& log_v) {
  const T r = 1.0 / x.v;
  return chain(x, log_v, r, -r * r);
}

/// The bilinear form of cofactors: cof(X) = cross(X, X) / 2.
template <class T>
DIFFSIM_INLINE void cross(const T X[9], const T Y[9], T out[9]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int a = 3 * ((i + 1) % 3), b = 3 * ((i + 2) % 3), c = (j + 1) % 3, d = (j + 2) % 3;
      out[3 * i + j] =
          X[a + c] * Y[b + d] + X[b + d] * Y[a + c] - X[a + d] * Y[b + c] - X[b + c] * Y[a + d];
    }
}

/// Cofactors and determinant.
template <class T>
DIFFSIM_INLINE Jet<T> cofactors(const Jet<T> F[9], Jet<T> C[9]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int a = 3 * ((i + 1) % 3), b = 3 * ((i + 2) % 3), c = (j + 1) % 3, d = (j + 2) % 3;
      C[3 * i + j] = F[a + c] * F[b + d] - F[a + d] * F[b + c];
    }
  return F[0] * C[0] + F[1] * C[1] + F[2] * C[2];
}

template <class T>
DIFFSIM_INLINE Jet<T> squared_norm(const Jet<T> F[9]) {
  Jet<T> total = F[0] * F[0];
  for (int i = 1; i < 9; ++i) total = total + F[i] * F[i];
  return total;
}

/// The nearest rotation of F = diag(s) + a Z + b D.
template <class T>
void rotation_jets(const T s[3], const Jet<T> F[9], Jet<T> R[9]) {
  T W1[9] = {}, W2[9] = {}, G[9];
  const T tiny = broadcast<T>(1e-12);
  const auto skew = [&](int i, int j, const T& ij, const T& ji) {
    return (ij - ji) / max(s[i] + s[j], tiny);
  };
  for (int k = 0; k < 3; ++k) {
    const int i = kPair[k][0], j = kPair[k][1], ij = 3 * i + j, ji = 3 * j + i;
    W1[ij] = skew(i, j, F[ij].a, F[ji].a), W1[ji] = -W1[ij];
    W2[ij] = skew(i, j, F[ij].b, F[ji].b), W2[ji] = -W2[ij];
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      T squares = broadcast<T>(0.0), rest = broadcast<T>(0.0);
      for (int k = 0; k < 3; ++k) {
        const int ik = 3 * i + k, kj = 3 * k + j;
        squares += W1[ik] * W2[kj] + W2[ik] * W1[kj];
        rest += W1[ik] * F[kj].b + W2[ik] * F[kj].a;
      }
      R[3 * i + j] = {broadcast<T>(i == j ? 1.0 : 0.0), W1[3 * i + j], W2[3 * i + j],
                      0.5 * squares};
      G[3 * i + j] = 0.5 * squares * s[j] - rest;
    }
  for (int k = 0; k < 3; ++k) {
    const int i = kPair[k][0], j = kPair[k][1];
    const T w = skew(i, j, G[3 * i + j], G[3 * j + i]);
    R[3 * i + j].ab += w;
    R[3 * j + i].ab -= w;
  }
}

}  // namespace diffsim
