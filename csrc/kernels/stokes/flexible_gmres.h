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
  const std::size_t n = b.size();
  KrylovResult result;
  x.assign(n, 0.0);
  Vector r = b, z(n);
  // Pressures that hardly anything holds need a long memory: with 50 directions an incompressible
  // flow took three times the iterations. Memory grows with the directions that are taken.
  GmresCycle cycle(300, n);
  std::vector<std::vector<float>> corrections;
  while (true) {
    const double beta = result.residual_norm = ops.norm(r);
    result.converged = beta <= tolerance;
    if (result.converged || result.num_iters >= max_iters || !std::isfinite(beta)) return result;
    cycle.start(r, beta);
    for (bool done = false; !done && !cycle.full() && result.num_iters < max_iters;) {
      const std::size_t j = static_cast<std::size_t>(cycle.size());
      precondition(cycle.latest(), z);
      if (corrections.size() == j) corrections.emplace_back(n);
      for (std::size_t i = 0; i < n; ++i) {
        corrections[j][i] = static_cast<float>(z[i]);
        z[i] = static_cast<double>(corrections[j][i]);
      }
      apply(z, cycle.image());
      done = cycle.take(0.7 * tolerance, ops);
      ++result.num_iters;
    }
    const std::vector<double>& y = cycle.coefficients();
    for (std::size_t k = 0; k < static_cast<std::size_t>(cycle.size()); ++k)
      for (std::size_t e = 0; e < n; ++e) x[e] += y[k] * static_cast<double>(corrections[k][e]);
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
