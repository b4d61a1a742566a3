// The tangents of small bodies in lanes (lane_cholesky.h): no rows, no export.
#pragma once

#include "kernels/linalg/lane_cholesky.h"
#include "kernels/soft/elasticity.h"

namespace diffsim {

/// Where the blocks of the elements' matrices go, (num_elements, pairs of local nodes a <= b);
/// complemented where a block goes there transposed.
struct LanePlaces {
  std::vector<std::int32_t> solid, fiber;
};
LanePlaces lane_places(const SoftModel& model, const LanePattern& pattern);

/// Of whom a tangent is asked, and where; nothing where x is null.
struct LaneTangent {
  SoftParameters parameters;
  const std::vector<DampingFrame>* frames = nullptr;
  const double* x = nullptr;
  ElasticityScratch* scratch = nullptr;
};

/// Adds d^2(E + D)/dx^2 [N/m] of each member to its lane, not clamped; pressures are not part of
/// it.
void add_lane_tangents(const SoftModel& model, const std::vector<LaneTangent>& members,
                       const LanePlaces& places, LaneCholesky& to);

}  // namespace diffsim
