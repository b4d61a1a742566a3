// The tangent of a small body as one lane of several (lane_cholesky.h): no rows, no export.
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

/// Adds d^2(E + D)/dx^2 [N/m] to one lane, not clamped; pressures are not part of it.
void tangent_in_lane(const SoftModel& model, const SoftParameters& parameters,
                     const std::vector<DampingFrame>& frames, const double* x,
                     const LanePlaces& places, ElasticityScratch& scratch, LaneCholesky& to,
                     int lane);

}  // namespace diffsim
