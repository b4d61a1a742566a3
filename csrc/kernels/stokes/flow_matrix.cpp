#include "kernels/stokes/flow_matrix.h"

#include <algorithm>

#include "kernels/subscript.h"

namespace diffsim {
namespace {

template <int D>
int stencil_bit(const int* from, const int* to) {
  int bit = 0;
  for (int a = 0; a < D; ++a) bit = 5 * bit + to[a] - from[a] + 2;
  return bit;
}

}  // namespace

StokesPlan::Symbolic StokesPlan::find(const std::vector<std::int64_t>& nodes,
                                      const std::vector<NodeStencil>& stencils) {
  const std::lock_guard<std::mutex> lock(mutex_);
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    if (entries_[i].nodes != nodes || !(entries_[i].stencils == stencils)) continue;
    std::rotate(entries_.begin() + static_cast<std::ptrdiff_t>(i),
                entries_.begin() + static_cast<std::ptrdiff_t>(i) + 1, entries_.end());
    return entries_.back().symbolic;
  }
  return nullptr;
}

void StokesPlan::keep(const std::vector<std::int64_t>& nodes,
                      const std::vector<NodeStencil>& stencils, Symbolic symbolic) {
  const std::lock_guard<std::mutex> lock(mutex_);
  entries_.push_back({nodes, stencils, std::move(symbolic)});
  if (entries_.size() > kKept) entries_.erase(entries_.begin());
}

template <int D>
FlowMatrix<D>::FlowMatrix(const FlowOperator<D>& op, ThreadPool& pool)
    : op_(op), stencils_(op.geometry().active_nodes().size()) {
  const FlowGeometry<D>& geometry = op.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  int at[kCorners][D];
  for (int i = 0; i < kCorners; ++i)
    for (int a = 0; a < D; ++a) at[i][a] = StokesGrid<D>::corner_bit(i, a);
  for (int i = 0; i < kCorners; ++i)
    for (int j = 0; j < kCorners; ++j) cell_bit_[i][j] = stencil_bit<D>(at[i], at[j]);
  for (int axis = 0; axis < D; ++axis) {
    int patch[kPatch][D], n = 0;
    for (int i = 0; i < kCorners; ++i) {
      if (at[i][axis]) continue;
      for (int layer = 0; layer < 3; ++layer, ++n) {
        std::copy(at[i], at[i] + D, patch[n]);
        patch[n][axis] = layer;
        patch_offset_[axis][n] = grid.corner_offset[i] + layer * grid.node_stride[axis];
      }
    }
    for (int i = 0; i < kPatch; ++i)
      for (int j = 0; j < kPatch; ++j) patch_bit_[axis][i][j] = stencil_bit<D>(patch[i], patch[j]);
  }

  run_colors(geometry.cell_colors(), pool, [&](std::int64_t cell) {
    const std::int64_t node = geometry.first_node(cell);
    for (int i = 0; i < kCorners; ++i) {
      NodeStencil& s = stencils_[u(geometry.unknown_node(node + grid.corner_offset[i]))];
      for (int j = 0; j < kCorners; ++j) s.set(cell_bit_[i][j]);
    }
  });
  for (int axis = 0; axis < D; ++axis)
    run_colors(geometry.penalty_faces(axis, FaceKind::kInner), pool, [&](std::int64_t cell) {
      const std::int64_t node = geometry.first_node(cell);
      for (int i = 0; i < kPatch; ++i) {
        NodeStencil& s = stencils_[u(geometry.unknown_node(node + patch_offset_[axis][i]))];
        for (int j = 0; j < kPatch; ++j) s.set(patch_bit_[axis][i][j]);
      }
    });
  indptr_.resize(stencils_.size() + 1);
  for (std::size_t i = 0; i < stencils_.size(); ++i)
    indptr_[i + 1] = indptr_[i] + stencils_[i].count();
}

template <int D>
std::vector<std::int64_t> FlowMatrix<D>::columns() const {
  const FlowGeometry<D>& geometry = op_.geometry();
  constexpr int kBits = D == 2 ? 25 : 125;
  std::int64_t offset[kBits];
  for (int bit = 0; bit < kBits; ++bit) {
    offset[bit] = 0;
    for (int a = D - 1, rest = bit; a >= 0; --a, rest /= 5)
      offset[bit] += (rest % 5 - 2) * geometry.grid().node_stride[a];
  }
  std::vector<std::int64_t> indices(u(num_blocks()));
  for (std::size_t i = 0; i < stencils_.size(); ++i) {
    const std::int64_t node = geometry.active_nodes()[i];
    std::int64_t next = indptr_[i];
    for (int bit = 0; bit < kBits; ++bit)
      if (stencils_[i].test(bit)) indices[u(next++)] = geometry.unknown_node(node + offset[bit]);
  }
  return indices;
}

template <int D>
StokesPlan::Symbolic FlowMatrix<D>::analyze(const std::uint8_t* fixed, StokesPlan& plan) const {
  const FlowGeometry<D>& geometry = op_.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  if (StokesPlan::Symbolic known = plan.find(geometry.active_nodes(), stencils_)) return known;
  std::vector<double> coords(stencils_.size() * 3, 0.0);
  std::vector<std::uint8_t> absent(stencils_.size() * D);
  for (std::size_t i = 0; i < stencils_.size(); ++i) {
    const std::int64_t node = geometry.active_nodes()[i];
    std::int64_t at[D];
    grid.node_position(node, at);
    std::copy(fixed + node * D, fixed + (node + 1) * D, absent.begin() + static_cast<long>(i) * D);
    for (int a = 0; a < D; ++a) coords[3 * i + u(a)] = static_cast<double>(at[a]);
  }
  const std::vector<std::int64_t> indices = columns();
  StokesPlan::Symbolic made = analyze_cholesky(num_nodes(), indptr_.data(), indices.data(),
                                               coords.data(), D, absent.data(), true);
  plan.keep(geometry.active_nodes(), stencils_, made);
  return made;
}

template <int D>
void FlowMatrix<D>::add_cells(double bulk, double* values, ThreadPool& pool) const {
  const FlowGeometry<D>& geometry = op_.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  constexpr int n = kCorners * D;
  std::vector<double> full(n * n);
  op_.form().matrix({op_.form().basis().weight, nullptr, nullptr},
                    bulk / PressureVolume(1.0, 2 * D, grid.cell_volume, op_.options()).value,
                    full.data());
  run_colors(geometry.cell_colors(), pool, [&](std::int64_t cell) {
    const std::int64_t node = geometry.first_node(cell);
    double cut[n * n];
    const double* A = full.data();
    if (geometry.cut(cell)) {
      op_.form().matrix(op_.weights(cell), bulk / op_.pressure_volume(cell), cut);
      A = cut;
    }
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t row = geometry.unknown_node(node + grid.corner_offset[i]);
      for (int j = 0; j < kCorners; ++j) {
        double* out = block(values, row, cell_bit_[i][j]);
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b) out[a * D + b] += A[(i * D + a) * n + j * D + b];
      }
    }
  });
}

template <int D>
void FlowMatrix<D>::add_faces(double* values, ThreadPool& pool) const {
  const FlowGeometry<D>& geometry = op_.geometry();
  for (int axis = 0; axis < D; ++axis)
    for (FaceKind kind : kFaceKinds)
      run_colors(geometry.penalty_faces(axis, kind), pool, [&](std::int64_t cell) {
        const std::int64_t node = geometry.first_node(cell);
        const int layers = face_layers(kind);
        FaceTerm terms[2];
        const int count = op_.face_terms(cell, axis, kind, terms);
        double across[3][3] = {};
        for (int t = 0; t < count; ++t)
          for (int l = 0; l < layers; ++l)
            for (int m = 0; m < layers; ++m)
              across[l][m] += terms[t].weight / geometry.grid().h[axis] * terms[t].stencil[l] *
                              terms[t].stencil[m];
        for (int i = 0; i < kPatch; ++i) {
          if (i % 3 >= layers) continue;
          const std::int64_t row = geometry.unknown_node(node + patch_offset_[axis][i]);
          for (int j = 0; j < kPatch; ++j) {
            if (j % 3 >= layers) continue;
            const double entry =
                across[i % 3][j % 3] * op_.form().basis().face_mass[axis][i / 3][j / 3];
            double* out = block(values, row, patch_bit_[axis][i][j]);
            for (int a = 0; a < D; ++a) out[a * D + a] += entry;
          }
        }
      });
}

template <int D>
std::vector<double> FlowMatrix<D>::assemble(const std::uint8_t* fixed, double bulk,
                                            ThreadPool& pool) const {
  const FlowGeometry<D>& geometry = op_.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  std::vector<double> values(u(num_blocks()) * D * D, 0.0);
  add_cells(bulk, values.data(), pool);
  add_faces(values.data(), pool);

  constexpr int kBits = D == 2 ? 25 : 125;
  const double unit = grid.cell_volume / (grid.h_min * grid.h_min);  // as large as other entries
  constexpr std::int64_t kChunk = 1024;
  pool.run((num_nodes() + kChunk - 1) / kChunk, [&](std::int64_t task) {
    for (std::int64_t i = task * kChunk; i < std::min(num_nodes(), (task + 1) * kChunk); ++i) {
      const std::int64_t node = geometry.active_nodes()[u(i)];
      double* out = values.data() + indptr_[u(i)] * D * D;
      for (int bit = 0; bit < kBits; ++bit) {
        if (!stencils_[u(i)].test(bit)) continue;
        std::int64_t other = node;
        for (int a = D - 1, rest = bit; a >= 0; --a, rest /= 5)
          other += (rest % 5 - 2) * grid.node_stride[a];
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b)
            if (fixed[node * D + a] || fixed[other * D + b])
              out[a * D + b] = node == other && a == b ? unit : 0.0;
        out += D * D;
      }
    }
  });
  return values;
}

template <int D>
std::vector<double> FlowMatrix<D>::diagonal(const std::vector<double>& values) const {
  constexpr int kMiddle = D == 2 ? 12 : 62;  // the node itself, of 5^D
  std::vector<double> blocks(u(num_nodes()) * D * D);
  for (std::int64_t i = 0; i < num_nodes(); ++i)
    std::copy_n(values.data() + (indptr_[u(i)] + stencils_[u(i)].rank(kMiddle)) * D * D, D * D,
                blocks.data() + i * D * D);
  return blocks;
}

template class FlowMatrix<2>;
template class FlowMatrix<3>;

}  // namespace diffsim
