// The normal of a curved wall, averaged over the facet that stands for it in a cell.
//
// The facets of neighboring cells do not quite meet, and their normals differ from the wall's by up
// to h / radius. Fluid that slides along a wall as fast as elsewhere feels that: it is held where
// the wall is not, by an amount that changes as the facets do. So a slip wall takes its normal from
// slopes of the level set by cubics along the grid's lines, which converge with order two and
// change smoothly while the wall moves:
//   G = <grad phi> = sum_i m_i s_i,   m_i mean of the shape function N_i over the facet,
//   n = -b / |b|,  b = w G / |G| + (1 - w) g / |g|,
//   w = 1 / (1 + (V / (kKink |G|^2))^4),   V = <|grad phi|^2> - |G|^2,
// s_i the slopes at the corners, g the slope of the cell's plane. Where the slopes of the corners
// disagree (V large: an edge of the wall, another wall across a gap) the plane's normal stays.
#pragma once

#include <algorithm>
#include <cmath>

#include "kernels/stokes/dual.h"
#include "kernels/stokes/half_space.h"
#include "kernels/stokes/stokes_grid.h"

namespace diffsim {

/// Variance of the corners' slopes, relative to their mean, at which half of the plane's normal is
/// taken: a wall with a radius of three cells, or directions 20 degrees apart.
constexpr double kKink = 0.03;

/// Derivatives at node p of the polynomial through 2, 3 or 4 nodes in a row [1/h].
constexpr double kSlope2[2][4] = {{-1.0, 1.0}, {-1.0, 1.0}};
constexpr double kSlope3[3][4] = {{-1.5, 2.0, -0.5}, {-0.5, 0.0, 0.5}, {0.5, -2.0, 1.5}};
constexpr double kSlope4[4][4] = {{-11.0 / 6.0, 3.0, -1.5, 1.0 / 3.0},
                                  {-1.0 / 3.0, -0.5, 1.0, -1.0 / 6.0},
                                  {1.0 / 6.0, -1.0, 0.5, 1.0 / 3.0},
                                  {-1.0 / 3.0, 1.5, -3.0, 11.0 / 6.0}};

/// f(axis, node, weight [1/m]): the slope of a nodal field at a cell's corner, by the cubic through
/// the cell's nodes and one more on each side (inside the grid): no further, since other walls may
/// be near.
template <int D, typename F>
void for_slope(const StokesGrid<D>& grid, std::int64_t first_node, int corner, F&& f) {
  std::int64_t at[D];
  grid.node_position(first_node, at);
  for (int a = 0; a < D; ++a) {
    const std::int64_t count = std::min<std::int64_t>(4, grid.cells[a] + 1);
    const std::int64_t first =
        std::max<std::int64_t>(0, std::min(at[a] - 1, grid.cells[a] + 1 - count));
    const std::int64_t here = at[a] + StokesGrid<D>::corner_bit(corner, a) - first;
    const double* row = count == 4 ? kSlope4[here] : count == 3 ? kSlope3[here] : kSlope2[here];
    const std::int64_t node = first_node + grid.corner_offset[corner] - here * grid.node_stride[a];
    for (std::int64_t k = 0; k < count; ++k)
      f(a, node + k * grid.node_stride[a], row[k] / grid.h[a]);
  }
}

/// Multilinear shape function of a corner at a Gauss point of the cell.
template <int D>
double shape_value(int point, int corner) {
  double value = 1.0;
  for (int a = D - 1; a >= 0; --a, point /= 3) {
    const double x = kGauss3Point[point % 3];
    value *= StokesGrid<D>::corner_bit(corner, a) ? x : 1.0 - x;
  }
  return value;
}

/// Means of the shape functions over a facet, and their derivatives by its weights.
template <int D, typename T = double>
struct FacetMeans {
  static constexpr int kCorners = 1 << D, kPoints = pow3(D);
  T area = 0.0, value[kCorners] = {};

  /// @param weights (3^D,) of the facet, with a sum above zero
  explicit FacetMeans(const T* weights) {
    for (int q = 0; q < kPoints; ++q) {
      area += weights[q];
      for (int i = 0; i < kCorners; ++i) value[i] += weights[q] * shape_value<D>(q, i);
    }
    for (T& v : value) v = v / area;
  }
  /// @param[out] by_weights (3^D,), added to
  void vjp(const double* by_value, double* by_weights) const {
    for (int q = 0; q < kPoints; ++q)
      for (int i = 0; i < kCorners; ++i)
        by_weights[q] += by_value[i] * (shape_value<D>(q, i) - value[i]) / area;
  }
};

/// With T = Dual<1>: and the normal's derivative along one of phi, mean and plane.
template <int D, typename T = double>
class WallNormal {
 public:
  static constexpr int kCorners = 1 << D;

  /// @param phi   phi(node): level set
  /// @param mean  (2^D,) means of the shape functions over the facet
  /// @param plane (D,) normal of the cell's plane, out of the fluid
  template <typename Field>
  WallNormal(const StokesGrid<D>& grid, Field&& phi, std::int64_t first_node, const T* mean,
             const T* plane) {
    using std::sqrt;
    T square = 0.0;
    for (int i = 0; i < kCorners; ++i) {
      mean_[i] = mean[i];
      for (T& s : slope_[i]) s = 0.0;
      for_slope<D>(grid, first_node, i, [&](int a, std::int64_t node, double weight) {
        slope_[i][a] += weight * phi(node);
      });
      for (int a = 0; a < D; ++a) {
        average_[a] += mean[i] * slope_[i][a];
        square += mean[i] * slope_[i][a] * slope_[i][a];
      }
    }
    for (const T& s : average_) norm2_ += s * s;
    if (value_of(norm2_) > 0.0) {
      spread_ = (square - norm2_) / (kKink * norm2_);
      weight_ = 1.0 / (1.0 + spread_ * spread_ * spread_ * spread_);
    }
    T b2 = 0.0;
    for (int a = 0; a < D; ++a) {
      plane_[a] = -plane[a];
      blend_[a] = (1.0 - weight_) * plane_[a];
      if (value_of(weight_) > 0.0) blend_[a] += weight_ * average_[a] / sqrt(norm2_);
      b2 += blend_[a] * blend_[a];
    }
    length_ = sqrt(b2);
    for (T& b : blend_) b = b / length_;
  }

  void normal(T* n) const {
    for (int a = 0; a < D; ++a) n[a] = -blend_[a];
  }

  /// @param[in]  by_normal (D,) dL/dn
  /// @param[out] by_mean   (2^D,), by_plane (D,); overwritten
  /// @param[out] grad_phi  (num_nodes,), `sign` times dL/dphi through the slopes; added
  void vjp(const StokesGrid<D>& grid, std::int64_t first_node, const double* by_normal, double sign,
           double* by_mean, double* by_plane, double* grad_phi) const {
    double along = 0.0, by_blend[D];
    for (int a = 0; a < D; ++a) along += by_normal[a] * blend_[a];
    for (int a = 0; a < D; ++a) {
      by_blend[a] = -(by_normal[a] - along * blend_[a]) / length_;
      by_plane[a] = -(1.0 - weight_) * by_blend[a];
    }
    for (int i = 0; i < kCorners; ++i) by_mean[i] = 0.0;
    if (!(weight_ > 0.0)) return;
    const double norm = std::sqrt(norm2_);
    double by_weight = 0.0, radial = 0.0;
    for (int a = 0; a < D; ++a) {
      by_weight += by_blend[a] * (average_[a] / norm - plane_[a]);
      radial += weight_ * by_blend[a] * average_[a] / norm;
    }
    const double by_spread =
        -4.0 * spread_ * spread_ * spread_ * weight_ * weight_ * by_weight / (kKink * norm2_);
    const double by_norm2 = -by_spread * (1.0 + kKink * spread_);
    double by_average[D];
    for (int a = 0; a < D; ++a)
      by_average[a] = (weight_ * by_blend[a] - radial * average_[a] / norm) / norm +
                      2.0 * by_norm2 * average_[a];
    for (int i = 0; i < kCorners; ++i) {
      double by_slope[D];
      for (int a = 0; a < D; ++a) {
        by_mean[i] += (by_average[a] + by_spread * slope_[i][a]) * slope_[i][a];
        by_slope[a] = mean_[i] * (by_average[a] + 2.0 * by_spread * slope_[i][a]);
      }
      for_slope<D>(grid, first_node, i, [&](int a, std::int64_t node, double weight) {
        grad_phi[node] += sign * weight * by_slope[a];
      });
    }
  }

 private:
  T mean_[kCorners], slope_[kCorners][D];
  T average_[D] = {}, norm2_ = 0.0;  // G, |G|^2
  T spread_ = 0.0, weight_ = 0.0;    // V / (kKink |G|^2), w
  T plane_[D], blend_[D], length_;   // g / |g|, b / |b|, |b|
};

}  // namespace diffsim
