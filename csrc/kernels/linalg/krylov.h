// Preconditioned conjugate gradients and MINRES for symmetric systems given as functions.
#pragma once

#include <limits>

#include "kernels/vector_ops.h"

namespace diffsim {

struct KrylovResult {
  int num_iters = 0;
  double residual_norm = 0.0;  // |b - A x|
  bool converged = false;
  bool negative_curvature = false;  // p' A p <= 0 was met: A is not positive definite
};

/// Memory reused between solves of one size.
struct KrylovScratch {
  Vector r, z, p, Ap;
};

/// Conjugate gradients; x is the initial guess if `warm`, else zero.
/// At negative curvature it stops with the iterate so far (a descent direction when b = -gradient).
/// @param[in] apply         apply(in, out): out = A in
/// @param[in] precondition  precondition(in, out): out = P^-1 in, P symmetric positive definite
template <typename Apply, typename Precondition>
KrylovResult conjugate_gradients(Apply&& apply, Precondition&& precondition, const Vector& b,
                                 Vector& x, bool warm, double tolerance, int max_iters,
                                 KrylovScratch& s, VectorOps& ops) {
  KrylovResult result;
  s.r = b;
  s.Ap.resize(b.size());
  s.z.resize(b.size());
  if (warm) {
    apply(x, s.Ap);
    ops.add(-1.0, s.Ap, s.r);
  } else {
    x.assign(b.size(), 0.0);
  }
  result.residual_norm = ops.norm(s.r);
  double rz = 0.0;
  while (true) {
    if (result.residual_norm <= tolerance) {
      result.converged = true;
      return result;
    }
    if (result.num_iters >= max_iters || !std::isfinite(result.residual_norm)) return result;
    precondition(s.r, s.z);
    const double rz_next = ops.dot(s.r, s.z);
    if (result.num_iters == 0)
      s.p = s.z;
    else
      ops.scale_add(s.z, rz_next / rz, s.p);
    rz = rz_next;
    apply(s.p, s.Ap);
    const double curvature = ops.dot(s.p, s.Ap);
    ++result.num_iters;
    if (!(curvature > 0.0)) {
      result.negative_curvature = true;
      if (result.num_iters == 1) x = s.p;
      return result;
    }
    const double alpha = rz / curvature;
    ops.add(alpha, s.p, x);
    ops.add(-alpha, s.Ap, s.r);
    result.residual_norm = ops.norm(s.r);
  }
}

/// MINRES (Paige and Saunders 1975) with a symmetric positive definite preconditioner: for A that
/// is symmetric but indefinite. Starts from zero; stops on the true residual, checked every ten
/// iterations since the recurrence only knows the preconditioned norm.
template <typename Apply, typename Precondition>
KrylovResult minres(Apply&& apply, Precondition&& precondition, const Vector& b, Vector& x,
                    double tolerance, int max_iters, VectorOps& ops) {
  const std::size_t n = b.size();
  KrylovResult result;
  x.assign(n, 0.0);
  result.residual_norm = ops.norm(b);
  if (result.residual_norm <= tolerance) {
    result.converged = true;
    return result;
  }
  Vector r1 = b, r2 = b, y(n), v(n), w(n, 0.0), w1(n, 0.0), w2(n, 0.0), check(n);
  precondition(r1, y);
  const double beta1 = std::sqrt(ops.dot(r1, y));
  double old_beta = 0.0, beta = beta1, dbar = 0.0, epsilon = 0.0, phibar = beta1, cs = -1.0,
         sn = 0.0;
  while (result.num_iters < max_iters) {
    for (std::size_t i = 0; i < n; ++i) v[i] = y[i] / beta;
    apply(v, y);
    if (result.num_iters > 0) ops.add(-beta / old_beta, r1, y);
    const double alpha = ops.dot(v, y);
    ops.add(-alpha / beta, r2, y);
    r1.swap(r2);
    r2 = y;
    precondition(r2, y);
    old_beta = beta;
    const double beta_squared = ops.dot(r2, y);
    beta = std::sqrt(std::max(beta_squared, 0.0));
    const double old_epsilon = epsilon;
    const double delta = cs * dbar + sn * alpha;
    const double gbar = sn * dbar - cs * alpha;
    epsilon = sn * beta;
    dbar = -cs * beta;
    const double gamma = std::max(std::hypot(gbar, beta), std::numeric_limits<double>::min());
    cs = gbar / gamma;
    sn = beta / gamma;
    const double phi = cs * phibar;
    phibar *= sn;
    w1.swap(w2);
    w2.swap(w);
    for (std::size_t i = 0; i < n; ++i) w[i] = (v[i] - old_epsilon * w1[i] - delta * w2[i]) / gamma;
    ops.add(phi, w, x);
    ++result.num_iters;
    const bool breakdown = beta <= 1e-15 * beta1;
    if (result.num_iters % 10 == 0 || breakdown || result.num_iters == max_iters) {
      apply(x, check);
      for (std::size_t i = 0; i < n; ++i) check[i] = b[i] - check[i];
      result.residual_norm = ops.norm(check);
      result.converged = result.residual_norm <= tolerance;
      if (result.converged || breakdown || !std::isfinite(result.residual_norm)) return result;
    }
  }
  return result;
}

}  // namespace diffsim
