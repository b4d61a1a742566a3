// Forward-mode dual numbers: a value and its derivatives by N parameters.
#pragma once

#include <cmath>

namespace diffsim {

template <int N>
struct Dual {
  double value = 0.0;
  double grad[N] = {};

  Dual() = default;
  Dual(double v) : value(v) {}  // NOLINT(google-explicit-constructor): constants mix freely
  static Dual parameter(double v, int index) {
    Dual x(v);
    x.grad[index] = 1.0;
    return x;
  }

  Dual& operator+=(const Dual& b) {
    value += b.value;
    for (int i = 0; i < N; ++i) grad[i] += b.grad[i];
    return *this;
  }
  Dual& operator-=(const Dual& b) {
    value -= b.value;
    for (int i = 0; i < N; ++i) grad[i] -= b.grad[i];
    return *this;
  }
  Dual& operator*=(double s) {
    value *= s;
    for (int i = 0; i < N; ++i) grad[i] *= s;
    return *this;
  }

  friend Dual operator+(Dual a, const Dual& b) { return a += b; }
  friend Dual operator-(Dual a, const Dual& b) { return a -= b; }
  friend Dual operator-(Dual a) { return a *= -1.0; }
  friend Dual operator*(Dual a, double s) { return a *= s; }
  friend Dual operator*(double s, Dual a) { return a *= s; }
  friend Dual operator*(const Dual& a, const Dual& b) {
    Dual c(a.value * b.value);
    for (int i = 0; i < N; ++i) c.grad[i] = a.grad[i] * b.value + a.value * b.grad[i];
    return c;
  }
  friend Dual operator/(const Dual& a, const Dual& b) {
    const double inverse = 1.0 / b.value;
    Dual c(a.value * inverse);
    for (int i = 0; i < N; ++i) c.grad[i] = (a.grad[i] - c.value * b.grad[i]) * inverse;
    return c;
  }
  friend Dual sqrt(const Dual& a) {
    Dual c(std::sqrt(a.value));
    for (int i = 0; i < N; ++i) c.grad[i] = 0.5 * a.grad[i] / c.value;
    return c;
  }
};

inline double value_of(double x) { return x; }
template <int N>
double value_of(const Dual<N>& x) {
  return x.value;
}

}  // namespace diffsim
