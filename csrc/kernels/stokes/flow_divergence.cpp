#include "kernels/stokes/flow_divergence.h"

#include "kernels/stokes/row_chunks.h"

namespace diffsim {

template <int D>
FlowDivergence<D>::FlowDivergence(const FlowOperator<D>& op, const std::vector<std::uint8_t>& fixed,
                                  double scale)
    : fixed_(fixed), number_(u(op.geometry().grid().num_cells), -1) {
  const FlowGeometry<D>& geometry = op.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  typename CellForm<D>::Corner c;
  const auto add_row = [&](const CellWeights& weights) {
    op.form().divergence(weights, c);
    for (int i = 0; i < kCorners * D; ++i) rows_.push_back(scale * (&c[0][0])[i]);
  };
  add_row({op.form().basis().weight, nullptr, nullptr, nullptr});
  about_.assign(geometry.active_nodes().size() * kCorners, -1);
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    if (!geometry.active(cell)) continue;
    number_[u(cell)] = static_cast<std::int32_t>(cells_.size());
    cells_.push_back(cell);
    const std::int64_t first = geometry.first_node(cell);
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t node = geometry.unknown_node(first + grid.corner_offset[i]);
      nodes_.push_back(static_cast<std::int32_t>(node));
      about_[u(node * kCorners + i)] = number_[u(cell)];
    }
    row_index_.push_back(0);
    if (!geometry.cut(cell)) continue;
    row_index_.back() = static_cast<std::int32_t>(rows_.size() / (kCorners * D));
    add_row(op.weights(cell));
  }
}

template <int D>
bool FlowDivergence<D>::rigid(std::int64_t cell) const {
  for (int i = 0; i < kCorners; ++i)
    for (int a = 0; a < D; ++a)
      if (!fixed_[u(node(cell, i) * D + a)]) return false;
  return true;
}

template <int D>
void FlowDivergence<D>::add_gradient(double scale, const double* p, double* y,
                                     ThreadPool& pool) const {
  for_chunks(static_cast<std::int64_t>(fixed_.size()) / D, pool, [&](std::int64_t node) {
    double sum[D] = {};
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t cell = cell_about(node, i);
      if (cell < 0) continue;
      const double* c = row(cell) + i * D;
      for (int a = 0; a < D; ++a) sum[a] += p[cell] * c[a];
    }
    for (int a = 0; a < D; ++a)
      if (!fixed_[u(node * D + a)]) y[node * D + a] += scale * sum[a];
  });
}

template <int D>
void FlowDivergence<D>::take(const double* v, double* q, ThreadPool& pool) const {
  for_chunks(size(), pool, [&](std::int64_t cell) {
    const double* c = row(cell);
    double sum[D] = {};  // chains that do not wait for each other
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t at = node(cell, i) * D;
      for (int a = 0; a < D; ++a) sum[a] += c[i * D + a] * v[at + a];
    }
    q[cell] = 0.0;
    for (int a = 0; a < D; ++a) q[cell] += sum[a];
  });
}

template class FlowDivergence<2>;
template class FlowDivergence<3>;

}  // namespace diffsim
