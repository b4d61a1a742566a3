// What the minimizers of a step, with contact and without, count as progress.
#pragma once

#include <algorithm>

namespace diffsim {

// Decrease that a step must keep of what its slope promises (Armijo's condition; Nocedal and Wright
// 2006, eq. 3.4, c_1).
constexpr double kArmijo = 1e-4;
// Rounding of the energy, of the magnitude of its terms: some 50 epsilon, for sums over elements.
// Differences below it count as descent, else the last digits could not be reached.
constexpr double kEnergyRounding = 1e-14;
// Near rest the energy w/2 (s - 1)^2 loses its digits to s - 1 long before its gradient does. Where
// it rises by less than this of its magnitude, the slope decides: it must have fallen to the second
// factor of its start (approximate Wolfe condition, Hager and Zhang 2005, eq. 4.1: epsilon, sigma).
constexpr double kFlatEnergy = 1e-6;
constexpr double kWolfe = 0.9;

// Iterations in a row that do not lower a residual below its rounding: there rounding decides from
// here on. Above it a step may converge later (14 of 500 random scenes in contact did).
constexpr int kMaxStalled = 20;

/// Relative accuracy of an inexact Newton step's linear solve (Eisenstat and Walker 1996, choice 2
/// with gamma = 0.9 and alpha = 2), at most 0.1.
/// @param last_norm  residual norm one step before, zero where there was none
inline double forcing_term(double norm, double last_norm) {
  constexpr double kGamma = 0.9, kLargest = 0.1;
  if (!(last_norm > 0.0)) return kLargest;
  const double ratio = norm / last_norm;
  return std::min(kLargest, kGamma * ratio * ratio);
}

}  // namespace diffsim
