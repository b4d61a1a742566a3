// The tangent of a small body, added to its matrix as small_cholesky.h has it: no rows, no export.
#pragma once

#include "kernels/linalg/small_cholesky.h"
#include "kernels/soft/elasticity.h"

namespace diffsim {

/// Where a block of an element's matrix goes, and between which local nodes it is: as it lies
/// there, and the lower one first.
struct SmallPlace {
  std::int32_t block;
  std::int8_t row, column;
  std::int8_t first, second;
};
/// Those of all elements, (num_elements, pairs of local nodes).
struct SmallPlaces {
  std::vector<SmallPlace> solid, fiber;
};
SmallPlaces small_places(const SoftModel& model, const SmallPattern& pattern);

/// Adds d^2(E + D)/dx^2 [N/m], not clamped; pressures are not part of it.
void add_small_tangent(const SoftModel& model, const SoftParameters& parameters,
                       const DampingFrames& frames, const double* x, const SmallPlaces& places,
                       ElasticityScratch& scratch, SmallCholesky& to);

}  // namespace diffsim
