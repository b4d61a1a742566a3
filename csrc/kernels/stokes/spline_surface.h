// A tensor-product spline surface, rational or not: points and derivatives, one place at a time.
//
// Homogeneous coordinates are four numbers, one register, and stay so behind the division: a point
// is (x, y, z, 1) and a derivative (x, y, z, 0), both exactly, so that products of differences need
// not leave the fourth one out.
#pragma once

#include <cstdint>
#include <cstring>
#include <vector>

namespace diffsim {

constexpr int kMaxSplineDegree = 5;

using Four = double __attribute__((vector_size(32)));

inline double dot(Four a, Four b) {
  const Four c = a * b;
  return (c[0] + c[1]) + (c[2] + c[3]);
}

/// Spline functions of one parameter, as diffsim/stokes/shapes/spline_basis.py makes them.
struct SplineAxis {
  std::int64_t num = 0;  ///< functions
  int degree = 0;        ///< 1 to kMaxSplineDegree
  std::int64_t num_spans = 0;
  const double* breaks = nullptr;  ///< (num_spans + 1) knots, rising from 0 to 1
  /// (num_spans, degree + 1, degree + 1): of each active function the coefficients of x^k, x in
  /// [0, 1] on the span.
  const double* coefficients = nullptr;
  const std::int64_t* first = nullptr;  ///< (num_spans,) first active function; they wrap at num
  std::int64_t num_kinks = 0;
  const double* kinks = nullptr;  ///< rising in [0, 1): where the derivative may jump
  /// Parameters allowed: infinite where periodic; beyond 0 and 1 it goes on along the tangent.
  double low = 0.0, high = 1.0;
};

struct SplineSurface {
  SplineAxis axes[2];
  const double* homogeneous = nullptr;  ///< (nu, nv, 4): w x, w y, w z, w
};

/// A point and its derivatives.
struct SurfaceJet {
  Four s, su, sv, suu, suv, svv;
};

/// A surface laid out to be evaluated.
class SurfaceEvaluator {
 public:
  explicit SurfaceEvaluator(const SplineSurface& surface);

  SurfaceJet at(const double (&uv)[2]) const;
  const SplineAxis& axis(int k) const { return surface_.axes[k]; }

 private:
  static constexpr int kActive = 8;  // degree + 1 and zeros: two registers
  struct Basis {
    alignas(32) double of[3][kActive];  // value, first and second derivative
    std::int64_t first;
  };

  void basis(int k, double u, Basis& out) const;

  SplineSurface surface_;
  std::vector<double> powers_[2];  // (num_spans, degree + 1, kActive): the functions side by side
};

/// @param[in]  uv     (num_points, 2), within the range of the surface
/// @param[out] frames (num_points, 3, 3): S, S_u, S_v
void surface_frames(const SplineSurface& surface, const double* uv, std::int64_t num_points,
                    double* frames);

}  // namespace diffsim
