// Exact moments of a half space in the unit cube, and of the plane that bounds it.
//
// The half space is phi(xi) = c + sum_a g_a (xi_a - 1/2) > 0 in [0, 1]^D. With L_q the Lagrange
// polynomials of the 3^D tensor Gauss points,
//   volume_q = int L_q H(phi) dxi,   delta_q = int L_q delta(phi) dxi,
// so that sum_q volume_q f(xi_q) is the integral of f over the half space, and sum_q delta_q
// f(xi_q) that over the plane divided by |g|, for every f of degree two per axis.
//
// Reduction of dimension: along the axis of the largest |g_a| the plane is a height eta, linear
// with slopes of at most one in the other coordinates, and the integral is closed form. The
// remaining axes are integrated by Gauss rules that are exact on every piece between the places
// where the plane crosses an edge of the cube; the axis of the smallest |g_a| is outermost.
// Components of g may vanish. Written on a scalar T: with dual numbers the derivatives are those of
// the formula.
#pragma once

#include <algorithm>
#include <cmath>
#include <utility>

#include "kernels/stokes/dual.h"

namespace diffsim {

constexpr int pow3(int d) { return d == 0 ? 1 : 3 * pow3(d - 1); }

/// Gauss points and weights on [0, 1]: three points, exact to degree 5.
constexpr double kGaussOffset = 0.38729833462074168852;  // sqrt(3/20)
constexpr double kGauss3Point[3] = {0.5 - kGaussOffset, 0.5, 0.5 + kGaussOffset};
constexpr double kGauss3Weight[3] = {5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0};
/// Five points, exact to degree 9.
constexpr double kGauss5Point[5] = {0.04691007703066800360, 0.23076534494715845448, 0.5,
                                    0.76923465505284154552, 0.95308992296933199640};
constexpr double kGauss5Weight[5] = {0.11846344252809454376, 0.23931433524968323402,
                                     0.28444444444444444444, 0.23931433524968323402,
                                     0.11846344252809454376};
/// A plane this close to a cell's face (in cells) lies in the face and belongs to the cell on its
/// fluid side; a cell with less fluid than that is empty.
constexpr double kOnFace = 1e-12;
/// Slopes below are not used to split a piece: the plane is parallel to that axis.
constexpr double kParallel = 1e-10;

/// L_k at x in [0, 1].
template <typename T>
void lagrange3(const T& x, T* L) {
  constexpr double s = 1.0 / (2.0 * kGaussOffset * kGaussOffset);
  const T y = x - 0.5;
  const T yy = y * y * s, yr = y * (s * kGaussOffset);
  L[0] = yy - yr;
  L[1] = 1.0 - 2.0 * yy;
  L[2] = yy + yr;
}

/// int_0^x L_k.
template <typename T>
void lagrange3_integral(const T& x, T* I) {
  constexpr double s = 1.0 / (2.0 * kGaussOffset * kGaussOffset);
  const T y = x - 0.5;
  const T yy = (y * y - 0.25) * (0.5 * kGaussOffset * s);
  const T yyy = (y * y * y + 0.125) * (s / 3.0);
  I[0] = yyy - yy;
  I[1] = y + 0.5 - 2.0 * yyy;
  I[2] = yyy + yy;
}

namespace half_space {

enum class Piece { kFluid, kCut, kSolid };

inline Piece classify(double eta) {
  if (eta < -kOnFace) return Piece::kFluid;
  return eta > 1.0 + kOnFace ? Piece::kSolid : Piece::kCut;
}

/// Along the height axis: fluid above eta. Adds weight * moments to volume[3] and delta[3].
template <typename T>
void add_column(Piece piece, T eta, const T* weight, int count, T* volume, T* delta) {
  if (piece == Piece::kSolid) return;
  T v[3], d[3];
  if (piece == Piece::kFluid) {
    for (int k = 0; k < 3; ++k) v[k] = T(kGauss3Weight[k]);
  } else {
    if (value_of(eta) < 0.0) eta -= value_of(eta);  // rounding; the derivative stays
    if (value_of(eta) > 1.0) eta -= value_of(eta) - 1.0;
    lagrange3_integral(eta, v);
    for (int k = 0; k < 3; ++k) v[k] = kGauss3Weight[k] - v[k];
    lagrange3(eta, d);
  }
  for (int j = 0; j < count; ++j)
    for (int k = 0; k < 3; ++k) {
      volume[3 * j + k] += weight[j] * v[k];
      if (piece == Piece::kCut) delta[3 * j + k] += weight[j] * d[k];
    }
}

/// Ends of the pieces of [0, 1] between the places where offset + slope s is 0 or 1.
template <typename T>
int add_break(const T& target_minus_offset, const T& slope, T* ends, int count) {
  if (std::abs(value_of(slope)) < kParallel) return count;
  const T s = target_minus_offset / slope;
  if (value_of(s) > 0.0 && value_of(s) < 1.0) ends[count++] = s;
  return count;
}

template <typename T>
void sort_ends(T* ends, int count) {
  for (int i = 1; i < count; ++i)  // at most six
    for (int j = i; j > 0 && value_of(ends[j]) < value_of(ends[j - 1]); --j)
      std::swap(ends[j], ends[j - 1]);
}

/// Fluid above eta(s) = offset + slope s in the unit square; [3 * k_s + k_height].
template <typename T>
void square(const T& offset, const T& slope, T* volume, T* delta) {
  T ends[4] = {T(0.0)};
  int count = add_break(-offset, slope, ends, 1);
  count = add_break(1.0 - offset, slope, ends, count);
  ends[count++] = T(1.0);
  sort_ends(ends, count);
  for (int p = 0; p + 1 < count; ++p) {
    const T length = ends[p + 1] - ends[p];
    const Piece piece = classify(
        value_of(offset) + value_of(slope) * 0.5 * (value_of(ends[p]) + value_of(ends[p + 1])));
    for (int i = 0; i < 3 && piece != Piece::kSolid; ++i) {
      const T s = ends[p] + length * kGauss3Point[i];
      T L[3];
      lagrange3(s, L);
      for (T& l : L) l = l * length * kGauss3Weight[i];
      add_column(piece, offset + slope * s, L, 3, volume, delta);
    }
  }
}

/// Fluid above eta = offset + slope_s s + slope_t t in the unit cube; [9 k_t + 3 k_s + k_height].
template <typename T>
void cube(const T& offset, const T& slope_s, const T& slope_t, T* volume, T* delta) {
  T ends[6] = {T(0.0)};
  int count = 1;
  for (int s = 0; s < 2; ++s)
    for (int height = 0; height < 2; ++height)
      count = add_break(double(height) - offset - slope_s * double(s), slope_t, ends, count);
  ends[count++] = T(1.0);
  sort_ends(ends, count);
  for (int p = 0; p + 1 < count; ++p) {
    const T length = ends[p + 1] - ends[p];
    for (int i = 0; i < 5; ++i) {
      const T t = ends[p] + length * kGauss5Point[i];
      T v[9] = {}, d[9] = {}, L[3];
      square(offset + slope_t * t, slope_s, v, d);
      lagrange3(t, L);
      for (int k = 0; k < 3; ++k) {
        const T weight = L[k] * length * kGauss5Weight[i];
        for (int j = 0; j < 9; ++j) {
          volume[9 * k + j] += weight * v[j];
          delta[9 * k + j] += weight * d[j];
        }
      }
    }
  }
}

}  // namespace half_space

/// @param c      phi at the cube's center
/// @param g      (D,) slopes of phi, not all zero
/// @param volume (3^D,) overwritten; the last axis runs fastest
/// @param delta  (3^D,) overwritten
template <int D, typename T>
void half_space_moments(const T& c, const T* g, T* volume, T* delta) {
  int axis[D];  // by descending |g|
  for (int a = 0; a < D; ++a) axis[a] = a;
  std::stable_sort(axis, axis + D, [&](int a, int b) {
    return std::abs(value_of(g[a])) > std::abs(value_of(g[b]));
  });
  const bool flip = value_of(g[axis[0]]) < 0.0;
  const T inverse = T(1.0) / (flip ? -g[axis[0]] : g[axis[0]]);
  T offset = 0.5 - c * inverse, slope[D];
  for (int i = 1; i < D; ++i) {
    slope[i] = -g[axis[i]] * inverse;
    offset -= 0.5 * slope[i];
  }
  T v[pow3(D)] = {}, d[pow3(D)] = {};
  if constexpr (D == 1) {
    const T one(1.0);
    half_space::add_column(half_space::classify(value_of(offset)), offset, &one, 1, v, d);
  } else if constexpr (D == 2) {
    half_space::square(offset, slope[1], v, d);
  } else {
    half_space::cube(offset, slope[1], slope[2], v, d);
  }
  for (int q = 0; q < pow3(D); ++q) {  // q = sum_i k_i 3^i with i the position in `axis`
    int rest = q, target = 0;
    for (int i = 0; i < D; ++i) {
      const int k = i == 0 && flip ? 2 - rest % 3 : rest % 3;
      rest /= 3;
      target += k * pow3(D - 1 - axis[i]);
    }
    volume[target] = v[q];
    delta[target] = d[q] * inverse;
  }
}

}  // namespace diffsim
