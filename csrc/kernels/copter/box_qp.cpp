#include "kernels/copter/box_qp.h"

#include <cmath>

#include "kernels/linalg/dense.h"

namespace diffsim {
namespace {

std::vector<int> free_indices(const std::vector<BoundState>& state) {
  std::vector<int> index;
  for (int i = 0; i < static_cast<int>(state.size()); ++i)
    if (state[i] == BoundState::kFree) index.push_back(i);
  return index;
}

/// Minimizer over the free unknowns, the others as they are.
Eigen::VectorXd free_minimizer(const Eigen::MatrixXd& G, const Eigen::VectorXd& q,
                               const Eigen::VectorXd& u, const std::vector<int>& free) {
  Eigen::VectorXd fixed = u;
  for (const int i : free) fixed[i] = 0.0;
  const Eigen::VectorXd rhs = q - dense::apply(G, fixed);
  const int m = static_cast<int>(free.size());
  Eigen::MatrixXd own(m, m);
  Eigen::VectorXd right(m);
  for (int j = 0; j < m; ++j) {
    right[j] = rhs[free[j]];
    for (int i = 0; i < m; ++i) own(i, j) = G(free[i], free[j]);
  }
  return dense::solve_positive(own, right);
}

/// The free unknown whose bound ends the step first, or -1; `length` becomes the step allowed.
int first_blocked(const Eigen::VectorXd& u, const Eigen::VectorXd& goal,
                  const Eigen::VectorXd& upper, const std::vector<int>& free, double& length) {
  int blocked = -1;
  length = 1.0;
  for (std::size_t k = 0; k < free.size(); ++k) {
    const int i = free[k];
    const double step = goal[k] - u[i];
    const double room = step < 0.0 ? u[i] : upper[i] - u[i];
    if (std::abs(step) > room && room < length * std::abs(step)) {
      length = room / std::abs(step);
      blocked = static_cast<int>(k);
    }
  }
  return blocked;
}

/// The bound whose multiplier is most wrong, or -1.
int most_wrong(const Eigen::VectorXd& gradient, const Eigen::VectorXd& upper,
               const std::vector<BoundState>& state) {
  int worst = -1;
  double most = 1e-13 * (1.0 + gradient.lpNorm<Eigen::Infinity>());
  for (int i = 0; i < gradient.size(); ++i) {
    if (state[i] == BoundState::kFree || upper[i] == 0.0) continue;
    const double wrong = state[i] == BoundState::kLower ? -gradient[i] : gradient[i];
    if (wrong > most) {
      most = wrong;
      worst = i;
    }
  }
  return worst;
}

}  // namespace

bool solve_box_qp(const Eigen::MatrixXd& G, const Eigen::VectorXd& q, const Eigen::VectorXd& upper,
                  Eigen::VectorXd& u, std::vector<BoundState>& state) {
  const int n = static_cast<int>(u.size());
  for (int iter = 0; iter < 50 + 20 * n; ++iter) {
    const std::vector<int> free = free_indices(state);
    if (!free.empty()) {
      const Eigen::VectorXd goal = free_minimizer(G, q, u, free);
      if (!goal.allFinite()) return false;
      double length;
      const int blocked = first_blocked(u, goal, upper, free, length);
      for (std::size_t k = 0; k < free.size(); ++k) u[free[k]] += length * (goal[k] - u[free[k]]);
      if (blocked >= 0) {
        const int i = free[blocked];
        const bool low = goal[blocked] < 0.0;
        u[i] = low ? 0.0 : upper[i];
        state[i] = low ? BoundState::kLower : BoundState::kUpper;
        continue;
      }
    }
    const int release = most_wrong(dense::apply(G, u) - q, upper, state);
    if (release < 0) return true;
    state[release] = BoundState::kFree;
  }
  return false;
}

}  // namespace diffsim
