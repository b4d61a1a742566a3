// The plane that stands for the wall in a grid cell: phi(xi) = c + sum_a g_a (xi_a - 1/2), xi in
// [0, 1]^D, phi > 0 in the fluid.
//
// Least squares (in 3D): the fit to the 2^D corner values; c is their
// mean, g_a the mean difference along axis a. On a face the mean of phi is that of its corners,
// whatever the cell, so that neighboring planes agree at the middle of their common face.
//
// Chord (in 2D): the line through the places where the wall crosses the cell's edges,
//   p(t) = f_0 + t (f_1 - f_0) + w t (t - 1) (K / 2 + T (t + 1) / 6) = 0,
// p the cubic through the edge's ends and one more node on each side, K and T its second and third
// difference. Neighbors share these places: the fluid of one cell ends on their face where that of
// the other does. Else a constant pressure drives fluid along a slip wall. At a kink of the level
// set, w = 1 / (1 + (T^2 / (kRough sum of squared first differences))^2) makes the edge straight.
// Where two diagonal corners are fluid there is no such line; the least squares fit stays, reached
// smoothly as the smallest of the corners grows.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "kernels/stokes/half_space.h"
#include "kernels/stokes/stokes_grid.h"

namespace diffsim {

enum class CellKind : std::uint8_t { kEmpty, kCut, kFull };

/// Squared third difference over squared first differences at which half of the cubic is taken.
constexpr double kRough = 0.05;

template <int D, typename T = double>
struct CellPlane {
  T c = 0.0, g[D] = {};

  /// Least squares. @param phi (2^D,) corner values; bit D-1-a is the position along axis a
  explicit CellPlane(const T* phi) {
    for (int i = 0; i < 1 << D; ++i) {
      c += phi[i] * (1.0 / (1 << D));
      for (int a = 0; a < D; ++a)
        g[a] += phi[i] * (((i >> (D - 1 - a)) & 1 ? 1.0 : -1.0) / (1 << (D - 1)));
    }
  }

  CellKind kind() const {
    double reach = 0.0;
    for (const T& s : g) reach += 0.5 * std::abs(value_of(s));
    if (value_of(c) - reach > kOnFace * reach) return CellKind::kFull;
    return value_of(c) + reach > kOnFace * reach ? CellKind::kCut : CellKind::kEmpty;
  }
};

/// Where a level set is zero between two nodes of a row.
template <typename T>
class EdgeCrossing {
 public:
  /// @param row (4,) nodes in a row, or (2,) where the row has fewer: the edge is straight then
  /// @param at  position of the first end in `row`; the other one is at + step, of opposite sign
  EdgeCrossing(const T* row, int count, int at, int step) {
    first_ = row[at];
    rise_ = row[at + step] - first_;
    if (count == 4) {
      // Newton's form wants the node before the first end; where the row ends there, that after
      // the other end, and one more.
      const int before = at - step;
      const bool inside = before >= 0 && before < 4;
      const int third = inside ? before : at + 2 * step;
      const int far = at + 2 * step, fourth = inside && far >= 0 && far < 4 ? far
                                              : inside                      ? at - 2 * step
                                                                            : at + 3 * step;
      const double a = (third - at) * step, b = (fourth - at) * step;
      // Divided differences of t (t - 1) and t (t - 1) (t - a).
      const T k3 = (row[third] - first_ - rise_ * a) * (1.0 / (a * (a - 1.0)));
      const T k4 = (row[fourth] - first_ - rise_ * b) * (1.0 / (b * (b - 1.0)));
      bend_ = k3;
      twist_ = (k4 - k3) * (1.0 / (b - a));
      place_ = a;
      T square = 0.0;
      for (int i = 0; i < 3; ++i) square += (row[i + 1] - row[i]) * (row[i + 1] - row[i]);
      T weight = 0.0;  // where squares underflow, the edge is straight
      if (value_of(square) > 0.0) {
        const T rough = 36.0 * twist_ * twist_ / (kRough * square);
        weight = T(1.0) / (1.0 + rough * rough);
      }
      bend_ = bend_ * weight;
      twist_ = twist_ * weight;
    }
    solve();
  }

  /// Distance from the first end [edge's length].
  const T& place() const { return t_; }
  /// What phi falls by from the first end to the crossing, over that distance.
  T fall() const { return -(rise_ + (t_ - 1.0) * (bend_ + twist_ * (t_ - place_))); }

 private:
  void solve() {
    const double f0 = value_of(first_), rise = value_of(rise_), bend = value_of(bend_),
                 twist = value_of(twist_);
    const auto value = [&](double t) {
      return f0 + t * (rise + (t - 1.0) * (bend + twist * (t - place_)));
    };
    const auto slope = [&](double t) {
      return rise + (2.0 * t - 1.0) * bend +
             twist * ((2.0 * t - 1.0) * (t - place_) + t * (t - 1.0));
    };
    double low = 0.0, high = 1.0, t = std::clamp(-f0 / rise, 0.0, 1.0);
    for (int i = 0; i < 60; ++i) {
      const double f = value(t);
      if (f == 0.0) break;
      ((f > 0.0) == (f0 > 0.0) ? low : high) = t;
      double next = t - f / slope(t);
      if (!(next > low && next < high)) next = 0.5 * (low + high);
      if (next == t || next == low || next == high) break;
      t = next;
    }
    // One step of Newton's method from the root: the value stays, the derivative is exact.
    const T tt(t);
    const T rest = first_ + tt * (rise_ + (tt - 1.0) * (bend_ + twist_ * (tt - place_)));
    double s = slope(t);
    if (!(std::abs(s) > 1e-6 * std::abs(rise))) s = rise;  // touches rather than crosses
    t_ = tt - (rest - value_of(rest)) * (1.0 / s);
  }

  T first_, rise_, bend_ = 0.0, twist_ = 0.0, t_ = 0.0;
  double place_ = 0.0;
};

/// The nodes that a cell's chord depends on: up to four per axis, inside the grid.
struct ChordPatch {
  static constexpr int kNodes = 16;
  std::int64_t first[2], count[2];
  int at[2];  // position of the cell's first node

  ChordPatch(const StokesGrid<2>& grid, const std::int64_t* cell) {
    for (int a = 0; a < 2; ++a) {
      count[a] = std::min<std::int64_t>(4, grid.cells[a] + 1);
      first[a] = std::max<std::int64_t>(0, std::min(cell[a] - 1, grid.cells[a] + 1 - count[a]));
      at[a] = static_cast<int>(cell[a] - first[a]);
    }
  }
  /// f(node, index)
  template <typename F>
  void for_nodes(const StokesGrid<2>& grid, F&& f) const {
    for (std::int64_t i = 0; i < count[0]; ++i)
      for (std::int64_t j = 0; j < count[1]; ++j)
        f((first[0] + i) * grid.node_stride[0] + first[1] + j, static_cast<int>(4 * i + j));
  }
};

/// Takes corners of the cell that are zero up to rounding for zero, whose derivative stays: a wall
/// along a line of the grid would else be open where rounding leaves its nodes in the fluid. The
/// measure is that of the node's neighbors, so that all its cells agree.
template <typename T>
void settle_corners(const ChordPatch& patch, T* phi) {
  double size[4];
  for (int i = 0; i < 4; ++i) {
    const int at[2] = {patch.at[0] + (i >> 1), patch.at[1] + (i & 1)};
    size[i] = 0.0;
    for (int a = 0; a < 2; ++a)
      for (int step = -1; step <= 1; step += 2) {
        int next[2] = {at[0], at[1]};
        next[a] += step;
        if (next[a] >= 0 && next[a] < patch.count[a])
          size[i] = std::max(size[i], std::abs(value_of(phi[4 * next[0] + next[1]])));
      }
  }
  for (int i = 0; i < 4; ++i) {
    T& corner = phi[4 * (patch.at[0] + (i >> 1)) + patch.at[1] + (i & 1)];
    if (std::abs(value_of(corner)) <= kOnFace * size[i]) corner -= value_of(corner);
  }
}

/// The chord in a cell, as a plane.
/// @param phi (16,) by ChordPatch, corners settled
template <typename T>
CellPlane<2, T> chord_plane(const ChordPatch& patch, const T* phi, CellKind& kind) {
  const auto node = [&](int i) -> const T& {  // corner of the cell
    return phi[4 * (patch.at[0] + (i >> 1)) + patch.at[1] + (i & 1)];
  };
  T corner[4];
  bool fluid[4];
  int num_fluid = 0;
  for (int i = 0; i < 4; ++i) {
    corner[i] = node(i);
    fluid[i] = value_of(corner[i]) > 0.0;
    num_fluid += fluid[i];
  }
  const CellPlane<2, T> fit(corner);
  if (num_fluid == 0 || num_fluid == 4) {
    kind = num_fluid == 0 ? CellKind::kEmpty : CellKind::kFull;
    return fit;
  }
  // The crossing on the edge of corner i along an axis, seen from i.
  const auto crossing = [&](int i, int axis) {
    T row[4];
    const bool whole = patch.count[axis] == 4;
    const int high = (i >> (1 - axis)) & 1, other = 1 - axis;
    const int across = patch.at[other] + ((i >> axis) & 1);
    const int first = whole ? 0 : patch.at[axis];
    for (int k = 0; k < (whole ? 4 : 2); ++k)
      row[k] = axis == 0 ? phi[4 * (first + k) + across] : phi[4 * across + first + k];
    return EdgeCrossing<T>(row, whole ? 4 : 2, patch.at[axis] + high - first, high ? -1 : 1);
  };
  // Corner i is cut off from its neighbors: phi falls linearly along both edges.
  const auto cut_off = [&](int i) {
    T value[4];
    const T along[2] = {crossing(i, 0).fall(), crossing(i, 1).fall()};
    value[i] = corner[i];
    value[i ^ 2] = corner[i] - along[0];
    value[i ^ 1] = corner[i] - along[1];
    value[i ^ 3] = corner[i] - along[0] - along[1];
    return CellPlane<2, T>(value);
  };
  const auto done = [&](const CellPlane<2, T>& plane) {
    kind = plane.kind();
    return plane;
  };
  if (num_fluid != 2) {
    for (int i = 0; i < 4; ++i)
      if (fluid[i] == (num_fluid == 1)) return done(cut_off(i));
  }
  for (int axis = 0; axis < 2; ++axis) {  // the wall crosses both edges along an axis
    const int along = 2 >> axis, across = 1 << axis;
    if (fluid[0] == fluid[along] || fluid[0] != fluid[across]) continue;
    T value[4];
    for (int k = 0; k < 2; ++k) {
      const int i = (fluid[0] ? 0 : along) ^ (k ? across : 0);
      value[i] = crossing(i, axis).place();
      value[i ^ along] = value[i] - 1.0;
    }
    return done(CellPlane<2, T>(value));
  }
  // Two diagonal corners. Without the smallest, the wall would cut off its opposite.
  int order[4] = {0, 1, 2, 3};
  std::stable_sort(order, order + 4, [&](int i, int j) {
    return std::abs(value_of(corner[i])) < std::abs(value_of(corner[j]));
  });
  T ratio = corner[order[0]] / corner[order[1]];
  if (value_of(ratio) < 0.0) ratio = -ratio;
  const T part = ratio * ratio * (3.0 - 2.0 * ratio);
  CellPlane<2, T> plane = cut_off(order[0] ^ 3);
  plane.c += (fit.c - plane.c) * part;
  for (int a = 0; a < 2; ++a) plane.g[a] += (fit.g[a] - plane.g[a]) * part;
  return done(plane);
}

}  // namespace diffsim
