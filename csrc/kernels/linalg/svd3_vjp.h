// Derivatives of svd3 and polar3, one matrix per lane.
#pragma once

#include "kernels/linalg/lanes.h"
#include "kernels/linalg/registers.h"

namespace diffsim {
namespace detail {

// a . b for vectors with strides.
template <class T>
DIFFSIM_INLINE T dot3(const T* a, int stride_a, const T* b, int stride_b) {
  return a[0] * b[0] + a[stride_a] * b[stride_b] + a[2 * stride_a] * b[2 * stride_b];
}

// C = A^T B, C = A B and C = A B^T for row-major 3x3 matrices.
template <class T>
DIFFSIM_INLINE void mul_tn(const T* A, const T* B, T* C) {
  for (int k = 0; k < 9; ++k) C[k] = dot3(A + k / 3, 3, B + k % 3, 3);
}
template <class T>
DIFFSIM_INLINE void mul_nn(const T* A, const T* B, T* C) {
  for (int k = 0; k < 9; ++k) C[k] = dot3(A + k / 3 * 3, 1, B + k % 3, 3);
}
template <class T>
DIFFSIM_INLINE void mul_nt(const T* A, const T* B, T* C) {
  for (int k = 0; k < 9; ++k) C[k] = dot3(A + k / 3 * 3, 1, B + k % 3 * 3, 1);
}

/// Gaps of singular values below this, relative to s0, are rounding: the values are equal.
constexpr double kGapTolerance = 1e-15;

/// dL/dF of F = U diag(s) V^T.
///
/// With M = U^T dF V, dU = U X and dV = V Y (X, Y antisymmetric): M = X S + dS - S Y, hence
///   ds_i = M_ii,  X_ij = (s_j M_ij + s_i M_ji) / (s_j^2 - s_i^2),
///                 Y_ij = (s_i M_ij + s_j M_ji) / (s_j^2 - s_i^2),
/// and the adjoint reads the same coefficients backwards. Where s_i = |s_j| to rounding X and Y do
/// not exist: the pair contributes nothing if L does not feel the rotation, else NaN.
/// @param[in]  U, s, V  as svd3 returns them
/// @param[in]  grad_U, grad_s, grad_V  dL/dU, dL/ds, dL/dV
/// @param[out] grad_F   (3, 3) dL/dF
template <class T>
DIFFSIM_INLINE void svd3_vjp_core(const T* U, const T* s, const T* V, const T* grad_U,
                                  const T* grad_s, const T* grad_V, T* grad_F) {
  T A[9], B[9], M[9];
  mul_tn(U, grad_U, A);
  mul_tn(V, grad_V, B);
  const T zero{};
  const T nan = zero + __builtin_nan("");
  for (int i = 0; i < 3; ++i) {
    M[4 * i] = grad_s[i];
    for (int j = i + 1; j < 3; ++j) {
      const T gx = A[3 * i + j] - A[3 * j + i], gy = B[3 * i + j] - B[3 * j + i];
      const T gap = s[i] - abs(s[j]);
      const auto distinct = greater(gap, s[0] * kGapTolerance);
      // Divide before multiplying: s^2 may overflow or underflow where s does not.
      const T over = 1.0 / (s[j] - s[i]), share_i = s[i] / (s[j] + s[i]);
      const T share_j = s[j] / (s[j] + s[i]);
      const auto felt = greater(abs(gx) + abs(gy), zero);
      const T blank = select(felt, nan, zero);
      M[3 * i + j] = select(distinct, (gx * share_j + gy * share_i) * over, blank);
      M[3 * j + i] = select(distinct, (gx * share_i + gy * share_j) * over, blank);
    }
  }
  T half[9];
  mul_nn(U, M, half);
  mul_nt(half, V, grad_F);
}

/// dL/dF of the rotation R of F = R H, H symmetric.
///
/// dR = R [w] with (tr(H) 1 - H) w = axial(R^T dF - dF^T R). The matrix has the eigenvalues
/// s_i + s_j: repeated singular values are no obstacle; s1 + s2 = 0 is one, for R is not unique
/// there (NaN if s1 + s2 is below rounding, some 1e-15 s0, and dL/dR feels the rotation at all).
/// @param[in]  F, R    (3, 3) and its rotation
/// @param[in]  grad_R  (3, 3) dL/dR
/// @param[out] grad_F  (3, 3) dL/dF
template <class T>
DIFFSIM_INLINE void polar3_vjp_core(const T* F, const T* R, const T* grad_R, T* grad_F) {
  // Scaling F by a power of two keeps the cubes below in range.
  T largest = T{} + 2.2250738585072014e-308;
  for (int i = 0; i < 9; ++i) largest = max(abs(F[i]), largest);
  largest = min(largest, T{} + 4.49423283715579e307);
  T scale, inv_scale, A[9], H[9], G[9];
  binary_scale(largest, scale, inv_scale);
  for (int i = 0; i < 9; ++i) A[i] = F[i] * inv_scale;
  mul_tn(R, A, H);
  mul_tn(R, grad_R, G);
  const T h01 = 0.5 * (H[1] + H[3]), h02 = 0.5 * (H[2] + H[6]), h12 = 0.5 * (H[5] + H[7]);
  const T k00 = H[4] + H[8], k11 = H[0] + H[8], k22 = H[0] + H[4];  // tr(H) 1 - H
  const T g0 = G[7] - G[5], g1 = G[2] - G[6], g2 = G[3] - G[1];
  const T a00 = k11 * k22 - h12 * h12, a11 = k00 * k22 - h02 * h02, a22 = k00 * k11 - h01 * h01;
  const T a01 = h02 * h12 + h01 * k22, a02 = h01 * h12 + h02 * k11, a12 = h01 * h02 + h12 * k00;
  const T det = k00 * a00 - h01 * a01 - h02 * a02;
  const T trace = H[0] + H[4] + H[8];
  const auto defined = greater(det, trace * trace * trace * kGapTolerance);
  const T zero{};
  const auto felt = greater(abs(g0) + abs(g1) + abs(g2), zero);
  const T blank = select(felt, zero + __builtin_nan(""), zero);
  const T inv = select(defined, 1.0 / det, blank) * inv_scale;
  const T w0 = (a00 * g0 + a01 * g1 + a02 * g2) * inv;
  const T w1 = (a01 * g0 + a11 * g1 + a12 * g2) * inv;
  const T w2 = (a02 * g0 + a12 * g1 + a22 * g2) * inv;
  const T W[9] = {zero, zero - w2, w1, w2, zero, zero - w0, zero - w1, w0, zero};
  mul_nn(R, W, grad_F);
}

}  // namespace detail

/// dL/dF (kGroups, 3, 3) of svd3, from its outputs and dL/dU, dL/ds, dL/dV.
template <int kGroups = 1>
inline void svd3_vjp(const Lane* U, const Lane* s, const Lane* V, const Lane* grad_U,
                     const Lane* grad_s, const Lane* grad_V, Lane* grad_F) {
  for (int i = 0; i < kGroups * kParts; ++i) {
    const detail::OneRegister at{i};
    Native u[9], sigma[3], v[9], gu[9], gs[3], gv[9], gf[9];
    at.get<9>(U, u);
    at.get<3>(s, sigma);
    at.get<9>(V, v);
    at.get<9>(grad_U, gu);
    at.get<3>(grad_s, gs);
    at.get<9>(grad_V, gv);
    detail::svd3_vjp_core(u, sigma, v, gu, gs, gv, gf);
    at.set<9>(grad_F, gf);
  }
}

/// dL/dF (kGroups, 3, 3) of polar3, from F, R and dL/dR.
template <int kGroups = 1>
inline void polar3_vjp(const Lane* F, const Lane* R, const Lane* grad_R, Lane* grad_F) {
  for (int i = 0; i < kGroups * kParts; ++i) {
    const detail::OneRegister at{i};
    Native f[9], r[9], gr[9], gf[9];
    at.get<9>(F, f);
    at.get<9>(R, r);
    at.get<9>(grad_R, gr);
    detail::polar3_vjp_core(f, r, gr, gf);
    at.set<9>(grad_F, gf);
  }
}

}  // namespace diffsim
