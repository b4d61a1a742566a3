// Hover thrusts: least effort within the thrust limits, with the attitude free to tilt.
//
// All quantities are dimensionless (diffsim/copter/dynamics/hover.py scales them): thrusts in
// shares of the weight per rotor, so that hovering is |F u| = 1 (the net thrust carries the weight
// once the vehicle has tilted so that it points up) and T u = 0:
//
//   min 1/2 sum h_i u_i^2   s.t.  c(u) = (|F u| - 1, T u) = 0,  0 <= u <= upper.
//
// Where no such thrusts exist, 1/2 sum h_i u_i^2 + |c(u)|^2 / (2 delta) is least, delta = 1e-6.
#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace diffsim {

/// Largest |c| of a hover, in shares of the weight.
constexpr double kFeasible = 1e-10;

/// Shapes as in a batch of one; everything row-major.
struct HoverProblem {
  int num_rotors;
  const double* force;    ///< F, (3, num_rotors)
  const double* torque;   ///< T, (3, num_rotors)
  const double* weights;  ///< h, (num_rotors,), > 0
  const double* upper;    ///< (num_rotors,), >= 0
  double barrier;         ///< weight of -log(u) - log(upper - u); 0: hard bounds
};

enum class HoverStatus : std::int64_t {
  kOptimal = 0,
  kInfeasible = 1,
  kRankDeficient = 2,  ///< hovers, but the free rotors do not command all of c
  kNotConverged = 3,
};

constexpr int kHoverInfo = 4;  ///< status, rank of dc/du, the same of free rotors, iterations

/// @param[out] u           (num_rotors,)
/// @param[out] multipliers (4,) of c; c(u) = delta * multipliers where there is no hover
/// @param[out] state       (num_rotors,) -1 at zero, +1 at upper, else 0
/// @param[out] info        (kHoverInfo,)
void solve_hover(const HoverProblem& problem, double* u, double* multipliers, std::int64_t* state,
                 std::int64_t* info);

/// dL/d(force, torque, weights, upper), given dL/du and the result of solve_hover. The set of
/// rotors at a bound is held; where dc/du of the free rotors lacks rank, the least-norm solution
/// counts.
void solve_hover_vjp(const HoverProblem& problem, const double* u, const double* multipliers,
                     const std::int64_t* state, const std::int64_t* info, const double* grad_u,
                     double* grad_force, double* grad_torque, double* grad_weights,
                     double* grad_upper);

/// A direction in the design, shapes as in HoverProblem.
struct HoverDirection {
  const double* force;
  const double* torque;
  const double* weights;
  const double* upper;
};

/// du along a direction: the transpose of solve_hover_vjp, with the same set of rotors at a bound.
/// @param[out] du  (num_rotors,)
void solve_hover_tangent(const HoverProblem& problem, const double* u, const double* multipliers,
                         const std::int64_t* state, const std::int64_t* info,
                         const HoverDirection& direction, double* du);

}  // namespace diffsim
