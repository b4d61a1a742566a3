// Lanes that carry their derivative along one direction: the forward mode of a flight.
#pragma once

#include "kernels/copter/flight_step.h"

namespace diffsim::flight {

/// A number and its rate along a direction.
struct Moving {
  V value = {}, rate = {};

  Moving& operator+=(const Moving& b) {
    value += b.value;
    rate += b.rate;
    return *this;
  }
  Moving& operator-=(const Moving& b) {
    value -= b.value;
    rate -= b.rate;
    return *this;
  }
  Moving& operator+=(double b) {
    value += b;
    return *this;
  }
  Moving& operator*=(const Moving& b) { return *this = *this * b; }

  friend Moving operator-(const Moving& a) { return {-a.value, -a.rate}; }
  friend Moving operator+(Moving a, const Moving& b) { return a += b; }
  friend Moving operator-(Moving a, const Moving& b) { return a -= b; }
  friend Moving operator-(double a, const Moving& b) { return {a - b.value, -b.rate}; }
  friend Moving operator*(const Moving& a, const Moving& b) {
    return {a.value * b.value, a.rate * b.value + a.value * b.rate};
  }
  friend Moving operator*(double a, const Moving& b) { return {a * b.value, a * b.rate}; }
  friend Moving operator/(const Moving& a, const Moving& b) {
    const V value = a.value / b.value;
    return {value, (a.rate - value * b.rate) / b.value};
  }
  friend Moving operator/(double a, const Moving& b) {
    const V value = a / b.value;
    return {value, -value * b.rate / b.value};
  }
};

template <>
inline Moving constant<Moving>(double value) {
  return {broadcast<V>(value), V{}};
}

/// The root; at zero its rate counts as zero, as in the adjoint.
inline Moving sqrt(const Moving& a) {
  const V root = diffsim::sqrt<V>(a.value);
  return {root, ratio(0.5 * a.rate, root)};
}
/// The larger and the smaller; of equal ones the first.
inline Moving max(const Moving& a, const Moving& b) {
  const MaskOf<V> second = less(a.value, b.value);
  return {select<V>(second, b.value, a.value), select<V>(second, b.rate, a.rate)};
}
inline Moving min(const Moving& a, const Moving& b) {
  const MaskOf<V> second = greater(a.value, b.value);
  return {select<V>(second, b.value, a.value), select<V>(second, b.rate, a.rate)};
}
inline Moving power(const Moving& a, const Moving& e) {
  const V value = power(a.value, e.value);
  return {value, e.value * ratio(value, a.value) * a.rate + value * logarithm(a.value) * e.rate};
}
inline Moving angle(const Moving& y, const Moving& x) {
  const V scale = 1.0 / (x.value * x.value + y.value * y.value);
  return {angle(y.value, x.value), scale * (x.value * y.rate - y.value * x.rate)};
}
inline Moving wrapped(const Moving& a) { return {wrapped(a.value), a.rate}; }

/// Rows of the inputs and of a direction in them.
struct MovingRows {
  using Value = Moving;
  const FlightInputs& inputs;
  const FlightInputs& directions;
  const Crew& crew;
  void load(FlightRows FlightInputs::* which, std::int64_t step, int width, Moving* out) const {
    std::vector<V> values(static_cast<std::size_t>(width)), rates(values.size());
    load_row(inputs.*which, crew, step, width, values.data());
    load_row(directions.*which, crew, step, width, rates.data());
    for (std::size_t k = 0; k < values.size(); ++k) out[k] = {values[k], rates[k]};
  }
};

}  // namespace diffsim::flight
