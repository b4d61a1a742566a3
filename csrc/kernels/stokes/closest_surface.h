// Closest points on a tensor-product spline surface: nearest samples, then Newton from each sheet.
//
// f(u, v) = |S(u, v) - p|^2 / 2; Newton with the absolute eigenvalues of its Hessian, steps
// shortened until f falls, parameters held in their range and, at first, within a piece without
// kinks. Held at a kink, the search goes on beyond it.
#pragma once

#include <cstdint>

#include "kernels/parallel.h"
#include "kernels/stokes/spline_surface.h"

namespace diffsim {

/// Points of a surface on a grid of parameters; sample i * num[1] + j.
struct SurfaceSamples {
  std::int64_t num[2] = {0, 0};
  const double* uv = nullptr;      ///< (num[0] num[1], 2)
  const double* points = nullptr;  ///< (num[0] num[1], 3), finite
  double gap = 0.0;                ///< greatest distance of two neighbors [m]
};

/// The same bits with any number of threads.
///
/// @param[in]  p     (num_points, 3) [m]
/// @param[in]  band  distance beyond which the nearest sample stands for the closest point [m]
/// @param[out] uv    (num_points, 2)
/// @param[out] slope (num_points,) how far each is from stationary: the cosine between S - p and
///                   the surface there, 0 where held at the end of the range or not refined
void closest_on_surface(const SplineSurface& surface, const SurfaceSamples& samples,
                        const double* p, std::int64_t num_points, double band, double* uv,
                        double* slope, ThreadPool& pool);

}  // namespace diffsim
