// Singular values and rotations of 3x3 matrices, one matrix per lane.
//
//   F = U diag(s) V^T,  det U = det V = +1,  s0 >= s1 >= |s2|,  sign s2 = sign det F
//
// 1. Jacobi sweeps on S = F^T F give V as a quaternion. A rotation by theta in the plane (p, q) is
//    the quaternion (1, x e_k), x = tan(theta/2), left unnormalized: it scales S and the quaternion
//    by a common factor, so it costs one square root and one division, and V is a rotation to
//    rounding however the angles were computed.
// 2. Two or three 90-degree rotations sort the columns.
// 3. Givens QR of B = F V gives U and s. Rounding of S is eps s0^2, so it leaves R_01 and R_02 at
//    eps s0, but R_12 as large as eps s0^2 / s1: one 2x2 SVD removes it. Where the values of all
//    lanes are of one magnitude, the columns of B are normalized instead.
//
// A lane stops turning once it has converged, so its bits do not depend on its neighbors. NaN or
// infinity in a lane makes every output of that lane NaN.
#pragma once

#include "kernels/linalg/lanes.h"
#include "kernels/linalg/registers.h"

namespace diffsim {
namespace detail {

template <class T>
DIFFSIM_INLINE T constant(double value) {
  return T{} + value;
}

// q <- q (1, x e_k): turn columns p and q by 2 atan(x), (k, p, q) cyclic.
template <class T>
DIFFSIM_INLINE void turn_quaternion(const T& x, T& w, T& vk, T& vp, T& vq) {
  const T w0 = w, vp0 = vp;
  w = w0 - x * vk;
  vk = vk + x * w0;
  vp = vp0 + x * vq;
  vq = vq - x * vp0;
}

// S <- J^T S J (1 + x^2)^2 with the rotation J that all but removes S_pq where active.
template <class T, class M>
DIFFSIM_INLINE void jacobi_turn(const M& active, T& Spp, T& Sqq, T& Skk, T& Spq, T& Skp, T& Skq,
                                T& w, T& vk, T& vp, T& vq) {
  // tan(2 theta) = a / d;  t = tan(theta), |t| <= 1
  const T d = Spp - Sqq, a = Spq + Spq;
  const T h = sqrt(d * d + a * a + 1e-300);
  const T t = copysign(constant<T>(1.0), d) * a / (abs(d) + h);
  // tan(theta/2) = t / (1 + sqrt(1 + t^2)); minimax in t^2, error 8e-6, exact as t -> 0, so that
  // the last sweeps still converge quadratically.
  const T u = t * t;
  T g = u * 0.0069269400550220454 - 0.027321697092204146;
  g = g * u + 0.059332480961567305;
  g = g * u - 0.1247162164218715;
  g = g * u + 0.5;
  const T x = keep(active, t * g);
  const T xx = x * x;
  const T n = 1.0 + xx, c = 1.0 - xx, s = x + x;
  const T cc = c * c, ss = s * s, cs = c * s, nn = n * n, cs2a = cs * a;
  const T Skp0 = Skp;
  Skp = n * (c * Skp0 + s * Skq);
  Skq = n * (c * Skq - s * Skp0);
  const T Spp0 = Spp;
  Spp = cc * Spp0 + ss * Sqq + cs2a;
  Sqq = ss * Spp0 + cc * Sqq - cs2a;
  Spq = (cc - ss) * Spq - cs * d;
  Skk = nn * Skk;
  turn_quaternion(x, w, vk, vp, vq);
}

// Swap columns p and q (one with its sign flipped) where the mask is set.
template <class T, class M>
DIFFSIM_INLINE void swap_turn(const M& swap, T& Spp, T& Sqq, T& w, T& vk, T& vp, T& vq) {
  const T Spp0 = Spp;
  Spp = select(swap, Sqq, Spp0);
  Sqq = select(swap, Spp0, Sqq);
  turn_quaternion(keep(swap, constant<T>(1.0)), w, vk, vp, vq);
}

// c, s with c^2 + s^2 = 1 and (c x + s y, c y - s x) = (r, 0); 1, 0 and r = 0 where r^2 would
// underflow (r below 1e-145, next to a largest entry in [1, 2)).
template <class T>
DIFFSIM_INLINE void givens(const T& x, const T& y, T& c, T& s, T& r) {
  const T rr = x * x + y * y;
  const auto tiny = less(rr, constant<T>(1e-290));
  const T inv = 1.0 / sqrt(rr);
  c = select(tiny, constant<T>(1.0), x * inv);
  s = select(tiny, T{}, y * inv);
  r = select(tiny, T{}, c * x + s * y);
}

// All of s0^2, s1^2 and s2^2 within this of the largest: Gram-Schmidt keeps U a rotation to
// rounding.
constexpr double kWellConditioned = 0.1;

// U and the values from B = F V, whose columns are orthogonal to eps s0, where none is much shorter
// than the first: returns those lanes.
template <class T>
DIFFSIM_INLINE auto normalize_columns(const T* B0, const T* B1, const T* B2, T* U0, T* U1, T* U2,
                                      T& r00, T& r11, T& r22) {
  const T n0 = B0[0] * B0[0] + B0[1] * B0[1] + B0[2] * B0[2];
  const T n1 = B1[0] * B1[0] + B1[1] * B1[1] + B1[2] * B1[2];
  const T n2 = B2[0] * B2[0] + B2[1] * B2[1] + B2[2] * B2[2];
  const T inverse0 = 1.0 / sqrt(n0);
  for (int i = 0; i < 3; ++i) U0[i] = B0[i] * inverse0;
  const T along = U0[0] * B1[0] + U0[1] * B1[1] + U0[2] * B1[2];
  T rest[3];
  for (int i = 0; i < 3; ++i) rest[i] = B1[i] - along * U0[i];
  const T nn = rest[0] * rest[0] + rest[1] * rest[1] + rest[2] * rest[2];
  const T inverse1 = 1.0 / sqrt(nn);
  for (int i = 0; i < 3; ++i) U1[i] = rest[i] * inverse1;
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    U2[i] = U0[j] * U1[k] - U0[k] * U1[j];
  }
  r00 = n0 * inverse0;
  r11 = nn * inverse1;
  r22 = U2[0] * B2[0] + U2[1] * B2[1] + U2[2] * B2[2];
  return greater(min(n1, n2), n0 * kWellConditioned);
}

// The same for any B, by Givens rotations; V1 and V2 turn along where B's rounding needs it.
template <class T>
DIFFSIM_INLINE void givens_qr(const T* B0, const T* B1, const T* B2, T* V1, T* V2, T* U0, T* U1,
                              T* U2, T& r00, T& r11, T& r22) {
  // B = Q R; R_01 and R_02 are rounding
  T c1, s1, c2, s2, c3, s3, r;
  givens(B0[0], B0[1], c1, s1, r);
  givens(r, B0[2], c2, s2, r00);
  const T b10 = c1 * B1[0] + s1 * B1[1], b20 = c1 * B2[0] + s1 * B2[1];
  const T b11 = c1 * B1[1] - s1 * B1[0], b21 = c1 * B2[1] - s1 * B2[0];
  const T b12 = c2 * B1[2] - s2 * b10, b22 = c2 * B2[2] - s2 * b20;
  givens(b11, b12, c3, s3, r11);
  const T r12 = c3 * b21 + s3 * b22;
  r22 = c3 * b22 - s3 * b21;
  U0[0] = c2 * c1, U0[1] = c2 * s1, U0[2] = s2;
  const T p[3] = {-s1, c1, T{}};
  const T q[3] = {-s2 * c1, -s2 * s1, c2};
  for (int i = 0; i < 3; ++i) {
    U1[i] = c3 * p[i] + s3 * q[i];
    U2[i] = c3 * q[i] - s3 * p[i];
  }

  // [r11 r12; 0 r22]: turn columns 1 and 2 until orthogonal, the larger first, then QR again
  const auto repair = greater(abs(r12), r00 * 1.1102230246251565e-16) | greater(abs(r22), r11);
  if (any(repair)) {
    const T d = (r11 - r12) * (r11 + r12) - r22 * r22, a = 2.0 * (r11 * r12);
    const T h = sqrt(d * d + a * a);
    const T along = h + abs(d);
    const auto first = less(T{}, d);
    T cx = select(first, along, abs(a));
    T sx = select(first, a, copysign(along, a));
    T c, s, length;
    givens(cx, sx, c, s, length);
    c = select(repair, c, constant<T>(1.0));
    s = keep(repair, s);
    for (int i = 0; i < 3; ++i) {
      const T v1 = V1[i];
      V1[i] = c * v1 + s * V2[i];
      V2[i] = c * V2[i] - s * v1;
    }
    const T p0 = c * r11 + s * r12, p1 = s * r22;
    const T q0 = c * r12 - s * r11, q1 = c * r22;
    T cl, sl, r1;
    givens(p0, p1, cl, sl, r1);
    cl = select(repair, cl, constant<T>(1.0));
    sl = keep(repair, sl);
    r11 = select(repair, r1, r11);
    r22 = select(repair, cl * q1 - sl * q0, r22);
    for (int i = 0; i < 3; ++i) {
      const T u1 = U1[i];
      U1[i] = cl * u1 + sl * U2[i];
      U2[i] = cl * U2[i] - sl * u1;
    }
  }
}

// Out of line: it is large, and inlined into a caller's loop GCC spills more.
template <class T>
__attribute__((noinline)) void svd3_core(const T* F, T* U, T* sigma, T* V) {
  // A power of two brings the largest entry into [1, 2).
  T largest = constant<T>(2.2250738585072014e-308);
  for (int i = 0; i < 9; ++i) largest = max(abs(F[i]), largest);
  largest = min(largest, constant<T>(4.49423283715579e307));
  T scale, inv_scale;
  binary_scale(largest, scale, inv_scale);
  T A[9];
  for (int i = 0; i < 9; ++i) A[i] = F[i] * inv_scale;
  // 0, or NaN where an entry is NaN or infinite
  const T poison = (((A[0] + A[1]) + (A[2] + A[3])) + ((A[4] + A[5]) + (A[6] + A[7])) + A[8]) * 0.0;

  T S00 = A[0] * A[0] + A[3] * A[3] + A[6] * A[6];
  T S11 = A[1] * A[1] + A[4] * A[4] + A[7] * A[7];
  T S22 = A[2] * A[2] + A[5] * A[5] + A[8] * A[8];
  T S01 = A[0] * A[1] + A[3] * A[4] + A[6] * A[7];
  T S12 = A[1] * A[2] + A[4] * A[5] + A[7] * A[8];
  T S02 = A[0] * A[2] + A[3] * A[5] + A[6] * A[8];
  T w = constant<T>(1.0), x{}, y{}, z{};
  // Cyclic Jacobi needs 3 to 5 sweeps; the bound only guards against an endless loop.
  for (int sweep = 0; sweep < 12; ++sweep) {
    const T trace = S00 + S11 + S22;
    const T off = S01 * S01 + S12 * S12 + S02 * S02;
    const auto active = greater(off, trace * trace * 1e-32);
    if (!any(active)) break;
    jacobi_turn(active, S00, S11, S22, S01, S02, S12, w, z, x, y);
    jacobi_turn(active, S11, S22, S00, S12, S01, S02, w, x, y, z);
    jacobi_turn(active, S22, S00, S11, S02, S12, S01, w, y, z, x);
  }
  swap_turn(less(S00, S11), S00, S11, w, z, x, y);
  swap_turn(less(S00, S22), S22, S00, w, y, z, x);
  swap_turn(less(S11, S22), S11, S22, w, x, y, z);

  const T two = 2.0 / (w * w + x * x + y * y + z * z);
  const T tx = two * x, ty = two * y, tz = two * z;
  const T xx = tx * x, yy = ty * y, zz = tz * z, xy = tx * y, xz = tx * z, yz = ty * z;
  const T wx = tx * w, wy = ty * w, wz = tz * w;
  T V0[3] = {1.0 - (yy + zz), xy + wz, xz - wy};  // columns
  T V1[3] = {xy - wz, 1.0 - (xx + zz), yz + wx};
  T V2[3] = {xz + wy, yz - wx, 1.0 - (xx + yy)};

  T B0[3], B1[3], B2[3];
  for (int i = 0; i < 3; ++i) {
    B0[i] = A[3 * i] * V0[0] + A[3 * i + 1] * V0[1] + A[3 * i + 2] * V0[2];
    B1[i] = A[3 * i] * V1[0] + A[3 * i + 1] * V1[1] + A[3 * i + 2] * V1[2];
    B2[i] = A[3 * i] * V2[0] + A[3 * i + 1] * V2[1] + A[3 * i + 2] * V2[2];
  }

  T U0[3], U1[3], U2[3], r00, r11, r22;
  const auto normalized = normalize_columns(B0, B1, B2, U0, U1, U2, r00, r11, r22);
  if (!all(normalized)) {
    T G0[3], G1[3], G2[3], W1[3], W2[3], g00, g11, g22;
    for (int i = 0; i < 3; ++i) W1[i] = V1[i], W2[i] = V2[i];
    givens_qr(B0, B1, B2, W1, W2, G0, G1, G2, g00, g11, g22);
    for (int i = 0; i < 3; ++i) {
      U0[i] = select(normalized, U0[i], G0[i]);
      U1[i] = select(normalized, U1[i], G1[i]);
      U2[i] = select(normalized, U2[i], G2[i]);
      V1[i] = select(normalized, V1[i], W1[i]);
      V2[i] = select(normalized, V2[i], W2[i]);
    }
    r00 = select(normalized, r00, g00);
    r11 = select(normalized, r11, g11);
    r22 = select(normalized, r22, g22);
  }

  // Equal values may come out an ulp apart in the wrong order.
  const T hi = max(r00, r11), lo = min(r00, r11);
  sigma[0] = hi * scale + poison;
  sigma[1] = lo * scale + poison;
  sigma[2] = copysign(min(abs(r22), lo), r22) * scale + poison;
  for (int i = 0; i < 3; ++i) {
    U[3 * i] = U0[i] + poison;
    U[3 * i + 1] = U1[i] + poison;
    U[3 * i + 2] = U2[i] + poison;
    V[3 * i] = V0[i] + poison;
    V[3 * i + 1] = V1[i] + poison;
    V[3 * i + 2] = V2[i] + poison;
  }
}

}  // namespace detail

/// Singular value decomposition of kGroups times eight matrices, F = U diag(s) V^T.
/// @param[in]  F (kGroups, 3, 3) row-major, one matrix per lane
/// @param[out] U (kGroups, 3, 3) rotations, det +1
/// @param[out] s (kGroups, 3) s0 >= s1 >= |s2|, sign(s2) = sign(det F)
/// @param[out] V (kGroups, 3, 3) rotations, det +1
/// Errors, relative to s0: about 1e-15, at any condition number and at scales 1e-300 to 1e300;
/// values below 1e-145 s0 come out as zero.
/// kGroups = 2 is faster per matrix with AVX-512, where one Lane is a single register.
template <int kGroups = 1>
inline void svd3(const Lane* F, Lane* U, Lane* s, Lane* V) {
  detail::for_registers<kGroups>([&](auto at) {
    using T = typename decltype(at)::T;
    T f[9], u[9], sigma[3], v[9];
    at.template get<9>(F, f);
    detail::svd3_core<T>(f, u, sigma, v);
    at.template set<9>(U, u);
    at.template set<3>(s, sigma);
    at.template set<9>(V, v);
  });
}

namespace detail {

// Newton's X <- (X + X^-T) / 2 from F itself, whose fixed point is the rotation to rounding. Only
// for det F > 0 and singular values within some 60% of 1, as in a solid near rest: five steps at
// most. Returns those lanes; NaN and overflow are not among them.
template <class T>
DIFFSIM_INLINE auto polar3_newton(const T* F, T* X) {
  for (int i = 0; i < 9; ++i) X[i] = F[i];
  auto near_rest = less(T{}, T{}), done = near_rest;
  for (int step = 0; step < 8; ++step) {
    T C[9];  // cofactors
    for (int i = 0; i < 3; ++i) {
      const int a = (i + 1) % 3 * 3, b = (i + 2) % 3 * 3;
      for (int j = 0; j < 3; ++j) {
        const int k = (j + 1) % 3, l = (j + 2) % 3;
        C[3 * i + j] = X[a + k] * X[b + l] - X[a + l] * X[b + k];
      }
    }
    const T det = X[0] * C[0] + X[1] * C[1] + X[2] * C[2];
    const T half = 0.5 / det;
    T change{};
    for (int i = 0; i < 9; ++i) {
      const T next = 0.5 * X[i] + half * C[i];
      change = max(abs(next - X[i]), change);
      X[i] = select(done, X[i], next);
    }
    if (step == 0) {
      near_rest = greater(det, constant<T>(0.05)) & less(det, constant<T>(20.0)) &
                  less(change, constant<T>(0.5));
      if (!any(near_rest)) break;
      done = ~near_rest;
    }
    done = done | less(change, constant<T>(5e-9));  // the next change is about change^2 / 2
    if (all(done)) break;
  }
  return near_rest;
}

template <class T>
DIFFSIM_INLINE void polar3_core(const T* F, T* R) {
  const auto near_rest = polar3_newton(F, R);
  if (all(near_rest)) return;
  T U[9], s[3], V[9];
  svd3_core<T>(F, U, s, V);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const T r = U[3 * i] * V[3 * j] + U[3 * i + 1] * V[3 * j + 1] + U[3 * i + 2] * V[3 * j + 2];
      R[3 * i + j] = select(near_rest, R[3 * i + j], r);
    }
  }
}

}  // namespace detail

/// The rotation nearest to F, R = U V^T with the proper rotations of svd3.
/// @param[in]  F (kGroups, 3, 3) row-major, one matrix per lane
/// @param[out] R (kGroups, 3, 3) rotation, det +1; one of several where s1 + s2 = 0
template <int kGroups = 1>
inline void polar3(const Lane* F, Lane* R) {
  detail::for_registers<kGroups>([&](auto at) {
    using T = typename decltype(at)::T;
    T f[9], r[9];
    at.template get<9>(F, f);
    detail::polar3_core<T>(f, r);
    at.template set<9>(R, r);
  });
}

}  // namespace diffsim
