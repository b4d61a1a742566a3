// One grid cell cut by the plane of cell_plane.h, phi > 0 in the fluid.
#pragma once

#include <cmath>
#include <cstdint>

#include "kernels/stokes/cell_plane.h"

namespace diffsim {

/// What the flow needs to know of a cut cell: fluid volume and interface as weights of the 3^D
/// tensor Gauss points, normal, and the fluid share of its faces; with derivatives by (c, g).
template <int D>
struct CutCell {
  static constexpr int kPoints = pow3(D), kParameters = D + 1;
  static constexpr int kVolume = 0, kArea = kPoints, kNormal = 2 * kPoints;
  static constexpr int kFacet = kNormal + D, kAperture = kFacet + D, kSize = kAperture + 2 * D;

  // Volume [m^D], area [m^(D-1)], normal out of the fluid (of the wall and of the plane, which
  // FlowGeometry tells apart), apertures [-].
  double value[kSize];
  double jacobian[kSize][kParameters];

  const double* volume() const { return value + kVolume; }
  const double* area() const { return value + kArea; }
  const double* normal() const { return value + kNormal; }
  double aperture(int axis, int side) const { return value[kAperture + 2 * axis + side]; }

  CutCell(const CellPlane<D>& plane, const double* h) {
    using T = Dual<kParameters>;
    T out[kSize], g[D];
    const T c = T::parameter(plane.c, 0);
    for (int a = 0; a < D; ++a) g[a] = T::parameter(plane.g[a], 1 + a);
    double cell_volume = 1.0;
    T norm2(0.0);
    for (int a = 0; a < D; ++a) {
      cell_volume *= h[a];
      norm2 += g[a] * g[a] * (1.0 / (h[a] * h[a]));
    }
    const T norm = sqrt(norm2), scale = norm * cell_volume;  // dS = |grad phi| delta(phi) dV
    half_space_moments<D>(c, g, out + kVolume, out + kArea);
    for (int q = 0; q < kPoints; ++q) {
      out[kVolume + q] *= cell_volume;
      out[kArea + q] = out[kArea + q] * scale;
    }
    for (int a = 0; a < D; ++a) out[kNormal + a] = out[kFacet + a] = -g[a] * (1.0 / h[a]) / norm;
    for (int a = 0; a < D; ++a)
      for (int side = 0; side < 2; ++side) {
        T moments[pow3(D - 1)];
        face_moments(c, g, a, side, moments);
        T sum(0.0);
        for (const T& m : moments) sum += m;
        out[kAperture + 2 * a + side] = sum;
      }
    for (int k = 0; k < kSize; ++k) {
      value[k] = out[k].value;
      for (int i = 0; i < kParameters; ++i) jacobian[k][i] = out[k].grad[i];
    }
  }

  /// dL/dc and dL/dg, given dL/dvalue.
  void vjp(const double* grad_value, double* grad) const {
    for (int i = 0; i < kParameters; ++i) grad[i] = 0.0;
    for (int k = 0; k < kSize; ++k)
      for (int i = 0; i < kParameters; ++i) grad[i] += grad_value[k] * jacobian[k][i];
  }

  /// Rate of change of every value, given those of c and g.
  void tangent(const double* d_plane, double* d_value) const {
    for (int k = 0; k < kSize; ++k) {
      d_value[k] = 0.0;
      for (int i = 0; i < kParameters; ++i) d_value[k] += jacobian[k][i] * d_plane[i];
    }
  }

  /// Moments of the fluid part of a face in the unit square, (3^(D-1),).
  template <typename T>
  static void face_moments(const T& c, const T* g, int axis, int side, T* moments) {
    const T c_face = c + g[axis] * (side == 0 ? -0.5 : 0.5);
    T g_face[D > 1 ? D - 1 : 1], delta[pow3(D - 1)];
    double reach = 0.0, largest = 0.0;
    for (int a = 0, i = 0; a < D; ++a) {
      if (a != axis) {
        g_face[i++] = g[a];
        reach += 0.5 * std::abs(value_of(g[a]));
      }
      largest = std::max(largest, std::abs(value_of(g[a])));
    }
    const double at = value_of(c_face);
    // A plane parallel to the face either leaves it whole or covers it.
    const bool whole = reach < kParallel * largest ? at > 0.0 : at >= reach;
    const bool covered = reach < kParallel * largest ? at <= 0.0 : at <= -reach;
    if (!whole && !covered) return half_space_moments<D - 1>(c_face, g_face, moments, delta);
    for (int q = 0; q < pow3(D - 1); ++q) {
      double weight = whole ? 1.0 : 0.0;
      for (int rest = q, a = 0; a < D - 1; ++a, rest /= 3) weight *= kGauss3Weight[rest % 3];
      moments[q] = T(weight);
    }
  }
};

}  // namespace diffsim
