#include "kernels/stokes/cut_cells.h"

#include <algorithm>
#include <type_traits>
#include <vector>

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
    for (int a = 0; a < D; ++a) by_value[Cut::kFacet + a] = grad_normal[cell * D + a];
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
    for (int a = 0; a < D; ++a) d_normal[cell * D + a] = value[Cut::kFacet + a].grad[0];
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

/// The cells at a grid plane as a grid of their own, with what their planes ask for: chords take a
/// node more on each side, and two where the grid ends.
template <int D>
struct Slab {
  GridShape shape;
  std::int64_t index = 0;          // of the plane
  std::vector<std::int64_t> node;  // of the whole grid

  Slab(const GridShape& whole, int axis, std::int64_t at) : shape(whole) {
    const std::int64_t reach = D == 2 ? 3 : 1;
    const std::int64_t first = std::max<std::int64_t>(0, at - reach);
    shape.cells[axis] = std::min(whole.cells[axis], at + reach) - first;
    index = at - first;
    const StokesGrid<D> grid(whole), slab(shape);
    node.resize(static_cast<std::size_t>(slab.num_nodes));
    for (std::int64_t i = 0; i < slab.num_nodes; ++i) {
      std::int64_t position[D];
      slab.node_position(i, position);
      position[axis] += first;
      node[static_cast<std::size_t>(i)] = grid.first_node(position);
    }
  }
  /// Values of fields (count, num_nodes, width) on the slab.
  std::vector<double> gather(const double* field, std::int64_t count, std::int64_t num_nodes,
                             int width) const {
    std::vector<double> out;
    out.reserve(static_cast<std::size_t>(count * width) * node.size());
    for (std::int64_t k = 0; k < count; ++k)
      for (std::int64_t i : node)
        out.insert(out.end(), field + (k * num_nodes + i) * width,
                   field + (k * num_nodes + i + 1) * width);
    return out;
  }
  void scatter(const std::vector<double>& from, std::int64_t num_nodes, int width,
               double* field) const {
    std::size_t next = 0;
    for (std::int64_t k = 0; next < from.size(); ++k)
      for (std::int64_t i : node)
        for (int a = 0; a < width; ++a) field[(k * num_nodes + i) * width + a] = from[next++];
  }
};

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
    if (grad_flux && geometry.cut(cell)) geometry.plane_vjp(cell, phi, by_plane, 1.0, grad_phi);
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
    geometry.plane_tangent(cell, phi, d_phi, d_plane);
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

namespace {

std::int64_t num_nodes_of(const GridShape& shape) {
  std::int64_t nodes = 1;
  for (int a = 0; a < shape.dim; ++a) nodes *= shape.cells[a] + 1;
  return nodes;
}

/// f(slab) with the dimension as its type's.
template <typename F>
void on_slab(const GridShape& shape, int axis, std::int64_t index, F&& f) {
  if (shape.dim == 2)
    f(Slab<2>(shape, axis, index), std::integral_constant<int, 2>());
  else
    f(Slab<3>(shape, axis, index), std::integral_constant<int, 3>());
}

}  // namespace

void plane_flux(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                int axis, std::int64_t index, double* flux) {
  std::fill(flux, flux + cases, 0.0);
  const std::int64_t N = num_nodes_of(shape);
  on_slab(shape, axis, index, [&](const auto& slab, auto dim) {
    plane_flux_of<dim>(slab.shape, slab.gather(phi, 1, N, 1).data(),
                       slab.gather(v, cases, N, dim).data(), cases, axis, slab.index, flux, nullptr,
                       nullptr, nullptr);
  });
}

void plane_flux_vjp(const GridShape& shape, const double* phi, const double* v, std::int64_t cases,
                    int axis, std::int64_t index, const double* grad_flux, double* grad_phi,
                    double* grad_v) {
  const std::int64_t N = num_nodes_of(shape);
  std::fill(grad_phi, grad_phi + N, 0.0);
  std::fill(grad_v, grad_v + cases * N * shape.dim, 0.0);
  on_slab(shape, axis, index, [&](const auto& slab, auto dim) {
    std::vector<double> by_phi(slab.node.size(), 0.0), by_v(by_phi.size() * cases * dim, 0.0);
    plane_flux_of<dim>(slab.shape, slab.gather(phi, 1, N, 1).data(),
                       slab.gather(v, cases, N, dim).data(), cases, axis, slab.index, nullptr,
                       grad_flux, by_phi.data(), by_v.data());
    slab.scatter(by_phi, N, 1, grad_phi);
    slab.scatter(by_v, N, dim, grad_v);
  });
}

void plane_flux_jvp(const GridShape& shape, const double* phi, const double* v, const double* d_phi,
                    const double* d_v, std::int64_t cases, int axis, std::int64_t index,
                    double* d_flux) {
  std::fill(d_flux, d_flux + cases, 0.0);
  const std::int64_t N = num_nodes_of(shape);
  on_slab(shape, axis, index, [&](const auto& slab, auto dim) {
    plane_flux_jvp_of<dim>(slab.shape, slab.gather(phi, 1, N, 1).data(),
                           slab.gather(v, cases, N, dim).data(), slab.gather(d_phi, 1, N, 1).data(),
                           slab.gather(d_v, cases, N, dim).data(), cases, axis, slab.index, d_flux);
  });
}

}  // namespace diffsim
