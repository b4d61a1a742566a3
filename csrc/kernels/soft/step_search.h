// What the minimizers of a step share: how it begins, line search, and L-BFGS.
#pragma once

#include <deque>

#include "kernels/soft/step_problem.h"

namespace diffsim {

/// Residual, scale and tolerance at the start of a step.
/// @param[in] gradient  of the problem there, on free unknowns
/// @param[in] rounding  norm below which the gradient is rounding
StepStats begin_stats(StepProblem& problem, const StepOptions& options, const Vector& gradient,
                      double rounding);

/// Backtracks along d until the energy falls enough, or the slope where that says no more
/// (descent.h); updates x, value and gradient. False where nothing was gained: x is what it was.
bool line_search(StepProblem& problem, const Vector& d, double slope, Vector& x, double& value,
                 Vector& gradient);

/// L-BFGS whose initial inverse Hessian is the preconditioner: on the constant factor, A^-1 (Liu et
/// al. 2017).
class QuasiNewton {
 public:
  explicit QuasiNewton(StepProblem& problem) : problem_(problem) {}

  void direction(const Vector& gradient, Vector& d) {
    Vector q = gradient;
    begin(q);
    problem_.precondition(q, d);
    finish(d);
  }

  /// The first loop over the pairs: q becomes what the initial inverse Hessian is applied to.
  void begin(Vector& q) {
    alpha_.resize(pairs_.size());
    for (std::size_t k = pairs_.size(); k-- > 0;) {
      alpha_[k] = problem_.ops().dot(pairs_[k].s, q) / pairs_[k].sy;
      problem_.ops().add(-alpha_[k], pairs_[k].y, q);
    }
  }
  /// The second one: d, the product with it, becomes the direction.
  void finish(Vector& d) {
    VectorOps& ops = problem_.ops();
    for (std::size_t k = 0; k < pairs_.size(); ++k)
      ops.add(alpha_[k] - ops.dot(pairs_[k].y, d) / pairs_[k].sy, pairs_[k].s, d);
    for (double& v : d) v = -v;
  }

  void update(const Vector& x_old, const Vector& g_old, const Vector& x, const Vector& g) {
    Pair pair{x, g, 0.0};
    problem_.ops().add(-1.0, x_old, pair.s);
    problem_.ops().add(-1.0, g_old, pair.y);
    pair.sy = problem_.ops().dot(pair.s, pair.y);
    // A pair without positive curvature would make the update indefinite.
    if (!(pair.sy > kLeastCurvature * problem_.ops().norm(pair.s) * problem_.ops().norm(pair.y)))
      return;
    if (pairs_.size() == kHistory) pairs_.pop_front();
    pairs_.push_back(std::move(pair));
  }

  void forget() { pairs_.clear(); }

 private:
  struct Pair {
    Vector s, y;
    double sy;
  };
  // Pairs that are kept, and the least cosine of the angle between their members.
  static constexpr std::size_t kHistory = 10;
  static constexpr double kLeastCurvature = 1e-14;

  StepProblem& problem_;
  std::deque<Pair> pairs_;
  std::vector<double> alpha_;
};

}  // namespace diffsim
