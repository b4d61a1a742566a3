// The bilinear form of Stokes flow in one cell, its residual and the residual's derivatives.
//
// Unknowns: velocity v; given: wall velocity g, body force f, viscosity eta. With D(v) the
// symmetric gradient, n the normal out of the fluid, w = v - g, test function z:
//   e(v, z) = int 2 eta D(v):D(z) - f.z
//           - int_wall (2 eta D(v) n).z + (2 eta D(z) n).w - (beta eta / h) w.z     (no-slip)
//   C(v, g) = int div v - int_wall w.m          (outflow through the rest of the cell's boundary)
//   R(z)    = e(v, z) - p C(z, 0)               p: one pressure per cell
// (symmetric Nitsche terms; Freund, Stenberg 1995). With a slip wall only normal components count,
// and of these the means over the cell's facet, of area S:
//           - S (<2 n.D(v) n> <z.n> + <2 n.D(z) n> <w.n> - (beta / h) <w.n> <z.n>) eta.
// Holding w.n point by point would make facets of a curved wall resist sliding: v tangential to the
// wall is not tangential to its facets, which costs one order.
// m is n, but in 2D the normal of the facet itself (FlowGeometry::facet_normal): then C is the flow
// through the cell's faces and what the wall gives, neighbors agree about their faces, and a
// constant pressure does no work.
// Every integrand is of degree two per axis, so the weights of CutCell integrate it exactly.
#pragma once

#include "kernels/stokes/cell_basis.h"

namespace diffsim {

/// Weights of one cell; a full cell has no interface (area = nullptr).
template <typename T>
struct CellWeightsOf {
  const T* volume = nullptr;  // (3^D,) [m^D]
  const T* area = nullptr;    // (3^D,) [m^(D-1)]
  const T* normal = nullptr;  // (D,) of the wall
  const T* facet = nullptr;   // (D,) that of what stands for it, for C
};
using CellWeights = CellWeightsOf<double>;

template <int D>
class CellForm {
 public:
  static constexpr int kCorners = 1 << D, kPoints = pow3(D), kSize = kCorners * D;
  using Corner = double[kCorners][D];  // nodal vectors of one cell

  CellForm(const StokesGrid<D>& grid, double beta, bool slip)
      : basis_(grid), penalty_(beta / grid.h_min), slip_(slip) {}
  const CellBasis<D>& basis() const { return basis_; }

  /// c with C(v, 0) = c . v.
  void divergence(const CellWeights& cell, Corner c) const {
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a) {
        double sum = 0.0;
        for (int q = 0; q < kPoints; ++q) {
          sum += cell.volume[q] * basis_.dN[q][a][i];
          if (cell.area) sum -= cell.area[q] * basis_.N[q][i] * cell.facet[a];
        }
        c[i][a] = sum;
      }
  }

  /// C(v, g); g may be null. With T = Dual<1>: and its derivative along one of the weights.
  template <typename T>
  T outflow(const CellWeightsOf<T>& cell, const Corner v, const double (*g)[D]) const {
    T sum = 0.0;
    for (int q = 0; q < kPoints; ++q) {
      double div = 0.0;
      T wall = 0.0;
      for (int i = 0; i < kCorners; ++i)
        for (int a = 0; a < D; ++a) {
          div += basis_.dN[q][a][i] * v[i][a];
          if (cell.area) wall += basis_.N[q][i] * (v[i][a] - (g ? g[i][a] : 0.0)) * cell.facet[a];
        }
      sum += cell.volume[q] * div;
      if (cell.area) sum -= cell.area[q] * wall;
    }
    return sum;
  }

  /// Matrix of e for eta = 1, plus kappa c c'. Row-major, unknown corner * D + axis.
  void matrix(const CellWeights& cell, double kappa, double* A) const {
    constexpr int kk = kCorners * kCorners;
    double K[D * D * kk] = {}, P[D * kk] = {}, Q[kk] = {};
    for (int q = 0; q < kPoints; ++q)
      for (int n = 0; n < D * D * kk; ++n) K[n] += cell.volume[q] * basis_.stiffness[q][n];
    if (cell.area)
      for (int q = 0; q < kPoints; ++q) {
        for (int n = 0; n < D * kk; ++n) P[n] += cell.area[q] * basis_.flux[q][n];
        for (int n = 0; n < kk; ++n) Q[n] += cell.area[q] * basis_.mass[q][n];
      }
    Corner c;
    divergence(cell, c);
    Facet<double> facet;
    if (cell.area && slip_) facet = facet_of(cell);
    for (int i = 0; i < kCorners; ++i)
      for (int j = 0; j < kCorners; ++j) {
        const int ij = i * kCorners + j, ji = j * kCorners + i;
        double laplace = 0.0, flux = 0.0;
        for (int a = 0; a < D; ++a) {
          laplace += K[(a * D + a) * kk + ij];
          if (cell.area) flux += cell.normal[a] * (P[a * kk + ij] + P[a * kk + ji]);
        }
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b) {
            double sum = kappa * c[i][a] * c[j][b] + K[(b * D + a) * kk + ij];
            if (a == b) sum += laplace;
            if (cell.area) {
              const double* n = cell.normal;
              if (slip_) {
                const double mean_flux =
                    facet.mean[i] * facet.slope[j] + facet.mean[j] * facet.slope[i];
                sum += n[a] * n[b] * facet.area *
                       (penalty_ * facet.mean[i] * facet.mean[j] - 2.0 * mean_flux);
              } else {
                if (a == b) sum += penalty_ * Q[ij] - flux;
                sum -= n[b] * P[a * kk + ij] + n[a] * P[b * kk + ji];
              }
            }
            A[(i * D + a) * kSize + j * D + b] = sum;
          }
      }
  }

  /// R for given v, g, f (null: zero), pressure and viscosity; added to r. With T =
  /// Dual<1>: and its derivative along one of the weights.
  template <typename T>
  void residual(const CellWeightsOf<T>& cell, const Corner v, const double (*g)[D],
                const double (*f)[D], double pressure, double eta, T (*r)[D]) const {
    FacetValues<T> mean;
    if (cell.area && slip_) mean = facet_values(cell, v, g);
    for (int q = 0; q < kPoints; ++q) {
      Point at;
      evaluate(q, v, at);
      T F[D][D], s[D] = {};  // coefficients of the test function's gradient and value
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b)
          F[a][b] =
              cell.volume[q] * (eta * (at.grad[a][b] + at.grad[b][a]) - (a == b ? pressure : 0.0));
      if (f) {
        double force[D];
        interpolate(q, f, force);
        for (int a = 0; a < D; ++a) s[a] -= cell.volume[q] * force[a];
      }
      if (cell.area) {
        const T* n = cell.normal;
        const T S = cell.area[q];
        double w[D];
        subtract(q, g, at.value, w);
        T t[D], tn, wn;
        wall_values(n, at, w, t, tn, wn);
        for (int a = 0; a < D; ++a) {
          if (slip_) {
            s[a] += S * eta * (penalty_ * mean.normal - mean.stress) * n[a];
          } else {
            s[a] += S * eta * (penalty_ * w[a] - t[a]);
          }
          s[a] += S * pressure * cell.facet[a];
          for (int b = 0; b < D; ++b)
            F[a][b] -=
                S * eta * (slip_ ? 2.0 * mean.normal * n[a] * n[b] : w[a] * n[b] + n[a] * w[b]);
        }
      }
      for (int i = 0; i < kCorners; ++i)
        for (int a = 0; a < D; ++a) {
          T sum = s[a] * basis_.N[q][i];
          for (int b = 0; b < D; ++b) sum += F[a][b] * basis_.dN[q][b][i];
          r[i][a] += sum;
        }
    }
  }

  /// Derivatives of e(v, z) - p C(z, 0) + pi C(v, g) by the cell's weights.
  /// @param[out] by_volume (3^D,), by_area (3^D,), by_normal (D,), by_facet (D,); all but the first
  /// if there is a wall
  void weight_gradient(const CellWeights& cell, const Corner v, const Corner z,
                       const double (*g)[D], const double (*f)[D], double p, double pi, double eta,
                       double* by_volume, double* by_area, double* by_normal,
                       double* by_facet) const {
    for (int a = 0; a < D && cell.area; ++a) by_normal[a] = by_facet[a] = 0.0;
    FacetValues<double> mean_v, mean_z;
    if (cell.area && slip_) {
      mean_v = facet_values(cell, v, g);
      mean_z = facet_values(cell, z, nullptr);
    }
    for (int q = 0; q < kPoints; ++q) {
      Point x, y;
      evaluate(q, v, x);
      evaluate(q, z, y);
      double sum = 0.0;
      for (int a = 0; a < D; ++a) {
        sum += pi * x.grad[a][a] - p * y.grad[a][a];
        for (int b = 0; b < D; ++b) sum += eta * (x.grad[a][b] + x.grad[b][a]) * y.grad[a][b];
      }
      if (f) {
        double force[D];
        interpolate(q, f, force);
        for (int a = 0; a < D; ++a) sum -= force[a] * y.value[a];
      }
      by_volume[q] = sum;
      if (!cell.area) continue;
      const double *n = cell.normal, S = cell.area[q];
      double w[D], t[D], u[D], tn, un, wn, zn;
      subtract(q, g, x.value, w);
      wall_values(n, x, w, t, tn, wn);
      wall_values(n, y, y.value, u, un, zn);
      double area = 0.0;
      for (int a = 0; a < D; ++a) {
        const double through = p * y.value[a] - pi * w[a];
        area += through * cell.facet[a];
        by_facet[a] += S * through;
      }
      if (slip_) {
        // d(S <x><y>) = x <y> + <x> y - <x><y> per area.
        const double W = mean_v.normal, T = mean_v.stress, Z = mean_z.normal, U = mean_z.stress;
        area += eta * (penalty_ * (wn * Z + W * zn - W * Z) - (tn * Z + T * zn - T * Z) -
                       (un * W + U * wn - U * W));
      } else {
        for (int a = 0; a < D; ++a)
          area += eta * (penalty_ * w[a] * y.value[a] - t[a] * y.value[a] - u[a] * w[a]);
      }
      by_area[q] = area;
      for (int a = 0; a < D; ++a) {
        double normal = 0.0;
        if (slip_) {  // d(n.(G + G')n) = 2 (G + G') n . dn
          normal += eta * (penalty_ * (w[a] * mean_z.normal + mean_v.normal * y.value[a]) -
                           2.0 * (t[a] * mean_z.normal + u[a] * mean_v.normal) -
                           mean_v.stress * y.value[a] - mean_z.stress * w[a]);
        } else {
          for (int b = 0; b < D; ++b)
            normal -= eta * ((x.grad[a][b] + x.grad[b][a]) * y.value[b] +
                             (y.grad[a][b] + y.grad[b][a]) * w[b]);
        }
        by_normal[a] += S * normal;
      }
    }
  }

  /// Derivative of the same by the wall velocity; added.
  void wall_gradient(const CellWeights& cell, const Corner z, double pi, double eta,
                     Corner grad_g) const {
    FacetValues<double> mean;
    if (slip_) mean = facet_values(cell, z, nullptr);
    for (int q = 0; q < kPoints; ++q) {
      Point y;
      evaluate(q, z, y);
      double u[D], un, zn;
      wall_values(cell.normal, y, y.value, u, un, zn);
      for (int a = 0; a < D; ++a) {
        const double n = cell.normal[a];
        const double by_g =
            pi * cell.facet[a] + eta * (slip_ ? (mean.stress - penalty_ * mean.normal) * n
                                              : u[a] - penalty_ * y.value[a]);
        for (int i = 0; i < kCorners; ++i) grad_g[i][a] += cell.area[q] * by_g * basis_.N[q][i];
      }
    }
  }

  /// -int z N_i: derivative by the body force; added.
  void force_gradient(const CellWeights& cell, const Corner z, Corner grad_f) const {
    for (int q = 0; q < kPoints; ++q) {
      double value[D];
      interpolate(q, z, value);
      for (int i = 0; i < kCorners; ++i)
        for (int a = 0; a < D; ++a) grad_f[i][a] -= cell.volume[q] * value[a] * basis_.N[q][i];
    }
  }

 private:
  struct Point {
    double value[D], grad[D][D];  // grad[a][b] = d v_a / d x_b
  };
  /// Means over the facet: of N_i, and of its slope along the normal.
  template <typename T>
  struct Facet {
    T area = 0.0, mean[kCorners] = {}, slope[kCorners] = {};
  };
  /// Means over the facet: of w.n, and of 2 n.D(v) n.
  template <typename T>
  struct FacetValues {
    T normal = 0.0, stress = 0.0;
  };

  template <typename T>
  Facet<T> facet_of(const CellWeightsOf<T>& cell) const {
    Facet<T> facet;
    for (int q = 0; q < kPoints; ++q) {
      facet.area += cell.area[q];
      for (int i = 0; i < kCorners; ++i) {
        facet.mean[i] += cell.area[q] * basis_.N[q][i];
        for (int a = 0; a < D; ++a)
          facet.slope[i] += cell.area[q] * cell.normal[a] * basis_.dN[q][a][i];
      }
    }
    for (int i = 0; i < kCorners && value_of(facet.area) > 0.0; ++i) {
      facet.mean[i] = facet.mean[i] / facet.area;
      facet.slope[i] = facet.slope[i] / facet.area;
    }
    return facet;
  }
  template <typename T>
  FacetValues<T> facet_values(const CellWeightsOf<T>& cell, const Corner v,
                              const double (*g)[D]) const {
    const Facet<T> facet = facet_of(cell);
    FacetValues<T> out;
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a) {
        out.normal += facet.mean[i] * (v[i][a] - (g ? g[i][a] : 0.0)) * cell.normal[a];
        out.stress += 2.0 * facet.slope[i] * v[i][a] * cell.normal[a];
      }
    return out;
  }

  void interpolate(int q, const double (*v)[D], double* value) const {
    for (int a = 0; a < D; ++a) {
      value[a] = 0.0;
      for (int i = 0; i < kCorners; ++i) value[a] += basis_.N[q][i] * v[i][a];
    }
  }
  void evaluate(int q, const Corner v, Point& at) const {
    interpolate(q, v, at.value);
    for (int a = 0; a < D; ++a)
      for (int b = 0; b < D; ++b) {
        double sum = 0.0;
        for (int i = 0; i < kCorners; ++i) sum += basis_.dN[q][b][i] * v[i][a];
        at.grad[a][b] = sum;
      }
  }
  /// w = v - g at a point.
  void subtract(int q, const double (*g)[D], const double* v, double* w) const {
    for (int a = 0; a < D; ++a) w[a] = v[a];
    if (!g) return;
    double wall[D];
    interpolate(q, g, wall);
    for (int a = 0; a < D; ++a) w[a] -= wall[a];
  }
  /// t = 2 D(v) n, tn = t.n, wn = w.n.
  template <typename T>
  static void wall_values(const T* n, const Point& at, const double* w, T* t, T& tn, T& wn) {
    tn = wn = 0.0;
    for (int a = 0; a < D; ++a) {
      t[a] = 0.0;
      for (int b = 0; b < D; ++b) t[a] += (at.grad[a][b] + at.grad[b][a]) * n[b];
      tn += t[a] * n[a];
      wn += w[a] * n[a];
    }
  }

  CellBasis<D> basis_;
  double penalty_;  // beta / h
  bool slip_;
};

}  // namespace diffsim
