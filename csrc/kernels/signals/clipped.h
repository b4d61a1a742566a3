// A value between two limits, and its slopes.
#pragma once

#include <algorithm>
#include <cmath>

namespace diffsim {

/// numpy's minimum of a maximum: a bound that is not a number is the answer.
inline double clipped(double value, double low, double high) {
  const double sum = low + high;
  if (std::isnan(sum)) return sum;
  return std::min(std::max(value, low), high);
}

/// Slopes of `clipped`; where two are equal each has half, as central differences have it.
struct Shares {
  double value, low, high;
};

inline Shares shares(double value, double low, double high) {
  const double sum = low + high;
  if (std::isnan(sum)) return {sum, sum, sum};
  const auto above = [](double a, double b) { return a > b ? 1.0 : (a < b ? 0.0 : 0.5); };
  const double of_low = above(low, value), of_high = above(std::max(value, low), high);
  return {(1.0 - of_high) * (1.0 - of_low), (1.0 - of_high) * of_low, of_high};
}

}  // namespace diffsim
