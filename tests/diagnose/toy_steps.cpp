// Steps of the toy oscillator, as `toy.py` has them in NumPy: what it simulates thousands of times.
// Built without fused products, so that all but tanh is the same to the last bit.

#include <cmath>

namespace {

struct Oscillator {
  double stiffness, damping, hard, drag, rub;

  double operator()(double x, double v, double f) const {
    double out = stiffness * (f - x) - damping * v;
    if (hard != 0.0) out = out - stiffness * hard * x * x * x;
    if (drag != 0.0) out = out - drag * std::abs(v) * v;
    if (rub != 0.0) out = out - rub * std::tanh(v / 0.02);
    return out;
  }
};

}  // namespace

/// Fourth order, pushes at the ends and in the middle of each step.
/// @param[in]  terms (points, 5) stiffness, damping, hard, drag, rub
/// @param[in]  push  (points, 2 steps + 1)
/// @param[out] xs,vs (points, steps + 1), from rest
extern "C" void rk4_steps(long points, long steps, double h, const double* terms,
                          const double* push, double* xs, double* vs) {
  for (long p = 0; p < points; ++p, terms += 5, ++xs, ++vs) {
    const Oscillator a{terms[0], terms[1], terms[2], terms[3], terms[4]};
    double x = *xs = 0.0, v = *vs = 0.0;
    for (long k = 0; k < steps; ++k, push += 2) {
      const double a0 = a(x, v, push[0]), v1 = v + 0.5 * h * a0;
      const double a1 = a(x + 0.5 * h * v, v1, push[1]), v2 = v + 0.5 * h * a1;
      const double a2 = a(x + 0.5 * h * v1, v2, push[1]), v3 = v + h * a2;
      const double a3 = a(x + h * v2, v3, push[2]);
      *++xs = x = x + h / 6 * (v + 2 * v1 + 2 * v2 + v3);
      *++vs = v = v + h / 6 * (a0 + 2 * a1 + 2 * a2 + a3);
    }
    ++push;
  }
}

/// Implicit Euler, `substeps` of them for each sample; a linear oscillator only.
/// @param[in] terms (points, 2) angular frequency, damping ratio; the others as above
extern "C" void implicit_steps(long points, long steps, long substeps, double h,
                               const double* terms, const double* push, double* xs, double* vs) {
  for (long p = 0; p < points; ++p, terms += 2, ++xs, ++vs) {
    const double w = terms[0], zeta = terms[1];
    double x = *xs = 0.0, v = *vs = 0.0;
    for (long k = 0; k < steps; ++k, push += 2) {
      for (long s = 1; s <= substeps; ++s) {
        const double share = static_cast<double>(s) / static_cast<double>(substeps);
        const double f = (1 - share) * push[0] + share * push[2];
        v = (v + h * w * w * (f - x)) / (1 + 2 * zeta * w * h + (w * h) * (w * h));
        x = x + h * v;
      }
      *++xs = x;
      *++vs = v;
    }
    ++push;
  }
}
