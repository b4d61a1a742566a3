// Multilinear shape functions of a grid cell at its 3^D Gauss points, and products of them.
#pragma once

#include <vector>

#include "kernels/stokes/half_space.h"
#include "kernels/stokes/stokes_grid.h"

namespace diffsim {

template <int D>
struct CellBasis {
  static constexpr int kCorners = 1 << D, kPoints = pow3(D);
  double N[kPoints][kCorners];      // shape functions
  double dN[kPoints][D][kCorners];  // their gradients [1/m]
  double weight[kPoints];           // of a full cell [m^D]
  // Per point, products of shape functions i (row) and j: dN_a,i dN_b,j; N_i dN_a,j; N_i N_j.
  double stiffness[kPoints][D * D * kCorners * kCorners];
  double flux[kPoints][D * kCorners * kCorners];
  double mass[kPoints][kCorners * kCorners];
  // Mass matrix of a face with its normal along an axis [m^(D-1)].
  double face_mass[D][kCorners / 2][kCorners / 2];

  explicit CellBasis(const StokesGrid<D>& grid) {
    for (int q = 0; q < kPoints; ++q) {
      int k[D];
      double w = grid.cell_volume;
      for (int a = D - 1, rest = q; a >= 0; --a, rest /= 3) {
        k[a] = rest % 3;
        w *= kGauss3Weight[k[a]];
      }
      weight[q] = w;
      for (int i = 0; i < kCorners; ++i) {
        N[q][i] = 1.0;
        for (int a = 0; a < D; ++a) dN[q][a][i] = 1.0;
        for (int a = 0; a < D; ++a) {
          const bool high = StokesGrid<D>::corner_bit(i, a);
          const double x = kGauss3Point[k[a]], value = high ? x : 1.0 - x;
          N[q][i] *= value;
          for (int b = 0; b < D; ++b)
            dN[q][b][i] *= b == a ? (high ? 1.0 : -1.0) / grid.h[a] : value;
        }
      }
      int n = 0;
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b)
          for (int i = 0; i < kCorners; ++i)
            for (int j = 0; j < kCorners; ++j) stiffness[q][n++] = dN[q][a][i] * dN[q][b][j];
      n = 0;
      for (int a = 0; a < D; ++a)
        for (int i = 0; i < kCorners; ++i)
          for (int j = 0; j < kCorners; ++j) flux[q][n++] = N[q][i] * dN[q][a][j];
      n = 0;
      for (int i = 0; i < kCorners; ++i)
        for (int j = 0; j < kCorners; ++j) mass[q][n++] = N[q][i] * N[q][j];
    }
    for (int axis = 0; axis < D; ++axis)
      for (int i = 0; i < kCorners / 2; ++i)
        for (int j = 0; j < kCorners / 2; ++j) {
          double m = grid.face_area(axis);
          for (int bit = 0; bit < D - 1; ++bit)
            m *= ((i >> bit) & 1) == ((j >> bit) & 1) ? 1.0 / 3.0 : 1.0 / 6.0;
          face_mass[axis][i][j] = m;
        }
  }
};

}  // namespace diffsim
