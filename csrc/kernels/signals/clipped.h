// Values between two limits, as numpy has them.
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

}  // namespace diffsim
