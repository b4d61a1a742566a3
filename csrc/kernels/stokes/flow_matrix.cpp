#include "kernels/stokes/flow_matrix.h"

#include <algorithm>
#include <array>
#include <map>

#include "kernels/stokes/equal_rows.h"
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

void MatrixRows::add(std::int64_t num_blocks) {
  holder.push_back(num_nodes());
  of.push_back(static_cast<std::int32_t>(num_rows()) - 1);
  begin.push_back(begin.back() + num_blocks);
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
MatrixRows FlowMatrix<D>::own_rows() const {
  MatrixRows rows;
  for (const NodeStencil& s : stencils_) rows.add(s.count());
  return rows;
}

/// Nodes of cut cells and of faces with a penalty: (num_nodes,) nonzero.
template <int D>
std::vector<std::uint8_t> FlowMatrix<D>::near_walls() const {
  const FlowGeometry<D>& geometry = op_.geometry();
  std::vector<std::uint8_t> near(stencils_.size(), 0);
  for (std::int64_t cell : geometry.cut_cells())
    for (int i = 0; i < kCorners && geometry.active(cell); ++i)
      near[u(geometry.unknown_node(geometry.first_node(cell) + geometry.grid().corner_offset[i]))] =
          1;
  for (int axis = 0; axis < D; ++axis)
    for (const std::vector<std::int64_t>& cells : geometry.penalty_faces(axis, FaceKind::kInner))
      for (std::int64_t cell : cells)
        for (std::int64_t offset : patch_offset_[axis])
          near[u(geometry.unknown_node(geometry.first_node(cell) + offset))] = 1;
  return near;  // other faces with a penalty are those of cut cells
}

/// A row is told by the cells about its node, all full, and by the prescribed values among them.
template <int D>
MatrixRows FlowMatrix<D>::shared_rows(const std::uint8_t* fixed) const {
  constexpr int kWords = (pow3(D) * D + 63) / 64;
  struct Told {
    std::array<std::uint64_t, 2 + kWords> words{};
    bool operator<(const Told& other) const { return words < other.words; }
  };
  const FlowGeometry<D>& geometry = op_.geometry();
  const std::vector<std::uint8_t> near = near_walls();
  const std::vector<std::int32_t> neighbors = columns<std::int32_t>();
  std::vector<std::uint8_t> held(stencils_.size(), 0);  // a bit for each axis
  for (std::size_t i = 0; i < held.size(); ++i)
    for (int a = 0; a < D; ++a)
      if (fixed[geometry.active_nodes()[i] * D + a])
        held[i] = static_cast<std::uint8_t>(held[i] | 1 << a);
  std::map<Told, std::int32_t> known;
  MatrixRows rows;
  for (std::size_t i = 0; i < near.size(); ++i) {
    if (near[i]) {
      rows.add(stencils_[i].count());
      continue;
    }
    Told told;
    std::copy_n(stencils_[i].bits, 2, told.words.begin());
    for (std::int64_t k = indptr_[i], bit = 0; k < indptr_[i + 1]; ++k)
      for (int a = 0; a < D; ++a, ++bit)
        if (held[u(neighbors[u(k)])] >> a & 1)
          told.words[u(2 + bit / 64)] |= std::uint64_t{1} << (bit % 64);
    const auto found = known.find(told);
    if (found != known.end()) {
      rows.add_known(found->second);
      continue;
    }
    rows.add(stencils_[i].count());
    known.emplace(told, rows.of.back());
  }
  return rows;
}

template <int D>
void FlowMatrix<D>::merge_equal(MatrixRows& rows, std::vector<double>& values) const {
  std::vector<std::int64_t> begin(rows.begin), start;
  for (std::int64_t& at : begin) at *= D * D;
  const auto alike = [&](std::int64_t i, std::int64_t k) {
    return stencils_[u(rows.holder[u(i)])] == stencils_[u(rows.holder[u(k)])];
  };
  values.resize(u(keep_distinct_rows(values.data(), begin, alike, start)));
  MatrixRows merged;
  std::vector<std::int32_t> number(u(rows.num_rows()), -1);
  std::map<std::int64_t, std::int32_t> at_start;
  for (std::int64_t i = 0; i < rows.num_nodes(); ++i) {
    std::int32_t& known = number[u(rows.of[u(i)])];
    if (known < 0) {
      const auto [place, is_new] =
          at_start.emplace(start[u(rows.of[u(i)])], static_cast<std::int32_t>(merged.num_rows()));
      known = place->second;
      if (is_new) {
        merged.add(stencils_[u(i)].count());
        continue;
      }
    }
    merged.add_known(known);
  }
  rows = std::move(merged);
}

template <int D>
template <typename Index>
std::vector<Index> FlowMatrix<D>::columns() const {
  const FlowGeometry<D>& geometry = op_.geometry();
  constexpr int kBits = D == 2 ? 25 : 125;
  std::int64_t offset[kBits];
  for (int bit = 0; bit < kBits; ++bit) {
    offset[bit] = 0;
    for (int a = D - 1, rest = bit; a >= 0; --a, rest /= 5)
      offset[bit] += (rest % 5 - 2) * geometry.grid().node_stride[a];
  }
  std::vector<Index> indices(u(num_blocks()));
  for (std::size_t i = 0; i < stencils_.size(); ++i) {
    const std::int64_t node = geometry.active_nodes()[i];
    std::int64_t next = indptr_[i];
    for (int bit = 0; bit < kBits; ++bit)
      if (stencils_[i].test(bit))
        indices[u(next++)] = static_cast<Index>(geometry.unknown_node(node + offset[bit]));
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
  const std::vector<std::int64_t> indices = columns<std::int64_t>();
  StokesPlan::Symbolic made = analyze_cholesky(num_nodes(), indptr_.data(), indices.data(),
                                               coords.data(), D, absent.data(), true);
  plan.keep(geometry.active_nodes(), stencils_, made);
  return made;
}

template <int D>
void FlowMatrix<D>::add_cells(double bulk, const MatrixRows& rows, double* values,
                              ThreadPool& pool) const {
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
      if (!rows.holds(row)) continue;
      for (int j = 0; j < kCorners; ++j) {
        double* out = block(values, rows, row, cell_bit_[i][j]);
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b) out[a * D + b] += A[(i * D + a) * n + j * D + b];
      }
    }
  });
}

template <int D>
void FlowMatrix<D>::add_faces(const MatrixRows& rows, double* values, ThreadPool& pool) const {
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
            double* out = block(values, rows, row, patch_bit_[axis][i][j]);
            for (int a = 0; a < D; ++a) out[a * D + a] += entry;
          }
        }
      });
}

template <int D>
std::vector<double> FlowMatrix<D>::assemble(const std::uint8_t* fixed, double bulk,
                                            const MatrixRows& rows, ThreadPool& pool) const {
  const FlowGeometry<D>& geometry = op_.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  std::vector<double> values(u(rows.begin.back()) * D * D, 0.0);
  add_cells(bulk, rows, values.data(), pool);
  add_faces(rows, values.data(), pool);

  constexpr int kBits = D == 2 ? 25 : 125;
  const double unit = grid.cell_volume / (grid.h_min * grid.h_min);  // as large as other entries
  constexpr std::int64_t kChunk = 1024;
  pool.run((num_nodes() + kChunk - 1) / kChunk, [&](std::int64_t task) {
    for (std::int64_t i = task * kChunk; i < std::min(num_nodes(), (task + 1) * kChunk); ++i) {
      if (!rows.holds(i)) continue;
      const std::int64_t node = geometry.active_nodes()[u(i)];
      double* out = values.data() + rows.first(i) * D * D;
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
std::vector<double> FlowMatrix<D>::diagonal(const std::vector<double>& values,
                                            const MatrixRows& rows) const {
  constexpr int kMiddle = D == 2 ? 12 : 62;  // the node itself, of 5^D
  std::vector<double> blocks(u(num_nodes()) * D * D);
  for (std::int64_t i = 0; i < num_nodes(); ++i)
    std::copy_n(values.data() + (rows.first(i) + stencils_[u(i)].rank(kMiddle)) * D * D, D * D,
                blocks.data() + i * D * D);
  return blocks;
}

template class FlowMatrix<2>;
template class FlowMatrix<3>;
template std::vector<std::int32_t> FlowMatrix<2>::columns<std::int32_t>() const;
template std::vector<std::int32_t> FlowMatrix<3>::columns<std::int32_t>() const;

}  // namespace diffsim
