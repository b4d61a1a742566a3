#include "kernels/stokes/flow_operator.h"

#include <algorithm>

#include "kernels/subscript.h"

namespace diffsim {
template <int D>
FlowOperator<D>::FlowOperator(const StokesGrid<D>& grid, const double* phi, const bool* open,
                              const FlowOptions& options, ThreadPool& pool)
    : geometry_(grid, phi, options.slip, pool),
      form_(grid, options.beta, options.slip),
      options_(options),
      phi_(phi, phi + grid.num_nodes),
      pressure_volume_(u(grid.num_cells), 0.0),
      full_matrix_(Form::kSize * Form::kSize) {
  form_.matrix({form_.basis().weight, nullptr, nullptr}, 0.0, full_matrix_.data());
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    if (!geometry_.active(cell)) continue;
    pressure_volume_[u(cell)] = pressure_volume_terms(cell).value;
    std::int64_t at[D];
    grid.cell_position(cell, at);
    for (int axis = 0; axis < D; ++axis) {
      if (at[axis] == 0 && open[2 * axis]) open_faces_.push_back({cell, axis, 0});
      if (at[axis] + 1 == grid.cells[axis] && open[2 * axis + 1])
        open_faces_.push_back({cell, axis, 1});
    }
  }
}

template <int D>
void FlowOperator<D>::residual(const double* v, const FlowData& data, const double* pressure,
                               double eta, double* r, ThreadPool& pool) const {
  const StokesGrid<D>& grid = geometry_.grid();
  std::fill(r, r + grid.num_nodes * D, 0.0);
  run_colors(geometry_.cell_colors(), pool, [&](std::int64_t cell) {
    const std::int64_t node = geometry_.first_node(cell);
    typename Form::Corner ve, ge, fe, re = {};
    gather(v, node, ve);
    if (data.body_force) gather(data.body_force, node, fe);
    const double p = pressure ? pressure[cell] : 0.0;
    const CutCell<D>* cut = geometry_.cut(cell);
    if (cut || data.body_force) {
      const bool wall = cut && data.wall_velocity;
      if (wall) gather(data.wall_velocity, node, ge);
      form_.residual(weights(cell), ve, wall ? ge : nullptr, data.body_force ? fe : nullptr, p, eta,
                     re);
    } else {
      constexpr int n = Form::kSize;
      const double* x = &ve[0][0];
      double* y = &re[0][0];
      for (int i = 0; i < n; ++i) {
        double sum = 0.0;
        for (int j = 0; j < n; ++j) sum += full_matrix_[u(j * n + i)] * x[j];
        y[i] = eta * sum;
      }
      // div of a corner's shape function: the mean of its gradient, +-1 / (2^(D-1) h) per axis
      for (int i = 0; i < kCorners; ++i)
        for (int a = 0; a < D; ++a) {
          const double sign = StokesGrid<D>::corner_bit(i, a) ? 1.0 : -1.0;
          re[i][a] -= p * sign * grid.face_area(a) / (kCorners / 2);
        }
    }
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a) r[(node + grid.corner_offset[i]) * D + a] += re[i][a];
  });
  add_face_residual(
      v, eta, [](std::int64_t, int, FaceKind, const FaceTerm& term) { return term.weight; }, r,
      pool);
  if (data.traction) add_traction(data.traction, r);
}

template <int D>
void FlowOperator<D>::add_pressure_force(const double* p, double* r, ThreadPool& pool) const {
  const StokesGrid<D>& grid = geometry_.grid();
  run_colors(geometry_.cell_colors(), pool, [&](std::int64_t cell) {
    if (p[cell] == 0.0) return;
    typename Form::Corner c;
    form_.divergence(weights(cell), c);
    const std::int64_t node = geometry_.first_node(cell);
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a) r[(node + grid.corner_offset[i]) * D + a] -= p[cell] * c[i][a];
  });
}

template <int D>
void FlowOperator<D>::add_traction(const double* traction, double* r) const {
  constexpr int kFace = kCorners / 2;
  for (const OpenFace& face : open_faces_) {
    Dual<D + 1> moments[pow3(D - 1)];
    geometry_.face_moments(face.cell, face.axis, face.side, phi_.data(), moments);
    for_face_points<D>(geometry_.grid(), geometry_.first_node(face.cell), face.axis, face.side,
                       [&](int q, const std::int64_t* nodes, const double* N) {
                         for (int a = 0; a < D; ++a) {
                           double t = 0.0;
                           for (int i = 0; i < kFace; ++i) t += N[i] * traction[nodes[i] * D + a];
                           for (int i = 0; i < kFace; ++i)
                             r[nodes[i] * D + a] -= moments[q].value * t * N[i];
                         }
                       });
  }
}

template <int D>
void FlowOperator<D>::outflow(const double* v, const double* wall_velocity, double* C,
                              ThreadPool& pool) const {
  const StokesGrid<D>& grid = geometry_.grid();
  std::fill(C, C + grid.num_cells, 0.0);
  run_colors(geometry_.cell_colors(), pool, [&](std::int64_t cell) {
    const std::int64_t node = geometry_.first_node(cell);
    const CutCell<D>* cut = geometry_.cut(cell);
    typename Form::Corner ve, ge;
    gather(v, node, ve);
    if (cut) {
      if (wall_velocity) gather(wall_velocity, node, ge);
      C[cell] = form_.outflow(weights(cell), ve, wall_velocity ? ge : nullptr);
      return;
    }
    double sum = 0.0;
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a)
        sum += (StokesGrid<D>::corner_bit(i, a) ? 1.0 : -1.0) * grid.face_area(a) * ve[i][a];
    C[cell] = sum / (kCorners / 2);
  });
}

template <int D>
void FlowOperator<D>::gradient(const double* v, const double* z, const FlowData& data,
                               const double* p, const double* pi, const double* by_volume,
                               const double* by_mass, double eta, double* grad_phi,
                               const FlowDataGradient& grad, ThreadPool& pool) const {
  using Cut = CutCell<D>;
  const StokesGrid<D>& grid = geometry_.grid();
  const std::vector<std::int64_t>& cut_cells = geometry_.cut_cells();
  const std::int64_t num_cuts = static_cast<std::int64_t>(cut_cells.size());
  std::vector<double> by_value(u(num_cuts) * Cut::kSize, 0.0);
  std::vector<std::int64_t> cut_of(u(grid.num_cells), -1);
  for (std::int64_t i = 0; i < num_cuts; ++i) cut_of[u(cut_cells[u(i)])] = i;

  // Forms of cells. Nodal gradients are added to in color order.
  run_colors(geometry_.cell_colors(), pool, [&](std::int64_t cell) {
    const Cut* cut = geometry_.cut(cell);
    if (!cut && !grad.body_force) return;
    const std::int64_t node = geometry_.first_node(cell);
    const CellWeights w = weights(cell);
    typename Form::Corner ve, ze, ge, fe;
    gather(z, node, ze);
    const auto scatter = [&](const typename Form::Corner e, double* out) {
      for (int i = 0; i < kCorners; ++i)
        for (int a = 0; a < D; ++a) out[(node + grid.corner_offset[i]) * D + a] -= e[i][a];
    };
    if (grad.body_force) {
      typename Form::Corner e = {};
      form_.force_gradient(w, ze, e);
      scatter(e, grad.body_force);
    }
    if (!cut) return;
    if (grad.wall_velocity) {
      typename Form::Corner e = {};
      form_.wall_gradient(w, ze, pi[cell], eta, e);
      scatter(e, grad.wall_velocity);
    }
    gather(v, node, ve);
    if (data.wall_velocity) gather(data.wall_velocity, node, ge);
    if (data.body_force) gather(data.body_force, node, fe);
    double* out = by_value.data() + cut_of[u(cell)] * Cut::kSize;
    form_.weight_gradient(
        w, ve, ze, data.wall_velocity ? ge : nullptr, data.body_force ? fe : nullptr, p[cell],
        pi[cell], eta, out + Cut::kVolume, out + Cut::kArea, out + Cut::kNormal, out + Cut::kFacet);
    const PressureVolume M = pressure_volume_terms(cell);
    const double by_fluid = by_volume[cell] + by_mass[cell] * M.by_fluid_volume;
    for (int k = 0; k < 2 * D; ++k) out[Cut::kAperture + k] += by_mass[cell] * M.by_open;
    for (int q = 0; q < Cut::kPoints; ++q) out[Cut::kVolume + q] += by_fluid;
  });

  // Penalties on faces; a face adds to two cells: one thread, fixed order.
  constexpr int kFace = kCorners / 2;
  for (int axis = 0; axis < D; ++axis) {
    int corners[kFace];
    face_corners<D>(axis, corners);
    for (FaceKind kind : kFaceKinds) {
      const bool inner = kind == FaceKind::kInner;
      for (const std::vector<std::int64_t>& list : geometry_.penalty_faces(axis, kind))
        for (std::int64_t cell : list) {
          const std::int64_t node = geometry_.first_node(cell);
          FaceTerm terms[2];
          const int count = face_terms(cell, axis, kind, terms);
          for (int t = 0; t < count; ++t) {
            double x[kFace][D], y[kFace][D], sum = 0.0;
            face_values<D>(grid, node, axis, corners, terms[t].stencil, face_layers(kind), v, x);
            face_values<D>(grid, node, axis, corners, terms[t].stencil, face_layers(kind), z, y);
            for (int i = 0; i < kFace; ++i)
              for (int j = 0; j < kFace; ++j)
                for (int a = 0; a < D; ++a)
                  sum += form_.basis().face_mass[axis][i][j] * x[i][a] * y[j][a];
            sum *= eta / grid.h[axis];
            for (int side = 0; side < (inner ? 2 : 1); ++side) {
              const std::int64_t index = cut_of[u(cell + side * grid.cell_stride[axis])];
              if (index < 0) continue;
              double* out = by_value.data() + index * Cut::kSize;
              const bool high = inner ? side == 0 : kind == FaceKind::kHigh;
              out[Cut::kAperture + 2 * axis + high] +=
                  geometry_.face_share(cell, axis, kind) * sum * terms[t].by_aperture;
              const double by_fraction = sum * terms[t].by_fraction[side] / grid.cell_volume;
              for (int q = 0; q < Cut::kPoints; ++q) out[Cut::kVolume + q] += by_fraction;
            }
          }
        }
    }
  }

  for (std::int64_t i = 0; i < num_cuts; ++i)
    if (geometry_.active(cut_cells[u(i)]))
      geometry_.cut_vjp(cut_cells[u(i)], phi_.data(), -1.0, by_value.data() + i * Cut::kSize,
                        grad_phi);

  if (!data.traction) return;
  for (const OpenFace& face : open_faces_) {
    Dual<D + 1> moments[pow3(D - 1)];
    geometry_.face_moments(face.cell, face.axis, face.side, phi_.data(), moments);
    double by_plane[Cut::kParameters] = {};
    for_face_points<D>(grid, geometry_.first_node(face.cell), face.axis, face.side,
                       [&](int q, const std::int64_t* nodes, const double* N) {
                         for (int a = 0; a < D; ++a) {
                           double t = 0.0, test = 0.0;
                           for (int i = 0; i < kFace; ++i) {
                             t += N[i] * data.traction[nodes[i] * D + a];
                             test += N[i] * z[nodes[i] * D + a];
                           }
                           for (int k = 0; k < Cut::kParameters; ++k)
                             by_plane[k] -= moments[q].grad[k] * t * test;
                           if (grad.traction)
                             for (int i = 0; i < kFace; ++i)
                               grad.traction[nodes[i] * D + a] += moments[q].value * N[i] * test;
                         }
                       });
    if (geometry_.cut(face.cell))
      geometry_.plane_vjp(face.cell, phi_.data(), by_plane, -1.0, grad_phi);
  }
}

template <int D>
void FlowOperator<D>::fraction_gradient(const double* grad_fraction, double* grad_phi) const {
  using Cut = CutCell<D>;
  for (std::int64_t cell : geometry_.cut_cells()) {
    if (!geometry_.active(cell)) continue;
    double by_value[Cut::kSize] = {}, by_plane[Cut::kParameters];
    for (int q = 0; q < Cut::kPoints; ++q)
      by_value[Cut::kVolume + q] = grad_fraction[cell] / geometry_.grid().cell_volume;
    geometry_.cut(cell)->vjp(by_value, by_plane);
    geometry_.plane_vjp(cell, phi_.data(), by_plane, 1.0, grad_phi);
  }
}

template class FlowOperator<2>;
template class FlowOperator<3>;

}  // namespace diffsim
