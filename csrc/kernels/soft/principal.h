// Isotropic stress and tangent in principal axes, one sample per lane of T.
//
// With the signed decomposition F = U diag(s) V^T an isotropic energy is a symmetric function
// psi(s) that does not change when two stretches change sign. Then P = U diag(psi_i) V^T, and the
// tangent is known from d^2 psi/ds^2 and, for each pair, (psi_i - psi_j) / (s_i - s_j) and
// (psi_i + psi_j) / (s_i + s_j).
#pragma once

#include <algorithm>

#include "kernels/linalg/registers.h"
#include "kernels/linalg/svd3.h"

namespace diffsim {

/// F = U diag(s) V^T with rotations U, V and s0 >= s1 >= |s2|.
template <class T>
struct PrincipalFrame {
  T U[9], s[3], V[9];
};

// Registers of samples whose singular values are taken side by side (registers.h). 1,216 samples by
// one, two, three and four: 113, 75, 58 and 56 us with AVX2, 69, 50, 44 and 47 with AVX-512 (Zen
// 4); stages hold eight registers of the first, four of the second.
constexpr int kFrames = 4;

/// Frames of `count` registers of samples.
inline void principal_frames(const Native (*F)[9], int count, PrincipalFrame<Native>* out) {
  for (int r = 0; r < count; r += kFrames) {
    const int some = std::min(kFrames, count - r);
    Registers<Native, kFrames> f[9], U[9], s[3], V[9];
    for (int i = 0; i < kFrames; ++i)
      for (int k = 0; k < 9; ++k) f[k].at[i] = F[r + std::min(i, some - 1)][k];
    detail::svd3_core(f, U, s, V);
    for (int i = 0; i < some; ++i) {
      PrincipalFrame<Native>& frame = out[r + i];
      for (int k = 0; k < 9; ++k) frame.U[k] = U[k].at[i];
      for (int k = 0; k < 3; ++k) frame.s[k] = s[k].at[i];
      for (int k = 0; k < 9; ++k) frame.V[k] = V[k].at[i];
    }
  }
}

template <class T>
PrincipalFrame<T> principal_frame(const T F[9]) {
  PrincipalFrame<T> frame;
  detail::svd3_core(F, frame.U, frame.s, frame.V);
  return frame;
}

/// out = U diag(d) V^T.
template <class T>
DIFFSIM_INLINE void compose(const T U[9], const T d[3], const T V[9], T out[9]) {
  T Ud[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) Ud[3 * i + j] = U[3 * i + j] * d[j];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] =
          Ud[3 * i] * V[3 * j] + Ud[3 * i + 1] * V[3 * j + 1] + Ud[3 * i + 2] * V[3 * j + 2];
}

/// dP/dF in principal axes: dP = U core(U^T dF V) V^T. The core couples the diagonal entries by
/// `diagonal`, and each off-diagonal pair (i, j) by a symmetric and a skew coefficient.
template <class T>
struct PrincipalTangent {
  T diagonal[9];
  T symmetric[3], skew[3];  // pairs (0,1), (0,2), (1,2)
};
inline constexpr int kPair[3][2] = {{0, 1}, {0, 2}, {1, 2}};

/// Nearest positive semidefinite core: Newton's definiteness fix.
template <class T>
void clamp_tangent(PrincipalTangent<T>& c) {
  const T zero = broadcast<T>(0.0);
  for (int k = 0; k < 3; ++k) {
    c.symmetric[k] = max(c.symmetric[k], zero);
    c.skew[k] = max(c.skew[k], zero);
  }
  // B symmetric: B^T B = V s^2 V^T, so |B| = V |s| V^T and (B + |B|) / 2 drops negative
  // eigenvalues.
  T U[9], s[3], V[9], absolute[9];
  detail::svd3_core(c.diagonal, U, s, V);
  for (int i = 0; i < 3; ++i) s[i] = abs(s[i]);
  compose(V, s, V, absolute);
  for (int i = 0; i < 9; ++i) c.diagonal[i] = 0.5 * (c.diagonal[i] + absolute[i]);
}

/// What expand_tangent() puts between rows of U, both (3, 3, 3) with u_m, v_m the columns:
///   own[m] = A_mm v_m v_m^T + sum_(p != m) b_mp v_p v_p^T
///   mixed[k] = A_mp v_m v_p^T + c_mp v_p v_m^T for pair k = (m, p)
/// where A is the diagonal's core, b half the sum of a pair's coefficients, c half the difference.
template <class T>
DIFFSIM_INLINE void turn_core(const T V[9], const PrincipalTangent<T>& core, T own[3][9],
                              T mixed[3][9]) {
  for (int j = 0; j < 3; ++j)
    for (int l = j; l < 3; ++l) {
      T squares[3];
      for (int m = 0; m < 3; ++m) {
        squares[m] = V[3 * j + m] * V[3 * l + m];
        own[m][3 * j + l] = core.diagonal[4 * m] * squares[m];
      }
      for (int k = 0; k < 3; ++k) {
        const T b = 0.5 * (core.symmetric[k] + core.skew[k]);
        own[kPair[k][0]][3 * j + l] += b * squares[kPair[k][1]];
        own[kPair[k][1]][3 * j + l] += b * squares[kPair[k][0]];
      }
    }
  for (int k = 0; k < 3; ++k) {
    const int m = kPair[k][0], p = kPair[k][1];
    const T a = core.diagonal[3 * m + p], c = 0.5 * (core.symmetric[k] - core.skew[k]);
    for (int j = 0; j < 3; ++j)
      for (int l = 0; l < 3; ++l)
        mixed[k][3 * j + l] = a * (V[3 * j + m] * V[3 * l + p]) + c * (V[3 * j + p] * V[3 * l + m]);
  }
}

/// H[9 a + b] = dP_a / dF_b for a <= b, from its principal form; the rest, its mirror image, is
/// left as it is. Between rows i and k of F it is, by turn_core(),
///   sum_m u_im u_km own[m] + sum_(m, p) (u_im u_kp mixed + u_ip u_km mixed^T).
template <class T>
void expand_tangent(const PrincipalFrame<T>& f, const PrincipalTangent<T>& core, T H[81]) {
  T own[3][9], mixed[3][9];
  turn_core(f.V, core, own, mixed);
  for (int i = 0; i < 3; ++i)
    for (int k = i; k < 3; ++k) {
      const T *row = f.U + 3 * i, *column = f.U + 3 * k;
      T same[3], one[3], other[3];
      for (int m = 0; m < 3; ++m) {
        same[m] = row[m] * column[m];
        one[m] = row[kPair[m][0]] * column[kPair[m][1]];
        other[m] = row[kPair[m][1]] * column[kPair[m][0]];
      }
      for (int j = 0; j < 3; ++j)
        for (int l = j; l < 3; ++l) {
          const int jl = 3 * j + l, lj = 3 * l + j;
          const T sum = same[0] * own[0][jl] + same[1] * own[1][jl] + same[2] * own[2][jl];
          T above = sum, below = sum;
          for (int n = 0; n < 3; ++n) {
            above += one[n] * mixed[n][jl] + other[n] * mixed[n][lj];
            below += one[n] * mixed[n][lj] + other[n] * mixed[n][jl];
          }
          H[9 * (3 * i + j) + 3 * k + l] = above;
          if (i != k && j != l) H[9 * (3 * i + l) + 3 * k + j] = below;
        }
    }
}

}  // namespace diffsim
