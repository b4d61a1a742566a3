// Flexible GMRES (Saad 1993): the preconditioner may round, here to single precision.
#pragma once

#include <cmath>
#include <limits>

#include "kernels/linalg/krylov.h"

namespace diffsim {

/// Preconditioned from the right, restarted; x starts from zero. Corrections are kept in single
/// precision and applied as kept, so the residual norm is that of b - A x itself.
/// @param apply         apply(in, out): out = A in
/// @param precondition  precondition(in, out): out about A^-1 in
template <typename Apply, typename Precondition>
KrylovResult flexible_gmres(Apply&& apply, Precondition&& precondition, const Vector& b, Vector& x,
                            double tolerance, int max_iters, VectorOps& ops) {
  constexpr int kRestart = 50;
  const std::size_t n = b.size();
  KrylovResult result;
  x.assign(n, 0.0);
  Vector r = b, z(n);
  std::vector<Vector> basis;
  std::vector<std::vector<float>> corrections;
  std::vector<double> H(kRestart * (kRestart + 1)), cs(kRestart), sn(kRestart), g(kRestart + 1);
  const auto h = [&](int i, int j) -> double& {
    return H[static_cast<std::size_t>(j * (kRestart + 1) + i)];
  };
  while (true) {
    const double beta = result.residual_norm = ops.norm(r);
    result.converged = beta <= tolerance;
    if (result.converged || result.num_iters >= max_iters || !std::isfinite(beta)) return result;
    if (basis.empty()) basis.emplace_back(n);
    basis[0] = r;
    for (double& value : basis[0]) value /= beta;
    std::fill(g.begin(), g.end(), 0.0);
    g[0] = beta;
    int k = 0;
    while (k < kRestart && result.num_iters < max_iters) {
      const std::size_t j = static_cast<std::size_t>(k);
      precondition(basis[j], z);
      if (corrections.size() == j) corrections.emplace_back(n);
      for (std::size_t i = 0; i < n; ++i) {
        corrections[j][i] = static_cast<float>(z[i]);
        z[i] = static_cast<double>(corrections[j][i]);
      }
      if (basis.size() == j + 1) basis.emplace_back(n);
      Vector& w = basis[j + 1];
      apply(z, w);
      for (int i = 0; i <= k; ++i) {
        h(i, k) = ops.dot(basis[static_cast<std::size_t>(i)], w);
        ops.add(-h(i, k), basis[static_cast<std::size_t>(i)], w);
      }
      const double next = ops.norm(w);
      for (int i = 0; i < k; ++i) {  // the earlier rotations
        const std::size_t at = static_cast<std::size_t>(i);
        const double upper = h(i, k), lower = h(i + 1, k);
        h(i, k) = cs[at] * upper + sn[at] * lower;
        h(i + 1, k) = cs[at] * lower - sn[at] * upper;
      }
      const double length = std::max(std::hypot(h(k, k), next), std::numeric_limits<double>::min());
      cs[j] = h(k, k) / length;
      sn[j] = next / length;
      h(k, k) = length;
      g[j + 1] = -sn[j] * g[j];
      g[j] *= cs[j];
      ++k;
      ++result.num_iters;
      if (std::abs(g[j + 1]) <= 0.7 * tolerance || next <= 1e-15 * beta) break;
      for (double& value : w) value /= next;
    }
    for (int i = k - 1; i >= 0; --i) {  // back substitution
      double& y = g[static_cast<std::size_t>(i)];
      for (int j = i + 1; j < k; ++j) y -= h(i, j) * g[static_cast<std::size_t>(j)];
      y /= h(i, i);
    }
    for (int i = 0; i < k; ++i) {
      const std::vector<float>& c = corrections[static_cast<std::size_t>(i)];
      const double y = g[static_cast<std::size_t>(i)];
      for (std::size_t e = 0; e < n; ++e) x[e] += y * static_cast<double>(c[e]);
    }
    apply(x, r);
    for (std::size_t i = 0; i < n; ++i) r[i] = b[i] - r[i];
    const double left = ops.norm(r);
    // A restart that gains nothing will gain nothing next time either.
    if (!(left <= 0.999 * beta)) {
      result.residual_norm = left;
      result.converged = left <= tolerance;
      return result;
    }
  }
}

}  // namespace diffsim
