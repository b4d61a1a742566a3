#include "kernels/soft/small_solver.h"

namespace diffsim {
namespace {

// Solves with one factor. The first leaves rounding times the condition; refinement takes that of
// the positions at most, or never ends.
constexpr int kMostSolves = 5;

}  // namespace

void SmallSolver::solve_refined(SmallSystem& s, VectorOps& ops) {
  Vector residual = s.b;
  s.z.assign(s.b.size(), 0.0);
  s.product.assign(s.b.size(), 0.0);
  s.result = {};
  s.result.residual_norm = ops.norm(s.b);
  s.result.converged = s.result.residual_norm <= s.tolerance;
  s.result.negative_curvature = !factor();
  while (!s.result.converged && !s.result.negative_curvature && s.result.num_iters < kMostSolves) {
    solve(residual, residual);
    ops.add(1.0, residual, s.z);
    multiply(s.z, s.product);
    for (std::size_t i = 0; i < s.b.size(); ++i)
      residual[i] = system_.fixed()[i] ? 0.0 : s.b[i] - s.product[i];
    s.result.residual_norm = ops.norm(residual);
    s.result.converged = s.result.residual_norm <= s.tolerance;
    ++s.result.num_iters;
  }
}

}  // namespace diffsim
