// Parts of the fluid without an open face, where the flow is incompressible: dilatation and
// pressure level. With V the fluid volumes and M those of PressureVolume, in every such part
//   C(v, g) = f V - V (V.p) / (bulk eta W),   W = sum V^2 / M,
// f the dilatation that the boundary values force on it. The pressure level (V.p) / sum V is the
// momentum's: cells cut by different planes do not quite share their faces, so that the velocities
// feel it. What is returned has no level. Cells whose velocities are all prescribed take no part.
#pragma once

#include <vector>

#include "kernels/stokes/flow_regions.h"

namespace diffsim {

template <int D>
class ClosedRegions {
 public:
  ClosedRegions(const FlowOperator<D>& op, const FlowRegions<D>& regions,
                const std::vector<std::int64_t>& rigid_cells) {
    const std::int64_t num_cells = op.geometry().grid().num_cells;
    std::vector<std::uint8_t> rigid(u(num_cells), 0);
    for (std::int64_t cell : rigid_cells) rigid[u(cell)] = 1;
    volume_.assign(u(regions.num_parts()), 0.0);
    weight_ = volume_;
    for (std::int64_t cell = 0; cell < num_cells; ++cell) {
      const std::int64_t region = regions.closed_part(cell);
      if (region < 0 || rigid[u(cell)]) continue;
      const double V = op.fluid_volume(cell), ratio = V / op.pressure_volume(cell);
      cells_.push_back({cell, region, V, ratio});
      volume_[u(region)] += V;
      weight_[u(region)] += V * ratio;
    }
  }

  struct Cell {
    std::int64_t cell, region;
    double volume, ratio;  // V, V / M
  };
  using Sums = std::vector<double>;  // by region

  const std::vector<Cell>& cells() const { return cells_; }
  double volume(std::int64_t region) const { return volume_[u(region)]; }  // sum V
  double weight(std::int64_t region) const { return weight_[u(region)]; }  // W
  /// Sums of f(cell) over the regions' cells.
  template <typename F>
  Sums sums(F&& f) const {
    Sums sum(volume_.size(), 0.0);
    for (const Cell& c : cells_) sum[u(c.region)] += f(c);
    return sum;
  }
  /// sum C / sum V of every region.
  Sums means(const double* C) const {
    Sums mean = sums([&](const Cell& c) { return C[c.cell]; });
    for (std::size_t i = 0; i < mean.size(); ++i)
      if (volume_[i] > 0.0) mean[i] /= volume_[i];
    return mean;
  }
  /// C -= mean V.
  void subtract(const Sums& mean, double* C) const {
    for (const Cell& c : cells_) C[c.cell] -= mean[u(c.region)] * c.volume;
  }
  /// p -= (sum V p + extra) / sum V.
  void subtract_level(double* p, const Sums* extra = nullptr) const {
    const Sums sum = sums([&](const Cell& c) { return c.volume * p[c.cell]; });
    for (const Cell& c : cells_) {
      const double level = sum[u(c.region)] + (extra ? (*extra)[u(c.region)] : 0.0);
      p[c.cell] -= level / volume_[u(c.region)];
    }
  }
  /// p += the level of the momentum's pressure, of which p has none.
  /// @param excess (num_cells,) C(v, g) - f V
  /// @param bulk   bulk eta
  void add_level(double bulk, const double* excess, double* p) const {
    const Sums sum = sums([&](const Cell& c) { return c.ratio * excess[c.cell]; });
    for (const Cell& c : cells_) p[c.cell] -= bulk * sum[u(c.region)] / volume_[u(c.region)];
  }

 private:
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

  std::vector<Cell> cells_;  // ascending
  Sums volume_, weight_;
};

}  // namespace diffsim
