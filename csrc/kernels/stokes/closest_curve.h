// Closest points on a chain of rational Bezier curves in the plane: all minima, no start values.
//
// With W the weighted control polynomial, w the weights', x = W / w: the distance from p is
// stationary where g(t) = (W - p w).(W' w - W w') = 0, which is linear in p. Each curve is cut into
// parts, most of which their bounding discs discard. On a part the Bernstein coefficients of g are
// a - p.d, and intervals are bisected until they change sign once (Descartes: exactly one root) or
// not at all. Roots closer than 1e-8 of a part are taken for one.
#pragma once

#include <cstdint>

namespace diffsim {

/// Curves end to end; the parameter is curve + t, t in [0, 1].
struct CurveChain {
  std::int64_t num_curves = 0;
  int degree = 0;
  const double* homogeneous = nullptr;  ///< (num_curves, degree + 1, 3): w x, w y, w
  bool closed = false;                  ///< whether the last one ends where the first one starts
  double size = 1.0;                    ///< length scale [m]
  /// (2, 2) unit directions in which the chain goes on straight before its start and after its
  /// end; null: it does not. Parameters there are -s and num_curves + s, s [m].
  const double* rays = nullptr;
};

/// @param[in]  p      (num_points, 2) [m]
/// @param[out] tau    (num_points,) the smallest parameter of those equally near (1e-13 of the
/// size)
/// @param[out] normal (num_points, 2) unit normals on the left side; at corners, cusps and ends the
///                    direction to or from p, with the sign of the side on which p lies, so that
///                    normal.(p - x(tau)) is the signed distance
void closest_on_curves(const CurveChain& chain, const double* p, std::int64_t num_points,
                       double* tau, double* normal);

}  // namespace diffsim
