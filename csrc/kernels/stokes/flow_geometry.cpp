#include "kernels/stokes/flow_geometry.h"

#include <algorithm>

#include "kernels/stokes/wall_normal.h"

namespace diffsim {

namespace {

/// Cells of one color share no node: even or odd along each axis.
template <int D>
int cell_color(const std::int64_t* at) {
  int color = 0;
  for (int a = 0; a < D; ++a) color = 2 * color + static_cast<int>(at[a] % 2);
  return color;
}
template <int D>
constexpr int kCellColors = 1 << D;

/// Faces of one color share no node: their penalties couple three layers of nodes along the axis.
template <int D>
int face_color(const std::int64_t* at, int axis) {
  int color = static_cast<int>(at[axis] % 3);
  for (int a = 0; a < D; ++a)
    if (a != axis) color = 2 * color + static_cast<int>(at[a] % 2);
  return color;
}
template <int D>
constexpr int kFaceColors = 3 << (D - 1);

}  // namespace

template <int D>
FlowGeometry<D>::FlowGeometry(const StokesGrid<D>& grid, const double* phi, bool curved,
                              ThreadPool& pool)
    : grid_(grid),
      curved_(curved),
      fraction_(u(grid.num_cells), 0.0),
      cut_index_(u(grid.num_cells), -1) {
  classify_cells(phi);
  make_cuts(phi, pool);
  if (curved_) make_wall_normals(phi);
  color_cells();
  color_penalty_faces();
  number_nodes();
}

template <int D>
template <typename T, typename Field>
CellPlane<D, T> FlowGeometry<D>::plane(std::int64_t cell, Field&& phi, CellKind& kind) const {
  if constexpr (D == 2) {
    std::int64_t at[2];
    grid_.cell_position(cell, at);
    const ChordPatch patch(grid_, at);
    T value[ChordPatch::kNodes];
    patch.for_nodes(grid_, [&](std::int64_t node, int index) { value[index] = phi(node, index); });
    settle_corners(patch, value);
    return chord_plane(patch, value, kind);
  } else {
    const std::int64_t node = first_node(cell);
    T corner[1 << D];
    for (int i = 0; i < 1 << D; ++i) corner[i] = phi(node + grid_.corner_offset[i], i);
    const CellPlane<D, T> fit(corner);
    kind = fit.kind();
    return fit;
  }
}

template <int D>
void FlowGeometry<D>::classify_cells(const double* phi) {
  for (std::int64_t cell = 0; cell < grid_.num_cells; ++cell) {
    CellKind kind;
    plane<double>(cell, [&](std::int64_t node, int) { return phi[node]; }, kind);
    if (kind == CellKind::kFull) fraction_[u(cell)] = 1.0;
    if (kind != CellKind::kCut) continue;
    cut_index_[u(cell)] = static_cast<std::int32_t>(cut_cells_.size());
    cut_cells_.push_back(cell);
  }
}

template <int D>
void FlowGeometry<D>::make_cuts(const double* phi, ThreadPool& pool) {
  constexpr std::int64_t kChunk = 16;
  const std::int64_t num_cuts = static_cast<std::int64_t>(cut_cells_.size());
  std::vector<std::vector<CutCell<D>>> made(u((num_cuts + kChunk - 1) / kChunk));
  pool.run(static_cast<std::int64_t>(made.size()), [&](std::int64_t task) {
    made[u(task)].reserve(kChunk);
    for (std::int64_t i = task * kChunk; i < std::min(num_cuts, (task + 1) * kChunk); ++i)
      made[u(task)].emplace_back(plane(cut_cells_[u(i)], phi), grid_.h);
  });
  cuts_.reserve(u(num_cuts));
  for (const std::vector<CutCell<D>>& part : made)
    cuts_.insert(cuts_.end(), part.begin(), part.end());
  for (std::int64_t i = 0; i < num_cuts; ++i) {
    double volume = 0.0;
    for (int q = 0; q < CutCell<D>::kPoints; ++q) volume += cuts_[u(i)].volume()[q];
    fraction_[u(cut_cells_[u(i)])] = volume / grid_.cell_volume;
  }
}

template <int D>
void FlowGeometry<D>::make_wall_normals(const double* phi) {
  wall_normals_.resize(cuts_.size() * D);
  for (std::size_t i = 0; i < cuts_.size(); ++i) {
    const FacetMeans<D> means(cuts_[i].area());
    double* normal = wall_normals_.data() + i * D;
    if (means.area > 0.0)
      WallNormal<D>(
          grid_, [&](std::int64_t node) { return phi[node]; }, first_node(cut_cells_[i]),
          means.value, cuts_[i].normal())
          .normal(normal);
    else
      std::copy_n(cuts_[i].normal(), D, normal);
  }
}

template <int D>
void FlowGeometry<D>::cut_vjp(std::int64_t cell, const double* phi, double sign, double* by_value,
                              double* grad_phi) const {
  using Cut = CutCell<D>;
  const Cut& c = *cut(cell);
  if (curved_) {
    for (int a = 0; a < D && D == 3; ++a) {  // one normal
      by_value[Cut::kNormal + a] += by_value[Cut::kFacet + a];
      by_value[Cut::kFacet + a] = 0.0;
    }
    const FacetMeans<D> means(c.area());
    double by_mean[1 << D], by_plane_normal[D];
    if (means.area > 0.0) {
      const std::int64_t node = first_node(cell);
      WallNormal<D>(
          grid_, [&](std::int64_t i) { return phi[i]; }, node, means.value, c.normal())
          .vjp(grid_, node, by_value + Cut::kNormal, sign, by_mean, by_plane_normal, grad_phi);
      means.vjp(by_mean, by_value + Cut::kArea);
      std::copy_n(by_plane_normal, D, by_value + Cut::kNormal);
    }
  }
  double by_plane[Cut::kParameters];
  c.vjp(by_value, by_plane);
  plane_vjp(cell, phi, by_plane, sign, grad_phi);
}

template <int D>
void FlowGeometry<D>::cut_tangent(std::int64_t cell, const double* phi, const double* d_phi,
                                  Dual<1>* value) const {
  using Cut = CutCell<D>;
  const Cut& c = *cut(cell);
  const auto moving = [](double at, double rate) {
    Dual<1> x(at);
    x.grad[0] = rate;
    return x;
  };
  double d_plane[Cut::kParameters], d_value[Cut::kSize];
  plane_tangent(cell, phi, d_phi, d_plane);
  c.tangent(d_plane, d_value);
  for (int k = 0; k < Cut::kSize; ++k) value[k] = moving(c.value[k], d_value[k]);
  if (!curved_) return;
  const FacetMeans<D, Dual<1>> means(value + Cut::kArea);
  if (!(means.area.value > 0.0)) return;
  Dual<1> normal[D];
  WallNormal<D, Dual<1>>(
      grid_, [&](std::int64_t node) { return moving(phi[node], d_phi[node]); }, first_node(cell),
      means.value, value + Cut::kNormal)
      .normal(normal);
  std::copy_n(normal, D, value + Cut::kNormal);
  if (D == 3) std::copy_n(normal, D, value + Cut::kFacet);
}

template <int D>
void FlowGeometry<D>::plane_vjp(std::int64_t cell, const double* phi, const double* by_plane,
                                double sign, double* grad_phi) const {
  using T = Dual<kPlaneNodes>;
  std::int64_t nodes[kPlaneNodes];
  std::fill_n(nodes, kPlaneNodes, std::int64_t{-1});
  CellKind kind;
  const CellPlane<D, T> p = plane<T>(
      cell,
      [&](std::int64_t node, int index) {
        nodes[index] = node;
        return T::parameter(phi[node], index);
      },
      kind);
  for (int i = 0; i < kPlaneNodes; ++i) {
    if (nodes[i] < 0) continue;
    double sum = by_plane[0] * p.c.grad[i];
    for (int a = 0; a < D; ++a) sum += by_plane[1 + a] * p.g[a].grad[i];
    grad_phi[nodes[i]] += sign * sum;
  }
}

template <int D>
void FlowGeometry<D>::plane_tangent(std::int64_t cell, const double* phi, const double* d_phi,
                                    double* d_plane) const {
  using T = Dual<1>;
  CellKind kind;
  const CellPlane<D, T> p = plane<T>(
      cell,
      [&](std::int64_t node, int) {
        T value(phi[node]);
        value.grad[0] = d_phi[node];
        return value;
      },
      kind);
  d_plane[0] = p.c.grad[0];
  for (int a = 0; a < D; ++a) d_plane[1 + a] = p.g[a].grad[0];
}

template <int D>
void FlowGeometry<D>::color_cells() {
  cell_colors_.resize(kCellColors<D>);
  for_active_cells([&](std::int64_t cell, const std::int64_t* at) {
    ++num_active_cells_;
    cell_colors_[u(cell_color<D>(at))].push_back(cell);
  });
}

template <int D>
void FlowGeometry<D>::color_penalty_faces() {
  for (auto& kinds : penalty_faces_)
    for (Colors& colors : kinds) colors.resize(kFaceColors<D>);
  for_active_cells([&](std::int64_t cell, const std::int64_t* at) {
    for (int axis = 0; axis < D; ++axis) {
      const int color = face_color<D>(at, axis);
      const auto add = [&](FaceKind kind) {
        penalty_faces_[axis][static_cast<int>(kind)][u(color)].push_back(cell);
      };
      const std::int64_t stride = grid_.cell_stride[axis];
      const bool low = at[axis] > 0 && active(cell - stride);
      const bool high = at[axis] + 1 < grid_.cells[axis] && active(cell + stride);
      if (cut(cell) && !low) add(FaceKind::kLow);
      if (cut(cell) && !high) add(FaceKind::kHigh);
      if (high && (cut(cell) || cut(cell + stride))) add(FaceKind::kInner);
    }
  });
}

template <int D>
void FlowGeometry<D>::number_nodes() {
  unknown_node_.assign(u(grid_.num_nodes), -1);
  for_active_cells([&](std::int64_t, const std::int64_t* at) {
    const std::int64_t node = grid_.first_node(at);
    for (std::int64_t offset : grid_.corner_offset) unknown_node_[u(node + offset)] = 0;
  });
  for (std::int64_t node = 0; node < grid_.num_nodes; ++node) {
    if (unknown_node_[u(node)] < 0) continue;
    unknown_node_[u(node)] = static_cast<std::int64_t>(active_nodes_.size());
    active_nodes_.push_back(node);
  }
}

template <int D>
void FlowGeometry<D>::face_moments(std::int64_t cell, int axis, int side, const double* phi,
                                   Dual<D + 1>* moments) const {
  using T = Dual<D + 1>;
  constexpr int kPoints = pow3(D - 1);
  if (!active(cell)) {
    for (int q = 0; q < kPoints; ++q) moments[q] = T(0.0);
    return;
  }
  const CellPlane<D> p = plane(cell, phi);
  if (!cut(cell)) {
    double g[D] = {}, whole[kPoints];
    CutCell<D>::template face_moments<double>(1.0, g, axis, side, whole);
    for (int q = 0; q < kPoints; ++q) moments[q] = T(whole[q] * grid_.face_area(axis));
    return;
  }
  T g[D];
  for (int a = 0; a < D; ++a) g[a] = T::parameter(p.g[a], 1 + a);
  CutCell<D>::face_moments(T::parameter(p.c, 0), g, axis, side, moments);
  for (int q = 0; q < kPoints; ++q) moments[q] *= grid_.face_area(axis);
}

template class FlowGeometry<2>;
template class FlowGeometry<3>;

}  // namespace diffsim
