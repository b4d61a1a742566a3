#include "kernels/stokes/cut_cells.h"

#include <algorithm>

#include "kernels/stokes/flow_operator.h"

namespace diffsim {
namespace {

template <int D>
void cut_cells_of(const GridShape& shape, const double* phi, double* volume, double* area,
                  double* normal, ThreadPool& pool) {
  const FlowGeometry<D> geometry(StokesGrid<D>(shape), phi, false, pool);
  const StokesGrid<D>& grid = geometry.grid();
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    const CutCell<D>* cut = geometry.cut(cell);
    volume[cell] = geometry.fraction(cell) * grid.cell_volume;
    area[cell] = 0.0;
    for (int a = 0; a < D; ++a) normal[cell * D + a] = cut ? cut->normal()[a] : 0.0;
    for (int q = 0; cut && q < CutCell<D>::kPoints; ++q) area[cell] += cut->area()[q];
  }
}

template <int D>
void cut_cells_vjp_of(const GridShape& shape, const double* phi, const double* grad_volume,
                      const double* grad_area, const double* grad_normal, double* grad_phi,
                      ThreadPool& pool) {
  const FlowGeometry<D> geometry(StokesGrid<D>(shape), phi, false, pool);
  const StokesGrid<D>& grid = geometry.grid();
  std::fill(grad_phi, grad_phi + grid.num_nodes, 0.0);
  for (std::int64_t cell : geometry.cut_cells()) {
    using Cut = CutCell<D>;
    double by_value[Cut::kSize] = {};
    for (int q = 0; q < Cut::kPoints; ++q) {
      by_value[Cut::kVolume + q] = grad_volume[cell];
      by_value[Cut::kArea + q] = grad_area[cell];
    }
    for (int a = 0; a < D; ++a) by_value[Cut::kNormal + a] = grad_normal[cell * D + a];
    geometry.cut_vjp(cell, phi, 1.0, by_value, grad_phi);
  }
}

template <int D>
void cut_cells_jvp_of(const GridShape& shape, const double* phi, const double* d_phi,
                      double* d_volume, double* d_area, double* d_normal, ThreadPool& pool) {
  using Cut = CutCell<D>;
  const FlowGeometry<D> geometry(StokesGrid<D>(shape), phi, false, pool);
  const std::int64_t num_cells = geometry.grid().num_cells;
  std::fill(d_volume, d_volume + num_cells, 0.0);
  std::fill(d_area, d_area + num_cells, 0.0);
  std::fill(d_normal, d_normal + num_cells * D, 0.0);
  for (std::int64_t cell : geometry.cut_cells()) {
    Dual<1> value[Cut::kSize];
    geometry.cut_tangent(cell, phi, d_phi, value);
    for (int q = 0; q < Cut::kPoints; ++q) {
      d_volume[cell] += value[Cut::kVolume + q].grad[0];
      d_area[cell] += value[Cut::kArea + q].grad[0];
    }
    for (int a = 0; a < D; ++a) d_normal[cell * D + a] = value[Cut::kNormal + a].grad[0];
  }
}

/// f(cell, side of the cell, share) for the cells at a grid plane.
template <int D, typename F>
void for_plane(const StokesGrid<D>& grid, int axis, std::int64_t index, F&& f) {
  const double share = index == 0 || index == grid.cells[axis] ? 1.0 : 0.5;
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    std::int64_t at[D];
    grid.cell_position(cell, at);
    if (at[axis] == index) f(cell, 0, share);
    if (at[axis] + 1 == index) f(cell, 1, share);
  }
}

template <int D>
void plane_flux_of(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                   int axis, std::int64_t index, double* flux, const double* grad_flux,
                   double* grad_phi, double* grad_v) {
  ThreadPool pool(1);
  const FlowGeometry<D> geometry(StokesGrid<D>(shape), phi, false, pool);
  const StokesGrid<D>& grid = geometry.grid();
  const std::int64_t N = grid.num_nodes * D;
  for_plane<D>(grid, axis, index, [&](std::int64_t cell, int side, double share) {
    if (!geometry.active(cell)) return;
    Dual<D + 1> moments[pow3(D - 1)];
    geometry.face_moments(cell, axis, side, phi, moments);
    double by_plane[D + 1] = {};
    for_face_points<D>(grid, geometry.first_node(cell), axis, side,
                       [&](int q, const std::int64_t* nodes, const double* shape_fn) {
                         for (std::int64_t k = 0; k < cases; ++k) {
                           double value = 0.0;
                           for (int i = 0; i < 1 << (D - 1); ++i)
                             value += shape_fn[i] * v[k * N + nodes[i] * D + axis];
                           if (flux) flux[k] += share * moments[q].value * value;
                           if (!grad_flux) continue;
                           for (int j = 0; j <= D; ++j)
                             by_plane[j] += grad_flux[k] * share * value * moments[q].grad[j];
                           for (int i = 0; i < 1 << (D - 1); ++i)
                             grad_v[k * N + nodes[i] * D + axis] +=
                                 grad_flux[k] * share * moments[q].value * shape_fn[i];
                         }
                       });
    if (grad_flux && geometry.cut(cell)) geometry.plane_vjp(cell, by_plane, 1.0, grad_phi);
  });
}

template <int D>
void plane_flux_jvp_of(const GridShape& shape, const double* phi, const double* v,
                       const double* d_phi, const double* d_v, std::int64_t cases, int axis,
                       std::int64_t index, double* d_flux) {
  ThreadPool pool(1);
  const FlowGeometry<D> geometry(StokesGrid<D>(shape), phi, false, pool);
  const StokesGrid<D>& grid = geometry.grid();
  const std::int64_t N = grid.num_nodes * D;
  for_plane<D>(grid, axis, index, [&](std::int64_t cell, int side, double share) {
    if (!geometry.active(cell)) return;
    Dual<D + 1> moments[pow3(D - 1)];
    geometry.face_moments(cell, axis, side, phi, moments);
    double d_plane[D + 1];
    geometry.plane_tangent(cell, d_phi, d_plane);
    for_face_points<D>(grid, geometry.first_node(cell), axis, side,
                       [&](int q, const std::int64_t* nodes, const double* shape_fn) {
                         double d_moment = 0.0;
                         for (int j = 0; j <= D; ++j) d_moment += moments[q].grad[j] * d_plane[j];
                         for (std::int64_t k = 0; k < cases; ++k)
                           for (int i = 0; i < 1 << (D - 1); ++i) {
                             const std::int64_t at = k * N + nodes[i] * D + axis;
                             d_flux[k] += share * shape_fn[i] *
                                          (d_moment * v[at] + moments[q].value * d_v[at]);
                           }
                       });
  });
}

}  // namespace

void cut_cells(const GridShape& shape, const double* phi, double* volume, double* area,
               double* normal, ThreadPool& pool) {
  if (shape.dim == 2)
    cut_cells_of<2>(shape, phi, volume, area, normal, pool);
  else
    cut_cells_of<3>(shape, phi, volume, area, normal, pool);
}

void cut_cells_vjp(const GridShape& shape, const double* phi, const double* grad_volume,
                   const double* grad_area, const double* grad_normal, double* grad_phi,
                   ThreadPool& pool) {
  if (shape.dim == 2)
    cut_cells_vjp_of<2>(shape, phi, grad_volume, grad_area, grad_normal, grad_phi, pool);
  else
    cut_cells_vjp_of<3>(shape, phi, grad_volume, grad_area, grad_normal, grad_phi, pool);
}

void cut_cells_jvp(const GridShape& shape, const double* phi, const double* d_phi, double* d_volume,
                   double* d_area, double* d_normal, ThreadPool& pool) {
  if (shape.dim == 2)
    cut_cells_jvp_of<2>(shape, phi, d_phi, d_volume, d_area, d_normal, pool);
  else
    cut_cells_jvp_of<3>(shape, phi, d_phi, d_volume, d_area, d_normal, pool);
}

void plane_flux(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                int axis, std::int64_t index, double* flux) {
  std::fill(flux, flux + cases, 0.0);
  if (shape.dim == 2)
    plane_flux_of<2>(shape, phi, v, cases, axis, index, flux, nullptr, nullptr, nullptr);
  else
    plane_flux_of<3>(shape, phi, v, cases, axis, index, flux, nullptr, nullptr, nullptr);
}

void plane_flux_vjp(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                    int axis, std::int64_t index, const double* grad_flux, double* grad_phi,
                    double* grad_v) {
  std::int64_t nodes = 1;
  for (int a = 0; a < shape.dim; ++a) nodes *= shape.cells[a] + 1;
  std::fill(grad_phi, grad_phi + nodes, 0.0);
  std::fill(grad_v, grad_v + cases * nodes * shape.dim, 0.0);
  if (shape.dim == 2)
    plane_flux_of<2>(shape, phi, v, cases, axis, index, nullptr, grad_flux, grad_phi, grad_v);
  else
    plane_flux_of<3>(shape, phi, v, cases, axis, index, nullptr, grad_flux, grad_phi, grad_v);
}

void plane_flux_jvp(const GridShape& shape, const double* phi, const double* v, const double* d_phi,
                    const double* d_v, std::int64_t cases, int axis, std::int64_t index,
                    double* d_flux) {
  std::fill(d_flux, d_flux + cases, 0.0);
  if (shape.dim == 2)
    plane_flux_jvp_of<2>(shape, phi, v, d_phi, d_v, cases, axis, index, d_flux);
  else
    plane_flux_jvp_of<3>(shape, phi, v, d_phi, d_v, cases, axis, index, d_flux);
}

}  // namespace diffsim
