// Flexible GMRES (Saad 1993): the preconditioner may round to single precision, or vary.
#pragma once

#include <cmath>
#include <limits>

#include "kernels/linalg/krylov.h"

namespace diffsim {

/// Preconditioned from the right, restarted, for any A; x starts from zero. Corrections are kept
/// and applied as kept, so the residual norm is that of b - A x itself. (Preconditioning their sum
/// instead, as plain GMRES does, leaves what rounding of the preconditioner makes of large
/// coefficients that cancel.)
/// @tparam Kept         float or double, what corrections are kept in
/// @param apply         apply(in, out): out = A in
/// @param precondition  precondition(in, out): out about A^-1 in
/// @param restart       directions after which it begins anew; memory grows with those taken
template <typename Kept, typename Apply, typename Precondition>
KrylovResult flexible_gmres(Apply&& apply, Precondition&& precondition, const Vector& b, Vector& x,
                            double tolerance, int max_iters, int restart, VectorOps& ops) {
  const std::size_t n = b.size();
  KrylovResult result;
  x.assign(n, 0.0);
  Vector r = b, z(n);
  GmresCycle cycle(restart, n);
  std::vector<std::vector<Kept>> corrections;
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
        corrections[j][i] = static_cast<Kept>(z[i]);
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
