// Objective stiffness-proportional damping, one sample per lane of V.
//
// Classical Rayleigh damping beta K v with the rest stiffness K also brakes rigid rotation once a
// body has turned. Instead the strain *rate* is measured in the frame of a predicted configuration,
// F_n (positions y of the step, or x itself in explicit steps):
//   S = sym(F_n^T (F - F_v)),  D = d_mu/2 |S|^2 + d_lambda/2 tr(S)^2,  P = F_n (d_mu S + d_lambda
//   tr(S) I)
// where (F - F_v) * kappa is the integrator's velocity gradient and d_mu = beta kappa 2 mu,
// d_lambda = beta kappa lambda [Pa]. At small strain this is exactly beta K v; a rigid rotation
// rate W gives sym(F_n^T W F_n) = 0. D is quadratic in x: its matrix is constant during a step.
#pragma once

#include "kernels/linalg/lanes.h"

namespace diffsim {

/// out = F^T G.
template <class V>
inline void transpose_times(const V F[9], const V G[9], V out[9]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] = F[i] * G[j] + F[3 + i] * G[3 + j] + F[6 + i] * G[6 + j];
}

/// out = F G.
template <class V>
inline void times(const V F[9], const V G[9], V out[9]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] = F[3 * i] * G[j] + F[3 * i + 1] * G[3 + j] + F[3 * i + 2] * G[6 + j];
}

/// S = sym(F^T G), full 3x3.
template <class V>
inline void strain_rate(const V F[9], const V G[9], V S[9]) {
  V A[9];
  transpose_times(F, G, A);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) S[3 * i + j] = 0.5 * (A[3 * i + j] + A[3 * j + i]);
}

/// T(S) = d_mu S + d_lambda tr(S) I.
template <class V>
inline void viscous(const V S[9], const V& d_mu, const V& d_lambda, V T[9]) {
  const V pressure = d_lambda * (S[0] + S[4] + S[8]);
  for (int i = 0; i < 9; ++i) T[i] = d_mu * S[i];
  T[0] += pressure, T[4] += pressure, T[8] += pressure;
}

/// Adds the viscous stress to P; returns D [J/m^3].
template <class V>
inline V add_viscous_stress(const V Fn[9], const V delta[9], const V& d_mu, const V& d_lambda,
                            V P[9]) {
  V S[9], T[9], FT[9];
  strain_rate(Fn, delta, S);
  viscous(S, d_mu, d_lambda, T);
  times(Fn, T, FT);
  V energy = broadcast<V>(0.0);
  for (int i = 0; i < 9; ++i) {
    P[i] += FT[i];
    energy += S[i] * T[i];
  }
  return 0.5 * energy;
}

/// Adds dP_ij/dF_kl = d_mu/2 ((F F^T)_ik delta_jl + F_il F_kj) + d_lambda F_ij F_kl, F = F_n, to
/// the entries on and above the diagonal of H.
template <class V>
inline void add_viscous_tangent(const V Fn[9], const V& d_mu, const V& d_lambda, V H[81]) {
  V FFt[9];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      FFt[3 * i + k] =
          Fn[3 * i] * Fn[3 * k] + Fn[3 * i + 1] * Fn[3 * k + 1] + Fn[3 * i + 2] * Fn[3 * k + 2];
  const V half = 0.5 * d_mu;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l) {
          if (3 * i + j > 3 * k + l) continue;
          V& h = H[9 * (3 * i + j) + 3 * k + l];
          h += half * Fn[3 * i + l] * Fn[3 * k + j] + d_lambda * Fn[3 * i + j] * Fn[3 * k + l];
          if (j == l) h += half * FFt[3 * i + k];
        }
}

}  // namespace diffsim
