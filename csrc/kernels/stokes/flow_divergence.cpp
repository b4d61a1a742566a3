#include "kernels/stokes/flow_divergence.h"

#include "kernels/stokes/row_chunks.h"

namespace diffsim {

template <int D>
FlowDivergence<D>::FlowDivergence(const FlowOperator<D>& op, const std::vector<std::uint8_t>& fixed,
                                  double scale)
    : op_(op), fixed_(fixed), number_(u(op.geometry().grid().num_cells), -1) {
  const FlowGeometry<D>& geometry = op.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  typename CellForm<D>::Corner c;
  const auto scaled = [&](const CellWeights& weights, double* out) {
    op.form().divergence(weights, c);
    for (int i = 0; i < kCorners * D; ++i) out[i] = scale * (&c[0][0])[i];
  };
  scaled({op.form().basis().weight, nullptr, nullptr, nullptr}, full_);
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    if (!geometry.active(cell)) continue;
    number_[u(cell)] = static_cast<std::int32_t>(cells_.size());
    cells_.push_back(cell);
    const std::int64_t first = geometry.first_node(cell);
    for (std::int64_t offset : grid.corner_offset)
      nodes_.push_back(static_cast<std::int32_t>(geometry.unknown_node(first + offset)));
    cut_index_.push_back(-1);
    if (!geometry.cut(cell)) continue;
    cut_index_.back() = static_cast<std::int32_t>(cut_.size() / (kCorners * D));
    cut_.resize(cut_.size() + kCorners * D);
    scaled(op.weights(cell), cut_.data() + cut_.size() - kCorners * D);
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
  run_colors(op_.geometry().cell_colors(), pool, [&](std::int64_t grid_cell) {
    const std::int64_t cell = number(grid_cell);
    const double* c = row(cell);
    const double value = scale * p[cell];
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t at = node(cell, i) * D;
      for (int a = 0; a < D; ++a)
        if (!fixed_[u(at + a)]) y[at + a] += value * c[i * D + a];
    }
  });
}

template <int D>
void FlowDivergence<D>::take(const double* v, double* q, ThreadPool& pool) const {
  for_chunks(size(), pool, [&](std::int64_t cell) {
    const double* c = row(cell);
    double sum = 0.0;
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t at = node(cell, i) * D;
      for (int a = 0; a < D; ++a) sum += c[i * D + a] * v[at + a];
    }
    q[cell] = sum;
  });
}

template class FlowDivergence<2>;
template class FlowDivergence<3>;

}  // namespace diffsim
