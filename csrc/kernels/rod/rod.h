// A slender rod in equilibrium under tendons and its own weight, described in
// diffsim/systems/rod/statics.py: what it is made of, and what is computed of it.
#pragma once

#include <array>
#include <cstdint>

namespace diffsim::rod {

constexpr int kMostSteps = 40;  ///< of Newton's method

/// The numbers of a rod of N elements, T tendons and P points, of which the first L are loads.
enum Field : int {
  kBending = 0,  ///< (N, 3) stiffness against twist and two bendings [N m^2]
  kStretch,      ///< (N, 3) against stretch and two shears [N]
  kRest,         ///< (N, 3) bending strain without loads [1/m]
  kStiffening,   ///< () growth of bending stiffness with (radius times bend)^2
  kWeight,       ///< (N, 3) of the elements [N]
  kLoads,        ///< (L, 3) weights at points [N]
  kPoints,       ///< (P, 3) offset of points in the frame of their section [m]
  kBase,         ///< (3, 3) rotation of the base
  kPlace,        ///< (3) of the base [m]
  kOffset,       ///< (T, N, 3) of the tendons from the axis [m]
  kSlope,        ///< (T, N, 3) change of that per arc length
  kShare,        ///< (T, N) of an element that a tendon runs through
  kPull,         ///< (T) tension at the base [N]
  kFriction,     ///< () of tendons around bends
  kWobble,       ///< () loss of tension per length [1/m]
  kRubber,       ///< () share by which pressed sections widen and stiffen as rubber does
  kNumFields
};

/// What all rods of a batch have in common.
struct Body {
  std::int64_t num_elements, num_tendons, num_loads, num_points;
  const double* edges;         ///< (N + 1) arc length at the ends of the elements [m]
  const double* radius;        ///< (N) at their middles [m]
  const double* point_at;      ///< (P) arc length of the points [m]
  const std::int64_t* around;  ///< (P) element around each
};

/// Where each field begins in the numbers of one rod.
std::array<std::int64_t, kNumFields + 1> field_places(const Body& body);

/// One field of a batch of (rows, columns) rods; an axis of length one is shared.
template <class Number>
struct Rows {
  Number* data = nullptr;
  std::int64_t rows = 1, columns = 1;
};
template <class Number>
using Fields = std::array<Rows<Number>, kNumFields>;

struct Batch {
  Body body;
  Fields<const double> fields;
  std::int64_t rows, columns;
  int num_threads;
};

struct Settings {
  double tolerance;    ///< turn of the last step, of all elements together [rad]
  bool from_straight;  ///< whether to come from no tension at once; else only where a guess fails
};

/// Equilibria.
/// @param[in]  start   (rows or 1, columns, N, 3) guess of twist and bends [1/m]
/// @param[out] strains (rows, columns, N, 3)
/// @param[out] places  (rows, columns, P, 3) of the points [m]
/// @param[out] turns   (rows, columns) turn of the last step [rad]; above the tolerance or NaN:
/// none
///                     was found
void solve(const Batch& batch, const Settings& settings, const Rows<const double>& start,
           double* strains, double* places, double* turns);

/// Adds dL/d(fields), from dL/d(strains, places) at equilibria.
void solve_vjp(const Batch& batch, const double* strains, const double* grad_strains,
               const double* grad_places, const Fields<double>& grads);

/// Strains and places along a direction of the fields, shaped as they are.
void solve_tangent(const Batch& batch, const Fields<const double>& directions,
                   const double* strains, double* d_strains, double* d_places);

/// What else is known of rods of given strains, in equilibrium or not.
/// @param[out] frames    (rows, columns, N + 1, 3, 3) rotations at the edges
/// @param[out] nodes     (rows, columns, N + 1, 3) places of the edges [m]
/// @param[out] stretches (rows, columns, N, 3) stretch and shears of the elements, 1 0 0 at rest
/// @param[out] tensions  (rows, columns, N, T) of the tendons at the middles [N]
/// @param[out] residual  (rows, columns, N, 3) moment that is left over [N m]
void survey(const Batch& batch, const double* strains, double* frames, double* nodes,
            double* stretches, double* tensions, double* residual);

}  // namespace diffsim::rod
