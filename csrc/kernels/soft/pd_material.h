// Projective-dynamics solid and muscle fiber: energy density, first Piola stress and its tangent,
// eight samples at a time. Thesis eqs. 4.12-4.17 with closed-form derivatives of the projections.
//
// Solid:  psi(F) = w_mu/2 |F - R(F)|^2 + w_vol/2 |F - B(F)|^2                               [J/m^3]
//   R: nearest rotation; B = U diag(t) V^T: nearest matrix of determinant one.
//   With F = U diag(s) V^T, minimizing |t - s|^2 subject to t0 t1 t2 = 1 gives
//   t_i (t_i - s_i) = -l with one multiplier l for all i, so t_i = (s_i + q_i)/2 and
//   q_i = +-sqrt(s_i^2 - 4 l). Taking u = t_2 (smallest) as the unknown, l = u (s_2 - u) and
//   q_2 = 2u - s_2 needs no root: one monotone scalar equation u t0(u) t1(u) = 1 is left.
// Fiber:  psi(F) = w/2 (|F m| - a)^2, unit direction m, activation a = target stretch.
#pragma once

#include "kernels/soft/principal.h"

namespace diffsim {

/// Principal stretches s, targets t of the volume projection and q = 2t - s.
struct PdProjection : PrincipalFrame {
  Lane t[3], q[3];

  explicit PdProjection(const Lane F[9]) : PrincipalFrame(principal_frame(F)) { project_volume(); }

 private:
  void project_volume();
};

/// Solves u t0 t1 = 1 by Newton inside a bracket; exact to rounding, any sign of det F.
inline void PdProjection::project_volume() {
  const Lane one = broadcast(1.0), zero = broadcast(0.0), tiny = broadcast(1e-12);
  const Lane d0 = (s[0] - s[2]) * (s[0] + s[2]);
  const Lane d1 = (s[1] - s[2]) * (s[1] + s[2]);
  Lane low = zero, high = broadcast(1e300);
  Lane u = max(s[2], broadcast(0.3));
  bool last = false;
  for (int iter = 0;; ++iter) {
    const Lane q2 = 2.0 * u - s[2];
    const Lane q0 = max(sqrt(max(d0 + q2 * q2, zero)), tiny);
    const Lane q1 = max(sqrt(max(d1 + q2 * q2, zero)), tiny);
    const Lane t0 = 0.5 * (s[0] + q0), t1 = 0.5 * (s[1] + q1);
    t[0] = t0, t[1] = t1, t[2] = u;
    q[0] = q0, q[1] = q1, q[2] = q2;
    if (last || iter == 60) return;
    const Lane value = u * t0 * t1 - one;
    // Newton squares the error: from 1e-8 the next iterate is exact to rounding. NaN is not
    // greater, so it does not hold up the other lanes.
    last = !any(greater(abs(value), broadcast(1e-8)));
    const LaneMask below = less(value, zero);
    low = select(below, u, low);
    high = select(below, high, u);
    const Lane slope = t0 * t1 + u * q2 * (t1 / q0 + t0 / q1);
    const Lane newton = u - value / slope;
    const Lane bisect = select<Lane>(greater(high, broadcast(1e299)), 2.0 * u, 0.5 * (low + high));
    u = last ? newton : select(less(low, newton) & less(newton, high), newton, bisect);
  }
}

/// Principal stresses w_mu (s - 1) + w_vol (s - t) [Pa]; returns psi [J/m^3].
inline Lane pd_stress(const PdProjection& p, const Lane& w_mu, const Lane& w_vol, Lane d[3]) {
  Lane corotated = broadcast(0.0), volume = broadcast(0.0);
  for (int i = 0; i < 3; ++i) {
    const Lane a = p.s[i] - 1.0, b = p.s[i] - p.t[i];
    d[i] = w_mu * a + w_vol * b;
    corotated += a * a;
    volume += b * b;
  }
  return 0.5 * (w_mu * corotated + w_vol * volume);
}

inline PrincipalTangent pd_tangent_principal(const PdProjection& p, const Lane& w_mu,
                                             const Lane& w_vol) {
  PrincipalTangent c;
  const Lane one = broadcast(1.0), tiny = broadcast(1e-12);
  const Lane r0 = one / (p.t[0] * p.q[0]), r1 = one / (p.t[1] * p.q[1]);
  const Lane q2t2 = p.q[2] * p.t[2];
  const Lane denominator = one + q2t2 * (r0 + r1);
  // dl = g . ds, dt_i = (t_i ds_i - dl) / q_i for i < 2, and dt_2 from t0 t1 t2 = 1.
  const Lane g[3] = {q2t2 / (p.q[0] * denominator), q2t2 / (p.q[1] * denominator),
                     p.t[2] / denominator};
  Lane dt[9];
  for (int j = 0; j < 3; ++j) {
    for (int i = 0; i < 2; ++i)
      dt[3 * i + j] = ((i == j ? p.t[i] : broadcast(0.0)) - g[j]) / p.q[i];
    dt[6 + j] = -p.t[2] * (dt[j] / p.t[0] + dt[3 + j] / p.t[1]);
  }
  for (int i = 0; i < 9; ++i)
    c.diagonal[i] = (i % 4 == 0 ? w_mu + w_vol : broadcast(0.0)) - w_vol * dt[i];
  for (int k = 0; k < 3; ++k) {
    const int i = kPair[k][0], j = kPair[k][1];
    const Lane t = p.t[i] + p.t[j];
    // s_i + s_j = 0 is where the nearest rotation is not unique: the derivative is unbounded there.
    const Lane s = max(p.s[i] + p.s[j], tiny), q = p.q[i] + p.q[j];
    c.symmetric[k] = w_mu + w_vol * (one - t / select(less(abs(q), tiny), tiny, q));
    c.skew[k] = w_mu * (one - 2.0 / s) + w_vol * (one - t / s);
  }
  return c;
}

/// The solid as a material policy, see material.h.
struct PdMaterial {
  using Sample = PdProjection;
  static Lane stress(const Sample& p, const Lane& w_mu, const Lane& w_vol, Lane d[3]) {
    return pd_stress(p, w_mu, w_vol, d);
  }
  static PrincipalTangent tangent(const Sample& p, const Lane& w_mu, const Lane& w_vol) {
    return pd_tangent_principal(p, w_mu, w_vol);
  }
};

/// Fiber of direction m: l = F m, P = w (1 - a/|l|) l m^T; returns psi.
struct FiberState {
  Lane direction[3], unit[3], length;
};

inline FiberState fiber_state(const Lane F[9], const Lane m[3]) {
  FiberState f;
  Lane l[3];
  for (int i = 0; i < 3; ++i) {
    f.direction[i] = m[i];
    l[i] = F[3 * i] * m[0] + F[3 * i + 1] * m[1] + F[3 * i + 2] * m[2];
  }
  f.length = max(sqrt(l[0] * l[0] + l[1] * l[1] + l[2] * l[2]), broadcast(1e-12));
  for (int i = 0; i < 3; ++i) f.unit[i] = l[i] / f.length;
  return f;
}

/// psi = w/2 stretch^2 with stretch = |l| - a; a fiber that only pulls (a tendon) has
/// w/2 max(0, stretch)^2, whose slope is continuous and whose curvature jumps at stretch = 0.
struct FiberPull {
  Lane stiffness;  // w, and zero where slack
  Lane stretch;    // |l| - a, and zero where slack
};

/// At the kink the taut side's derivatives are taken, within rounding too: at rest with a = 1 the
/// sign of |l| - a is noise, and a command there should have a gradient.
inline FiberPull fiber_pull(const FiberState& f, const Lane& w, const Lane& activation,
                            const Lane& pull_only) {
  const Lane zero = broadcast(0.0), stretch = f.length - activation;
  const LaneMask one_sided = greater(pull_only, zero);
  const Lane taut = select(less(stretch, broadcast(-1e-12)), zero, w);
  return {select(one_sided, taut, w), select(one_sided, max(stretch, zero), stretch)};
}

inline Lane fiber_stress(const FiberState& f, const FiberPull& pull, Lane P[9]) {
  const Lane tension = pull.stiffness * pull.stretch;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) P[3 * i + j] = tension * f.unit[i] * f.direction[j];
  return 0.5 * tension * pull.stretch;
}

/// dP_ij/dF_kl = C_ik m_j m_l with C = w (stretch/|l| (I - e e^T) + e e^T), e = l/|l|.
inline void fiber_tangent(const FiberState& f, const FiberPull& pull, bool clamp, Lane H[81]) {
  Lane across = pull.stretch / f.length;
  if (clamp) across = max(across, broadcast(0.0));
  Lane C[9];
  for (int i = 0; i < 9; ++i)
    C[i] = pull.stiffness * ((1.0 - across) * f.unit[i / 3] * f.unit[i % 3] +
                             (i % 4 == 0 ? across : broadcast(0.0)));
  for (int a = 0; a < 9; ++a)
    for (int b = 0; b < 9; ++b)
      H[9 * a + b] = C[3 * (a / 3) + b / 3] * f.direction[a % 3] * f.direction[b % 3];
}

}  // namespace diffsim
