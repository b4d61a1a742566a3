// The unknowns of a Stokes flow on a geometry: which components are free, what of the outflow must
// vanish, and vectors between the grid and the matrix.
#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "kernels/stokes/closed_regions.h"
#include "kernels/stokes/flow_system.h"

namespace diffsim {

/// Immutable. Nodal fields are (num_nodes, D) over all grid nodes, those of the matrix (active
/// nodes, D, cases); fields of cells are (num_cells,) over all grid cells.
template <int D>
class FlowSpace {
 public:
  /// @throws std::invalid_argument where phi leaves no fluid
  FlowSpace(const FlowGeometryInputs& in, const FlowOptions& options, ThreadPool& pool)
      : op_(StokesGrid<D>(in.shape), in.phi, in.open, options, pool),
        regions_(op_, in.fixed),
        fixed_(in.fixed, in.fixed + grid().num_nodes * D),
        rigid_cells_(find_rigid_cells()),
        closed_(op_, regions_, rigid_cells_) {
    if (geometry().active_nodes().empty())
      throw std::invalid_argument("phi leaves no fluid: it must be > 0 somewhere in the box");
  }

  const FlowOperator<D>& op() const { return op_; }
  const FlowOptions& options() const { return op_.options(); }
  const FlowGeometry<D>& geometry() const { return op_.geometry(); }
  const StokesGrid<D>& grid() const { return op_.geometry().grid(); }
  const FlowRegions<D>& regions() const { return regions_; }
  bool fixed(std::int64_t component) const { return fixed_[u(component)]; }
  const std::uint8_t* fixed() const { return fixed_.data(); }  // (num_nodes, D)
  /// Zeroes the free components of v, (cases, num_nodes, D).
  void clear_free(std::int64_t cases, double* v) const {
    const std::int64_t N = grid().num_nodes * D;
    for (std::int64_t i = 0; i < cases * N; ++i)
      if (!fixed_[u(i % N)]) v[i] = 0.0;
  }
  std::size_t num_unknowns() const { return geometry().active_nodes().size() * D; }

  /// f(component of the grid, component of the matrix)
  template <typename F>
  void for_active(F&& f) const {
    std::int64_t i = 0;
    for (std::int64_t node : geometry().active_nodes())
      for (int a = 0; a < D; ++a) f(node * D + a, i++);
  }
  /// Case k of b = scale * field at free components, zero at prescribed ones.
  void gather(const double* field, double* b, std::int64_t k, std::int64_t cases,
              double scale) const {
    for_active([&](std::int64_t i, std::int64_t j) {
      b[j * cases + k] = fixed_[u(i)] ? 0.0 : scale * field[i];
    });
  }
  /// field += scale * case k of b at free components.
  void scatter_add(const double* b, std::int64_t k, std::int64_t cases, double scale,
                   double* field) const {
    for_active([&](std::int64_t i, std::int64_t j) {
      if (!fixed_[u(i)]) field[i] += scale * b[j * cases + k];
    });
  }

  double longest_side() const {
    double side = 0.0;
    for (int a = 0; a < D; ++a)
      side = std::max(side, static_cast<double>(grid().cells[a]) * grid().h[a]);
    return side;
  }
  /// max |v|
  double speed(const double* v) const {
    double largest = 0.0;
    for_active([&](std::int64_t i, std::int64_t) { largest = std::max(largest, std::abs(v[i])); });
    return largest;
  }
  /// Root mean square dilatation, relative to max |v| / (longest side of the box).
  double divergence(const double* C, double speed) const {
    double sum = 0.0, volume = 0.0;
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell) {
      if (!geometry().active(cell)) continue;
      const double M = op_.pressure_volume(cell);
      sum += C[cell] * C[cell] / M;
      volume += M;
    }
    return speed > 0.0 ? std::sqrt(sum / volume) * longest_side() / speed : 0.0;
  }
  /// p += scale C / M.
  void add_pressure(double scale, const double* C, double* p) const {
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell)
      if (geometry().active(cell)) p[cell] += scale * C[cell] / op_.pressure_volume(cell);
  }
  const ClosedRegions<D>& closed() const { return closed_; }
  /// Zeroes C where it need not vanish in an incompressible flow: all velocities are prescribed.
  void skip_rigid(double* C) const {
    for (std::int64_t cell : rigid_cells_) C[cell] = 0.0;
  }

 private:
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }
  bool all_prescribed(std::int64_t cell) const {
    for (std::int64_t offset : grid().corner_offset)
      for (int a = 0; a < D; ++a)
        if (!fixed_[u((geometry().first_node(cell) + offset) * D + a)]) return false;
    return true;
  }

  std::vector<std::int64_t> find_rigid_cells() const {
    std::vector<std::int64_t> found;
    for (std::int64_t cell = 0; cell < grid().num_cells; ++cell)
      if (geometry().active(cell) && all_prescribed(cell)) found.push_back(cell);
    return found;
  }

  FlowOperator<D> op_;
  FlowRegions<D> regions_;
  std::vector<std::uint8_t> fixed_;        // (num_nodes, D) nonzero: prescribed
  std::vector<std::int64_t> rigid_cells_;  // active, all velocities prescribed
  ClosedRegions<D> closed_;
};

}  // namespace diffsim
