// Isotropic stress and tangent in principal axes, one sample per lane of T.
//
// With the signed decomposition F = U diag(s) V^T an isotropic energy is a symmetric function
// psi(s) that does not change when two stretches change sign. Then P = U diag(psi_i) V^T, and the
// tangent is known from d^2 psi/ds^2 and, for each pair, (psi_i - psi_j) / (s_i - s_j) and
// (psi_i + psi_j) / (s_i + s_j).
#pragma once

#include "kernels/linalg/lane_pair.h"
#include "kernels/linalg/svd3.h"

namespace diffsim {

/// F = U diag(s) V^T with rotations U, V and s0 >= s1 >= |s2|.
template <class T>
struct PrincipalFrame {
  T U[9], s[3], V[9];
};

/// Frames of `count` registers of samples, two at a time: see lane_pair.h.
inline void principal_frames(const Native (*F)[9], int count, PrincipalFrame<Native>* out) {
  for (int r = 0; r < count; r += 2) {
    const int other = r + 1 < count ? r + 1 : r;
    Pair<Native> f[9], U[9], s[3], V[9];
    for (int k = 0; k < 9; ++k) f[k] = {F[r][k], F[other][k]};
    detail::svd3_core(f, U, s, V);
    for (int k = 0; k < 9; ++k) out[r].U[k] = U[k].a, out[other].U[k] = U[k].b;
    for (int k = 0; k < 3; ++k) out[r].s[k] = s[k].a, out[other].s[k] = s[k].b;
    for (int k = 0; k < 9; ++k) out[r].V[k] = V[k].a, out[other].V[k] = V[k].b;
  }
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

/// H[9 a + b] = dP_a / dF_b for a <= b, from its principal form; the rest, its mirror image, is
/// left as it is.
template <class T>
void expand_tangent(const PrincipalFrame<T>& p, const PrincipalTangent<T>& c, T H[81]) {
  T d[3][9];  // u_i v_i^T
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 9; ++k) d[i][k] = p.U[3 * (k / 3) + i] * p.V[3 * (k % 3) + i];
  T e[3][9];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 9; ++k)
      e[i][k] = c.diagonal[3 * i] * d[0][k] + c.diagonal[3 * i + 1] * d[1][k] +
                c.diagonal[3 * i + 2] * d[2][k];
  for (int a = 0; a < 9; ++a)
    for (int b = a; b < 9; ++b)
      H[9 * a + b] = d[0][a] * e[0][b] + d[1][a] * e[1][b] + d[2][a] * e[2][b];
  for (int k = 0; k < 3; ++k) {
    const int i = kPair[k][0], j = kPair[k][1];
    T sym[9], skw[9], sym_c[9], skw_c[9];
    for (int n = 0; n < 9; ++n) {
      const T ij = p.U[3 * (n / 3) + i] * p.V[3 * (n % 3) + j];
      const T ji = p.U[3 * (n / 3) + j] * p.V[3 * (n % 3) + i];
      sym[n] = ij + ji;
      skw[n] = ij - ji;
      sym_c[n] = 0.5 * c.symmetric[k] * sym[n];
      skw_c[n] = 0.5 * c.skew[k] * skw[n];
    }
    for (int a = 0; a < 9; ++a)
      for (int b = a; b < 9; ++b) H[9 * a + b] += sym_c[a] * sym[b] + skw_c[a] * skw[b];
  }
}

}  // namespace diffsim
