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

/// Restarted GMRES (Saad and Schultz 1986), preconditioned from the right, for any A; starts from
/// zero. The residual norm is that of b - A x itself.
template <typename Apply, typename Precondition>
KrylovResult gmres(Apply&& apply, Precondition&& precondition, const Vector& b, Vector& x,
                   double tolerance, int max_iters, VectorOps& ops) {
  constexpr int kRestart = 60;
  const std::size_t n = b.size();
  KrylovResult result;
  x.assign(n, 0.0);
  Vector r = b, z(n), combined(n);
  std::vector<Vector> basis(1, r);
  std::vector<double> H(kRestart * (kRestart + 1)), cs(kRestart), sn(kRestart), g(kRestart + 1);
  const auto h = [&](int i, int j) -> double& {
    return H[static_cast<std::size_t>(j * (kRestart + 1) + i)];
  };
  while (true) {
    const double beta = ops.norm(r);
    result.residual_norm = beta;
    result.converged = beta <= tolerance;
    if (result.converged || result.num_iters >= max_iters || !std::isfinite(beta)) return result;
    basis[0] = r;
    for (double& v : basis[0]) v /= beta;
    std::fill(g.begin(), g.end(), 0.0);
    g[0] = beta;
    int k = 0;
    for (; k < kRestart && result.num_iters < max_iters; ++k) {
      const std::size_t j = static_cast<std::size_t>(k);
      precondition(basis[j], z);
      if (basis.size() == j + 1) basis.emplace_back(n);
      apply(z, basis[j + 1]);
      Vector& w = basis[j + 1];
      for (int i = 0; i <= k; ++i) {
        h(i, k) = ops.dot(basis[static_cast<std::size_t>(i)], w);
        ops.add(-h(i, k), basis[static_cast<std::size_t>(i)], w);
      }
      const double next = ops.norm(w);
      for (int i = 0; i < k; ++i) {  // the earlier rotations
        const std::size_t u = static_cast<std::size_t>(i);
        const double a = h(i, k), c = h(i + 1, k);
        h(i, k) = cs[u] * a + sn[u] * c;
        h(i + 1, k) = cs[u] * c - sn[u] * a;
      }
      const double length = std::max(std::hypot(h(k, k), next), std::numeric_limits<double>::min());
      cs[j] = h(k, k) / length;
      sn[j] = next / length;
      h(k, k) = length;
      g[j + 1] = -sn[j] * g[j];
      g[j] *= cs[j];
      ++result.num_iters;
      if (std::abs(g[j + 1]) <= 0.5 * tolerance || next <= 1e-15 * beta) {
        ++k;
        break;
      }
      for (double& v : w) v /= next;
    }
    for (int i = k - 1; i >= 0; --i) {  // back substitution
      double& v = g[static_cast<std::size_t>(i)];
      for (int j = i + 1; j < k; ++j) v -= h(i, j) * g[static_cast<std::size_t>(j)];
      v /= h(i, i);
    }
    std::fill(combined.begin(), combined.end(), 0.0);
    for (int i = 0; i < k; ++i)
      ops.add(g[static_cast<std::size_t>(i)], basis[static_cast<std::size_t>(i)], combined);
    precondition(combined, z);
    ops.add(1.0, z, x);
    apply(x, r);
    for (std::size_t i = 0; i < n; ++i) r[i] = b[i] - r[i];
    // A restart that gains nothing will gain nothing next time either.
    if (k == 0 || ops.norm(r) > 0.999 * beta) {
      result.residual_norm = ops.norm(r);
      result.converged = result.residual_norm <= tolerance;
      return result;
    }
  }
}

}  // namespace diffsim
