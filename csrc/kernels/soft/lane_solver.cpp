#include "kernels/soft/lane_solver.h"

namespace diffsim {
namespace {

// Solves with one factor. The first leaves rounding times the condition; refinement takes that of
// the positions at most, or never ends.
constexpr int kMostSolves = 5;

}  // namespace

void LaneSolver::assemble(const std::vector<LanePoint>& points) {
  static const std::vector<DampingFrame> kNone;
  std::vector<LaneTangent> tangents;
  for (const LanePoint& point : points) {
    tangents.emplace_back();
    tangents.back().frames = &kNone;
    if (point.problem) tangents.back() = point.problem->lane_tangent(*point.x);
  }
  add_lane_tangents(system_.model(), tangents, tables().places, memory_->matrices);
  for (std::size_t l = 0; l < points.size(); ++l)
    if (points[l].problem)
      points[l].problem->add_inertia(tables(), memory_->matrices, static_cast<int>(l));
}

void LaneSolver::solve_refined(std::vector<LaneSystem>& systems, unsigned definite,
                               VectorOps& ops) {
  const auto each = [&](auto&& f) {
    for (std::size_t l = 0; l < systems.size(); ++l)
      if (systems[l].is_active()) f(systems[l], static_cast<int>(l));
  };
  const auto is_active = [](const LaneSystem& s) { return s.is_active(); };
  for (std::size_t l = 0; l < systems.size(); ++l) {
    LaneSystem& s = systems[l];
    s.residual = s.b;
    s.z.assign(s.b.size(), 0.0);
    s.product.assign(s.b.size(), 0.0);
    s.result = {};
    s.result.residual_norm = ops.norm(s.b);
    s.result.converged = s.result.residual_norm <= s.tolerance;
    s.result.negative_curvature = !(definite >> l & 1u);
  }
  for (int k = 0; k < kMostSolves; ++k) {
    if (std::none_of(systems.begin(), systems.end(), is_active)) return;
    each([&](LaneSystem& s, int lane) { put(s.residual, lane); });
    solve();
    each([&](LaneSystem& s, int lane) {
      get(lane, s.residual);
      ops.add(1.0, s.residual, s.z);
      put(s.z, lane);
    });
    multiply();
    each([&](LaneSystem& s, int lane) {
      get_product(lane, s.product);
      s.residual = s.b;
      for (std::size_t i = 0; i < s.b.size(); ++i)
        s.residual[i] = system_.fixed()[i] ? 0.0 : s.b[i] - s.product[i];
      s.result.residual_norm = ops.norm(s.residual);
      s.result.converged = s.result.residual_norm <= s.tolerance;
      ++s.result.num_iters;
    });
  }
}

}  // namespace diffsim
