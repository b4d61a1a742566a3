// Third derivatives of the elastic energies: stresses along two directions at once.
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

#include "kernels/soft/material.h"

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

/// X and m with X + l cross(diag(t), X) + m cof = r, cof : X = c, cof being that of diag(t).
/// @return m + l c
template <class T>
T solve_projection(const PdSample<T>& p, const T r[9], const T& c, T X[9]) {
  const T tiny = broadcast<T>(1e-12);
  for (int k = 0; k < 3; ++k) {
    const int i = kPair[k][0], j = kPair[k][1];
    const T t = p.t[i] + p.t[j], q = p.q[i] + p.q[j];
    const T symmetric =
        0.5 * (r[3 * i + j] + r[3 * j + i]) * t / select(less(abs(q), tiny), tiny, q);
    const T skew = 0.5 * (r[3 * i + j] - r[3 * j + i]) * t / max(p.s[i] + p.s[j], tiny);
    X[3 * i + j] = symmetric + skew;
    X[3 * j + i] = symmetric - skew;
  }
  // t_i X_i' = t_i r_i - m' over q_i; q_2 may vanish and is not divided by
  const T r0 = 1.0 / (p.t[0] * p.q[0]), r1 = 1.0 / (p.t[1] * p.q[1]), q2t2 = p.q[2] * p.t[2];
  const T m = (q2t2 * (r[0] * p.t[0] * r0 + r[4] * p.t[1] * r1 - c) + p.t[2] * r[8]) /
              (1.0 + q2t2 * (r0 + r1));
  X[0] = (p.t[0] * r[0] - m) * p.t[0] * r0;
  X[4] = (p.t[1] * r[4] - m) * p.t[1] * r1;
  X[8] = p.t[2] * (c - X[0] / p.t[0] - X[4] / p.t[1]);
  return m;
}

/// The nearest matrix of determinant one of F = diag(s) + a Z + b D.
template <class T>
void volume_jets(const PdSample<T>& p, const Jet<T> F[9], Jet<T> B[9]) {
  const T zero = broadcast<T>(0.0);
  T Z[9], D[9], B1[9], B2[9], B12[9], t[9] = {}, cross1[9], cross2[9], cross12[9], r[9];
  for (int i = 0; i < 9; ++i) Z[i] = F[i].a, D[i] = F[i].b;
  for (int i = 0; i < 3; ++i) t[4 * i] = p.t[i];
  const T l = p.t[0] * (p.s[0] - p.t[0]);
  const T l1 = solve_projection(p, Z, zero, B1), l2 = solve_projection(p, D, zero, B2);
  cross(t, B1, cross1);
  cross(t, B2, cross2);
  cross(B1, B2, cross12);
  T c = zero;
  for (int i = 0; i < 9; ++i) {
    r[i] = -(l1 * cross2[i] + l2 * cross1[i] + l * cross12[i]);
    c -= B1[i] * cross2[i];
  }
  solve_projection(p, r, c, B12);
  for (int i = 0; i < 9; ++i) B[i] = {t[i], B1[i], B2[i], B12[i]};
}

/// Stresses of unit weights in principal axes, P = w_mu mu + w_vol vol, by material.
template <class T>
void stress_jets(PdMaterial, const PdSample<T>& p, const Jet<T> F[9], Jet<T> mu[9], Jet<T> vol[9]) {
  rotation_jets(p.s, F, mu);
  volume_jets(p, F, vol);
  for (int i = 0; i < 9; ++i) mu[i] = F[i] - mu[i], vol[i] = F[i] - vol[i];
}

template <class T>
void stress_jets(CorotatedMaterial, const StretchSample<T>& p, const Jet<T> F[9], Jet<T> mu[9],
                 Jet<T> vol[9]) {
  Jet<T> R[9];
  rotation_jets(p.s, F, R);
  Jet<T> trace = R[0] * F[0];
  for (int i = 1; i < 9; ++i) trace = trace + R[i] * F[i];
  for (int i = 0; i < 9; ++i) mu[i] = F[i] - R[i], vol[i] = (trace + -3.0) * R[i];
}

template <class T>
void stress_jets(StableNeoHookeanMaterial, const StableNeoHookeanMaterial::Sample<T>&,
                 const Jet<T> F[9], Jet<T> mu[9], Jet<T> vol[9]) {
  Jet<T> C[9];
  const Jet<T> growth = cofactors(F, C) + -1.0;
  // m = 2/3 w_mu, mu = w_mu / 2, l = w_vol + 5/12 w_mu
  const Jet<T> stiffness = (-2.0 / 3.0) * inverse(squared_norm(F) + 1.0) + 2.0 / 3.0;
  const Jet<T> pressure = (5.0 / 12.0) * growth + -0.5;
  for (int i = 0; i < 9; ++i) {
    mu[i] = stiffness * F[i] + pressure * C[i];
    vol[i] = growth * C[i];
  }
}

template <class T>
void stress_jets(NeoHookeanMaterial, const NeoHookeanMaterial::Sample<T>& p, const Jet<T> F[9],
                 Jet<T> mu[9], Jet<T> vol[9]) {
  Jet<T> C[9];
  const Jet<T> J = cofactors(F, C);
  const Jet<T> over = inverse(J), log_over = logarithm(J, p.log_J) * over;
  for (int i = 0; i < 9; ++i) {
    mu[i] = 0.5 * (F[i] - over * C[i]);
    vol[i] = log_over * C[i];
  }
}

template <class T>
void stress_jets(StvkMaterial, const StvkMaterial::Sample<T>&, const Jet<T> F[9], Jet<T> mu[9],
                 Jet<T> vol[9]) {
  const Jet<T> trace = 0.5 * squared_norm(F) + -1.5;
  Jet<T> E[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const Jet<T> C = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
      E[3 * i + j] = 0.5 * (C + (i == j ? -1.0 : 0.0));
    }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int ij = 3 * i + j;
      mu[ij] = F[3 * i] * E[j] + F[3 * i + 1] * E[3 + j] + F[3 * i + 2] * E[6 + j];
      vol[ij] = trace * F[ij];
    }
}

}  // namespace diffsim
