// A point that goes to a signal with its acceleration limited, braking in time to stop there.
#pragma once

#include <cstdint>

namespace diffsim {

/// What each row of points goes through.
///
/// It begins at rest at the first target. Targets are `held` until the next time, or straight
/// between times; each step is divided into parts.
struct Approach {
  std::int64_t num_rows, num_times;
  const double* targets;  ///< (num_rows, num_times)
  const double* steps;    ///< (num_times - 1) [s]
  const double* most;     ///< (num_rows) largest acceleration
  const double* fastest;  ///< (num_rows) largest speed
  bool held;
};

/// @param[out] places  (num_rows, num_times)
void approach(const Approach& given, double* places);

/// dL/d(targets, most, fastest) from dL/d(places).
///
/// Where two limits hold at once the slope is that of one of them.
/// @param[out] grad_targets  (num_rows, num_times)
/// @param[out] grad_most, grad_fastest  (num_rows)
void approach_vjp(const Approach& given, const double* grad_places, double* grad_targets,
                  double* grad_most, double* grad_fastest);

/// Places along one direction of targets, most and fastest.
/// @param[out] d_places  (num_rows, num_times)
void approach_tangent(const Approach& given, const double* d_targets, const double* d_most,
                      const double* d_fastest, double* d_places);

}  // namespace diffsim
