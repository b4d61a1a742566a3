// Flexible GMRES (Saad 1993): the preconditioner may round to single precision, or vary.
#pragma once

#include <cmath>
#include <functional>
#include <limits>

#include "kernels/linalg/krylov.h"

namespace diffsim {

/// One cycle of restarted GMRES: an orthonormal basis, and the least-squares problem of the
/// residual made triangular by Givens rotations as its columns come.
class GmresCycle {
 public:
  GmresCycle(int restart, std::size_t n)
      : restart_(restart),
        n_(n),
        H_(u(restart * (restart + 1))),
        cs_(u(restart)),
        sn_(u(restart)),
        g_(u(restart + 1)) {}

  void start(const Vector& r, double norm) {
    beta_ = norm;
    size_ = 0;
    grow(0);
    for (std::size_t i = 0; i < n_; ++i) basis_[0][i] = r[i] / norm;
    std::fill(g_.begin(), g_.end(), 0.0);
    g_[0] = norm;
  }
  int size() const { return size_; }
  bool full() const { return size_ == restart_; }
  /// Of the residual, by the least-squares problem.
  double residual_norm() const { return std::abs(g_[u(size_)]); }
  const Vector& basis(int i) const { return basis_[u(i)]; }
  /// The direction whose image is wanted next, and where to put that image.
  const Vector& latest() const { return basis_[u(size_)]; }
  Vector& image() {
    grow(size_ + 1);
    return basis_[u(size_ + 1)];
  }
  /// Takes the image in; true where the residual is at the target or the space is exhausted.
  bool take(double target, VectorOps& ops) {
    const int k = size_++;
    Vector& w = basis_[u(k + 1)];
    h(0, k) = ops.dot(basis_[0], w);
    for (int i = 0; i < k; ++i)  // of the rest, what the next direction has
      h(i + 1, k) = ops.add_and_dot(-h(i, k), basis_[u(i)], w, basis_[u(i + 1)]);
    const double next = std::sqrt(ops.add_and_dot(-h(k, k), basis_[u(k)], w, w));
    for (int i = 0; i < k; ++i) {  // the earlier rotations
      const double upper = h(i, k), lower = h(i + 1, k);
      h(i, k) = cs_[u(i)] * upper + sn_[u(i)] * lower;
      h(i + 1, k) = cs_[u(i)] * lower - sn_[u(i)] * upper;
    }
    const double length = std::max(std::hypot(h(k, k), next), std::numeric_limits<double>::min());
    cs_[u(k)] = h(k, k) / length;
    sn_[u(k)] = next / length;
    h(k, k) = length;
    g_[u(k + 1)] = -sn_[u(k)] * g_[u(k)];
    g_[u(k)] *= cs_[u(k)];
    if (std::abs(g_[u(k + 1)]) <= target || next <= 1e-15 * beta_) return true;
    for (double& v : w) v /= next;
    return false;
  }
  /// Coefficients of the solution, one per column taken; ends the cycle.
  const std::vector<double>& coefficients() {
    for (int i = size_ - 1; i >= 0; --i) {  // back substitution
      for (int j = i + 1; j < size_; ++j) g_[u(i)] -= h(i, j) * g_[u(j)];
      g_[u(i)] /= h(i, i);
    }
    return g_;
  }

 private:
  static std::size_t u(int i) { return static_cast<std::size_t>(i); }
  double& h(int i, int j) { return H_[u(j * (restart_ + 1) + i)]; }
  void grow(int i) {
    if (basis_.size() == u(i)) basis_.emplace_back(n_);
  }

  int restart_, size_ = 0;
  std::size_t n_;
  double beta_ = 0.0;
  std::vector<Vector> basis_;
  std::vector<double> H_, cs_, sn_, g_;
};

/// Preconditioned from the right, restarted, for any A; x is the initial guess if `warm` and closer
/// than zero by its residual, else it starts from zero. Corrections are kept and applied as kept,
/// so the residual norm is that of b - A x itself. (Preconditioning their sum instead, as plain
/// GMRES does, leaves what rounding of the preconditioner makes of large coefficients that cancel.)
/// @tparam Kept         float or double, what corrections are kept in
/// @param apply         apply(in, out): out = A in
/// @param precondition  precondition(in, out): out about A^-1 in
/// @param restart       directions after which it begins anew; memory grows with those taken
/// @param gives_up      gives_up(iterations, residual over the first one): whether to leave it
/// there
template <typename Kept, typename Apply, typename Precondition>
KrylovResult flexible_gmres(Apply&& apply, Precondition&& precondition, const Vector& b, Vector& x,
                            bool warm, double tolerance, int max_iters, int restart, VectorOps& ops,
                            const std::function<bool(int, double)>& gives_up = {}) {
  const std::size_t n = b.size();
  KrylovResult result;
  Vector r(n), z(n);
  if (warm) {
    apply(x, r);
    for (std::size_t i = 0; i < n; ++i) r[i] = b[i] - r[i];
  }
  if (!warm || !(ops.norm(r) < ops.norm(b))) {
    x.assign(n, 0.0);
    r = b;
  }
  const double start = ops.norm(r);
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
      if (!done && gives_up && gives_up(result.num_iters, cycle.residual_norm() / start)) {
        max_iters = result.num_iters;
        done = true;
      }
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
