#include "kernels/stokes/flow_tangent.h"

namespace diffsim {

template <int D>
FlowTangent<D>::FlowTangent(const FlowOperator<D>& op, const double* d_phi)
    : op_(op),
      index_(u(op.geometry().grid().num_cells), -1),
      fraction_(index_.size(), 0.0),
      d_phi_(d_phi, d_phi + op.geometry().grid().num_nodes) {
  const FlowGeometry<D>& geometry = op.geometry();
  std::int64_t count = 0;
  for (std::int64_t cell : geometry.cut_cells())
    if (geometry.active(cell)) index_[u(cell)] = count++;
  values_.resize(u(count) * Cut::kSize);
  for (std::int64_t cell : geometry.cut_cells()) {
    if (!geometry.active(cell)) continue;
    Rate* value = values_.data() + index_[u(cell)] * Cut::kSize;
    geometry.cut_tangent(cell, op.phi(), d_phi, value);
    for (int q = 0; q < Cut::kPoints; ++q)
      fraction_[u(cell)] += value[Cut::kVolume + q].grad[0] / geometry.grid().cell_volume;
  }
}

template <int D>
double FlowTangent<D>::face_aperture(std::int64_t cell, int axis, FaceKind kind) const {
  double sum = aperture(cell, axis, kind != FaceKind::kLow);
  if (kind == FaceKind::kInner)
    sum += aperture(cell + op_.geometry().grid().cell_stride[axis], axis, 0);
  return op_.geometry().face_share(cell, axis, kind) * sum;
}

template <int D>
void FlowTangent<D>::add_momentum(const double* v, const FlowData& data, const double* p,
                                  double eta, double* r, ThreadPool& pool) const {
  const StokesGrid<D>& grid = op_.geometry().grid();
  run_colors(op_.geometry().cell_colors(), pool, [&](std::int64_t cell) {
    if (index_[u(cell)] < 0) return;
    const std::int64_t node = op_.geometry().first_node(cell);
    const Rate* value = values(cell);
    typename Form::Corner ve, ge, fe;
    op_.gather(v, node, ve);
    if (data.wall_velocity) op_.gather(data.wall_velocity, node, ge);
    if (data.body_force) op_.gather(data.body_force, node, fe);
    Rate re[Form::kCorners][D];
    op_.form().residual(CellWeightsOf<Rate>{value + Cut::kVolume, value + Cut::kArea,
                                            value + Cut::kNormal, value + Cut::kFacet},
                        ve, data.wall_velocity ? ge : nullptr, data.body_force ? fe : nullptr,
                        p[cell], eta, re);
    for (int i = 0; i < Form::kCorners; ++i)
      for (int a = 0; a < D; ++a) r[(node + grid.corner_offset[i]) * D + a] += re[i][a].grad[0];
  });
  op_.add_face_residual(
      v, eta,
      [&](std::int64_t cell, int axis, FaceKind kind, const FaceTerm& term) {
        double by_fraction = term.by_fraction[0] * fraction_[u(cell)];
        if (kind == FaceKind::kInner)
          by_fraction += term.by_fraction[1] * fraction_[u(cell + grid.cell_stride[axis])];
        return by_fraction + term.by_aperture * face_aperture(cell, axis, kind);
      },
      r, pool);
  if (data.traction) add_traction(data.traction, r);
}

template <int D>
void FlowTangent<D>::add_mass(const double* v, const double* wall_velocity, double* C,
                              ThreadPool& pool) const {
  run_colors(op_.geometry().cell_colors(), pool, [&](std::int64_t cell) {
    if (index_[u(cell)] < 0) return;
    const std::int64_t node = op_.geometry().first_node(cell);
    const Rate* value = values(cell);
    typename Form::Corner ve, ge;
    op_.gather(v, node, ve);
    if (wall_velocity) op_.gather(wall_velocity, node, ge);
    C[cell] += op_.form()
                   .outflow(CellWeightsOf<Rate>{value + Cut::kVolume, value + Cut::kArea,
                                                value + Cut::kNormal, value + Cut::kFacet},
                            ve, wall_velocity ? ge : nullptr)
                   .grad[0];
  });
}

template <int D>
double FlowTangent<D>::pressure_volume(std::int64_t cell) const {
  if (index_[u(cell)] < 0) return 0.0;
  const PressureVolume M = op_.pressure_volume_terms(cell);
  double open = 0.0;
  for (int k = 0; k < 2 * D; ++k) open += values(cell)[Cut::kAperture + k].grad[0];
  return M.by_fluid_volume * fluid_volume(cell) + M.by_open * open;
}

template <int D>
void FlowTangent<D>::add_traction(const double* traction, double* r) const {
  constexpr int kFace = Form::kCorners / 2;
  const FlowGeometry<D>& geometry = op_.geometry();
  for (const OpenFace& face : op_.open_faces()) {
    if (!geometry.cut(face.cell)) continue;
    Dual<D + 1> moments[pow3(D - 1)];
    geometry.face_moments(face.cell, face.axis, face.side, op_.phi(), moments);
    double d_plane[Cut::kParameters];
    geometry.plane_tangent(face.cell, op_.phi(), d_phi_.data(), d_plane);
    for_face_points<D>(geometry.grid(), geometry.first_node(face.cell), face.axis, face.side,
                       [&](int q, const std::int64_t* nodes, const double* N) {
                         double rate = 0.0;
                         for (int k = 0; k < Cut::kParameters; ++k)
                           rate += moments[q].grad[k] * d_plane[k];
                         for (int a = 0; a < D; ++a) {
                           double t = 0.0;
                           for (int i = 0; i < kFace; ++i) t += N[i] * traction[nodes[i] * D + a];
                           for (int i = 0; i < kFace; ++i) r[nodes[i] * D + a] -= rate * t * N[i];
                         }
                       });
  }
}

template class FlowTangent<2>;
template class FlowTangent<3>;

}  // namespace diffsim
