// Outflow of the cells with fluid, C v, and its transpose: one row per cell, scaled.
#pragma once

#include <vector>

#include "kernels/stokes/flow_operator.h"

namespace diffsim {

/// Which components of the active nodes are prescribed, (num_active_nodes, D).
/// @param fixed (num_grid_nodes, D)
template <int D>
std::vector<std::uint8_t> active_fixed(const FlowOperator<D>& op, const std::uint8_t* fixed) {
  std::vector<std::uint8_t> active;
  for (std::int64_t node : op.geometry().active_nodes())
    active.insert(active.end(), fixed + node * D, fixed + (node + 1) * D);
  return active;
}

template <int D>
class FlowDivergence {
 public:
  static constexpr int kCorners = 1 << D;

  /// @param op    outlives this
  /// @param fixed (num_active_nodes, D) nonzero where the component is prescribed
  /// @param scale on all rows
  FlowDivergence(const FlowOperator<D>& op, const std::vector<std::uint8_t>& fixed, double scale);

  std::int64_t size() const { return static_cast<std::int64_t>(cells_.size()); }
  /// Of the grid; ascending.
  std::int64_t grid_cell(std::int64_t cell) const { return cells_[u(cell)]; }
  /// -1 where the grid's cell has no fluid.
  std::int64_t number(std::int64_t grid_cell) const { return number_[u(grid_cell)]; }
  /// Among the active nodes.
  std::int64_t node(std::int64_t cell, int corner) const {
    return nodes_[u(cell * kCorners + corner)];
  }
  /// The cell that has an active node as this corner, or -1.
  std::int64_t cell_about(std::int64_t node, int corner) const {
    return about_[u(node * kCorners + corner)];
  }
  /// (2^D, D)
  const double* row(std::int64_t cell) const {
    return rows_.data() + static_cast<std::int64_t>(row_index_[u(cell)]) * kCorners * D;
  }
  bool cut(std::int64_t cell) const { return row_index_[u(cell)] > 0; }
  bool fixed(std::int64_t component) const { return fixed_[u(component)]; }
  /// Whether all velocities of a cell are prescribed: no equation, and a pressure of zero.
  bool rigid(std::int64_t cell) const;

  /// y += scale C' p at free components.
  void add_gradient(double scale, const double* p, double* y, ThreadPool& pool) const;
  /// q = C v.
  void take(const double* v, double* q, ThreadPool& pool) const;

 private:
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

  const std::vector<std::uint8_t>& fixed_;
  std::vector<std::int64_t> cells_;
  std::vector<std::int32_t> number_;     // of the grid's cells among them
  std::vector<std::int32_t> nodes_;      // (cells, 2^D)
  std::vector<std::int32_t> about_;      // (active nodes, 2^D)
  std::vector<std::int32_t> row_index_;  // 0 where full
  std::vector<double> rows_;             // (1 + cut cells, 2^D, D)
};

}  // namespace diffsim
