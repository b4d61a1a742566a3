// Projective-dynamics solid and muscle fiber: energy density, first Piola stress and its tangent,
// one sample per lane of T. Thesis eqs. 4.12-4.17 with closed-form derivatives of the projections.
//
// Solid:  psi(F) = w[0]/2 |F - R(F)|^2 + w[1]/2 |F - B(F)|^2 [J/m^3]
//   R: nearest rotation; B = U diag(t) V^T: nearest matrix of determinant one.
//   With F = U diag(s) V^T, minimizing |t - s|^2 subject to t0 t1 t2 = 1 gives
//   t_i (t_i - s_i) = -l with one multiplier l for all i, so t_i = (s_i + q_i)/2 and
//   q_i = +-sqrt(s_i^2 - 4 l). Taking u = t_2 (smallest) as the unknown, l = u (s_2 - u) and
//   q_2 = 2u - s_2 needs no root: one monotone scalar equation u t0(u) t1(u) = 1 is left.
// Fiber:  psi(F) = w/2 (|F m| - a)^2, unit direction m, activation a = target stretch.
#pragma once

#include <algorithm>
#include <new>

#include "kernels/soft/jets.h"
#include "kernels/soft/nearest_matrices.h"

namespace diffsim {

/// Where the search for t_2 begins. Near a volume of one at first order, t_i = s_i - l / s_i with
/// l = (J - 1) J / (squares of s1 s2, s0 s2 and s0 s1), which leaves an error of second order.
template <class T>
DIFFSIM_INLINE T first_target(const T s[3]) {
  const T s01 = s[0] * s[1], s02 = s[0] * s[2], s12 = s[1] * s[2];
  const T less_one = s01 * s[2] - 1.0;
  const T near = s[2] - less_one * s01 / (s01 * s01 + s02 * s02 + s12 * s12);
  const T far = max(s[2], detail::constant<T>(0.3));
  return select(less(abs(less_one), detail::constant<T>(0.5)) & less(far, near + near), near, far);
}

/// Targets t of the volume projection of the principal stretches s, and q = 2t - s: solves
/// u t0 t1 = 1 by Newton inside a bracket; exact to rounding, any sign of det F.
template <class T>
DIFFSIM_INLINE void project_volume(const T s[3], T t[3], T q[3]) {
  const T one = detail::constant<T>(1.0), zero{}, tiny = detail::constant<T>(1e-12);
  const T d0 = (s[0] - s[2]) * (s[0] + s[2]);
  const T d1 = (s[1] - s[2]) * (s[1] + s[2]);
  T low = zero, high = detail::constant<T>(1e300);
  T u = first_target(s);
  bool last = false;
  for (int iter = 0;; ++iter) {
    const T q2 = 2.0 * u - s[2];
    const T q0 = max(sqrt(max(d0 + q2 * q2, zero)), tiny);
    const T q1 = max(sqrt(max(d1 + q2 * q2, zero)), tiny);
    const T t0 = 0.5 * (s[0] + q0), t1 = 0.5 * (s[1] + q1);
    t[0] = t0, t[1] = t1, t[2] = u;
    q[0] = q0, q[1] = q1, q[2] = q2;
    if (last || iter == 60) return;
    const T value = u * t0 * t1 - one;
    // Newton squares the error: from 1e-8 the next iterate is exact to rounding. NaN is not
    // greater, so it does not hold up the other lanes.
    last = !any(greater(abs(value), broadcast<T>(1e-8)));
    const auto below = less(value, zero);
    low = select(below, u, low);
    high = select(below, high, u);
    // slope = t0 t1 + u q2 (t1 / q0 + t0 / q1), with one division instead of three
    const T q01 = q0 * q1;
    const T newton = u - value * q01 / (t0 * t1 * q01 + u * q2 * (t1 * q1 + t0 * q0));
    const T bisect = select(greater(high, detail::constant<T>(1e299)), 2.0 * u, 0.5 * (low + high));
    u = last ? newton : select(less(low, newton) & less(newton, high), newton, bisect);
  }
}

/// A frame with the targets t of the volume projection and q = 2t - s.
template <class T>
struct PdSample : PrincipalFrame<T> {
  T t[3], q[3];

  explicit PdSample(const PrincipalFrame<T>& frame) : PrincipalFrame<T>(frame) {
    project_volume(this->s, t, q);
  }
  PdSample(const PrincipalFrame<T>& frame, const T t_of[3], const T q_of[3])
      : PrincipalFrame<T>(frame) {
    for (int i = 0; i < 3; ++i) t[i] = t_of[i], q[i] = q_of[i];
  }

  /// Samples of `count` registers, some side by side, into memory that holds none.
  static void make(const PrincipalFrame<T>* frames, int count, PdSample* out) {
    for (int r = 0; r < count; r += kFrames) {
      const int some = std::min(kFrames, count - r);
      Registers<T, kFrames> s[3], targets[3], roots[3];
      for (int i = 0; i < kFrames; ++i)
        for (int k = 0; k < 3; ++k) s[k].at[i] = frames[r + std::min(i, some - 1)].s[k];
      project_volume(s, targets, roots);
      for (int i = 0; i < some; ++i) {
        const T t_of[3] = {targets[0].at[i], targets[1].at[i], targets[2].at[i]};
        const T q_of[3] = {roots[0].at[i], roots[1].at[i], roots[2].at[i]};
        new (out + r + i) PdSample(frames[r + i], t_of, q_of);
      }
    }
  }
};

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

/// Nearest rotation and nearest matrix of determinant one: by singular values in the lanes only
/// that are far from rest.
inline void project(const Native F[9], Native R[9], Native B[9]) {
  const auto found = nearest_matrices(F, R, B);
  if (all(found)) return;
  const PdSample<Native> sample(principal_frame(F));
  const Native one = broadcast<Native>(1.0), ones[3] = {one, one, one};
  Native rotation[9], unit[9];
  compose(sample.U, ones, sample.V, rotation);
  compose(sample.U, sample.t, sample.V, unit);
  for (int k = 0; k < 9; ++k) {
    R[k] = select(found, R[k], rotation[k]);
    B[k] = select(found, B[k], unit[k]);
  }
}

/// The solid as a material, see material.h.
struct PdMaterial {
  static constexpr const char* kName = "pd";
  static constexpr int kWeights = 2;
  static constexpr bool kKeepsSamples = true, kJetsInFrame = true;

  template <class T>
  using Sample = PdSample<T>;

  /// Principal stresses w[0] (s - 1) + w[1] (s - t) [Pa].
  template <class T>
  static T stress(const Sample<T>& p, const T w[kWeights], T d[3]) {
    T corotated = broadcast<T>(0.0), volume = broadcast<T>(0.0);
    for (int i = 0; i < 3; ++i) {
      const T a = p.s[i] - 1.0, b = p.s[i] - p.t[i];
      d[i] = w[0] * a + w[1] * b;
      corotated += a * a;
      volume += b * b;
    }
    return 0.5 * (w[0] * corotated + w[1] * volume);
  }

  /// First Piola stress [Pa] of F; returns the energy density [J/m^3].
  static Native stress_alone(const Native F[9], const Native w[kWeights], Native P[9]) {
    Native R[9], B[9], corotated{}, volume{};
    project(F, R, B);
    for (int k = 0; k < 9; ++k) {
      const Native a = F[k] - R[k], b = F[k] - B[k];
      P[k] = w[0] * a + w[1] * b;
      corotated += a * a;
      volume += b * b;
    }
    return 0.5 * (w[0] * corotated + w[1] * volume);
  }

  template <class T>
  static PrincipalTangent<T> tangent(const Sample<T>& p, const T w[kWeights]) {
    PrincipalTangent<T> c;
    const T one = broadcast<T>(1.0), tiny = broadcast<T>(1e-12);
    const T r0 = one / (p.t[0] * p.q[0]), r1 = one / (p.t[1] * p.q[1]);
    const T inverse_q[2] = {p.t[0] * r0, p.t[1] * r1}, inverse_t[2] = {p.q[0] * r0, p.q[1] * r1};
    const T q2t2 = p.q[2] * p.t[2];
    const T inverse = one / (one + q2t2 * (r0 + r1));
    // dl = g . ds, dt_i = (t_i ds_i - dl) / q_i for i < 2, and dt_2 from t0 t1 t2 = 1.
    const T g[3] = {q2t2 * inverse_q[0] * inverse, q2t2 * inverse_q[1] * inverse, p.t[2] * inverse};
    T dt[9];
    for (int j = 0; j < 3; ++j) {
      for (int i = 0; i < 2; ++i)
        dt[3 * i + j] = ((i == j ? p.t[i] : broadcast<T>(0.0)) - g[j]) * inverse_q[i];
      dt[6 + j] = -p.t[2] * (dt[j] * inverse_t[0] + dt[3 + j] * inverse_t[1]);
    }
    for (int i = 0; i < 9; ++i)
      c.diagonal[i] = (i % 4 == 0 ? w[0] + w[1] : broadcast<T>(0.0)) - w[1] * dt[i];
    for (int k = 0; k < 3; ++k) {
      const int i = kPair[k][0], j = kPair[k][1];
      const T t = p.t[i] + p.t[j];
      // s_i + s_j = 0 is where the nearest rotation is not unique: the derivative is unbounded
      // there.
      const T over = one / max(p.s[i] + p.s[j], tiny), q = p.q[i] + p.q[j];
      c.symmetric[k] = w[0] + w[1] * (one - t / select(less(abs(q), tiny), tiny, q));
      c.skew[k] = w[0] * (one - 2.0 * over) + w[1] * (one - t * over);
    }
    return c;
  }

  template <class T>
  static void jets(const Sample<T>& p, const Jet<T> F[9], Jet<T> P[kWeights][9]) {
    Jet<T>*mu = P[0], *vol = P[1];
    rotation_jets(p.s, F, mu);
    volume_jets(p, F, vol);
    for (int i = 0; i < 9; ++i) mu[i] = F[i] - mu[i], vol[i] = F[i] - vol[i];
  }
};

/// Fiber of direction m: l = F m, P = w (1 - a/|l|) l m^T; returns psi.
template <class T>
struct FiberState {
  T direction[3], unit[3], length;
};

template <class T>
inline FiberState<T> fiber_state(const T F[9], const T m[3]) {
  FiberState<T> f;
  T l[3];
  for (int i = 0; i < 3; ++i) {
    f.direction[i] = m[i];
    l[i] = F[3 * i] * m[0] + F[3 * i + 1] * m[1] + F[3 * i + 2] * m[2];
  }
  f.length = max(sqrt(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]), broadcast<T>(1e-12));
  for (int i = 0; i < 3; ++i) f.unit[i] = l[i] / f.length;
  return f;
}

/// psi = w/2 stretch^2 with stretch = |l| - a; a fiber that only pulls (a tendon) has
/// w/2 max(0, stretch)^2, whose slope is continuous and whose curvature jumps at stretch = 0.
template <class T>
struct FiberPull {
  T stiffness;  // w, and zero where slack
  T stretch;    // |l| - a, and zero where slack
};

/// At the kink the taut side's derivatives are taken, within rounding too: at rest with a = 1 the
/// sign of |l| - a is noise, and a command there should have a gradient.
template <class T>
inline FiberPull<T> fiber_pull(const FiberState<T>& f, const T& w, const T& activation,
                               const T& pull_only) {
  const T zero = broadcast<T>(0.0), stretch = f.length - activation;
  const auto one_sided = greater(pull_only, zero);
  const T taut = select(less(stretch, broadcast<T>(-1e-12)), zero, w);
  return {select(one_sided, taut, w), select(one_sided, max(stretch, zero), stretch)};
}

template <class T>
inline T fiber_stress(const FiberState<T>& f, const FiberPull<T>& pull, T P[9]) {
  const T tension = pull.stiffness * pull.stretch;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) P[3 * i + j] = tension * f.unit[i] * f.direction[j];
  return 0.5 * tension * pull.stretch;
}

/// Adds dP_ij/dF_kl = C_ik m_j m_l with C = w (stretch/|l| (I - e e^T) + e e^T), e = l/|l|, to the
/// entries on and above the diagonal of H.
template <class T>
inline void add_fiber_tangent(const FiberState<T>& f, const FiberPull<T>& pull, bool clamp,
                              T H[81]) {
  T across = pull.stretch / f.length;
  if (clamp) across = max(across, broadcast<T>(0.0));
  T C[9], mm[9];
  for (int i = 0; i < 9; ++i) {
    C[i] = pull.stiffness * ((1.0 - across) * f.unit[i / 3] * f.unit[i % 3] +
                             (i % 4 == 0 ? across : broadcast<T>(0.0)));
    mm[i] = f.direction[i / 3] * f.direction[i % 3];
  }
  for (int a = 0; a < 9; ++a)
    for (int b = a; b < 9; ++b) H[9 * a + b] += C[3 * (a / 3) + b / 3] * mm[3 * (a % 3) + b % 3];
}

}  // namespace diffsim
