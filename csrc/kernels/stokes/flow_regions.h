// Connected parts of the fluid, and what flows into those without an open face.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "kernels/stokes/flow_operator.h"

namespace diffsim {

template <int D>
class FlowRegions {
 public:
  /// Cells are connected where their common face is fluid seen from either.
  FlowRegions(const FlowOperator<D>& op, const std::uint8_t* fixed)
      : region_(u(op.geometry().grid().num_cells)) {
    const FlowGeometry<D>& geometry = op.geometry();
    const StokesGrid<D>& grid = geometry.grid();
    std::iota(region_.begin(), region_.end(), std::int64_t{0});
    for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
      if (!geometry.active(cell)) continue;
      std::int64_t at[D];
      grid.cell_position(cell, at);
      for (int a = 0; a < D; ++a) {
        const std::int64_t next = cell + grid.cell_stride[a];
        if (at[a] + 1 == grid.cells[a] || !geometry.active(next)) continue;
        if (geometry.aperture(cell, a, 1) + geometry.aperture(next, a, 0) > kOnFace)
          join(cell, next);
      }
    }
    std::vector<std::int64_t> number(region_.size(), -1);
    for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
      const std::int64_t root = find(cell);
      if (geometry.active(cell) && number[u(root)] < 0) {
        number[u(root)] = static_cast<std::int64_t>(parts_.size());
        parts_.emplace_back();
      }
    }
    std::vector<std::int64_t> of(region_.size(), -1);
    for (std::int64_t cell = 0; cell < grid.num_cells; ++cell)
      if (geometry.active(cell)) of[u(cell)] = number[u(find(cell))];
    region_ = std::move(of);
    for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
      if (region_[u(cell)] < 0) continue;
      Part& part = parts_[u(region_[u(cell)])];
      ++part.num_cells;
      const std::int64_t node = geometry.first_node(cell);
      for (std::int64_t offset : grid.corner_offset)
        for (int a = 0; a < D; ++a)
          if (fixed[(node + offset) * D + a]) part.prescribed = true;
    }
    for (const OpenFace& face : op.open_faces()) {
      const bool fluid = geometry.aperture(face.cell, face.axis, face.side) > 0.0;
      if (fluid) parts_[u(region_[u(face.cell)])].open = true;
    }
  }

  void count(std::int64_t& regions, std::int64_t& loose, std::int64_t& loose_cells) const {
    regions = static_cast<std::int64_t>(parts_.size());
    loose = loose_cells = 0;
    for (const Part& part : parts_) {
      if (part.open || part.prescribed) continue;
      ++loose;
      loose_cells += part.num_cells;
    }
  }

  std::int64_t num_parts() const { return static_cast<std::int64_t>(parts_.size()); }
  /// The part of a cell if it has no open face, -1 elsewhere and where there is no fluid.
  std::int64_t closed_part(std::int64_t cell) const {
    const std::int64_t region = region_[u(cell)];
    return region < 0 || parts_[u(region)].open ? -1 : region;
  }

  /// Largest |net flux| / (gross flux) through box and walls of the regions without an open face.
  double net_inflow(const FlowOperator<D>& op, const double* v, const double* wall_velocity) const {
    const FlowGeometry<D>& geometry = op.geometry();
    const StokesGrid<D>& grid = geometry.grid();
    std::vector<double> net(parts_.size(), 0.0), gross(parts_.size(), 0.0);
    for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
      const std::int64_t region = region_[u(cell)];
      if (region < 0 || parts_[u(region)].open) continue;
      const std::int64_t node = geometry.first_node(cell);
      std::int64_t at[D];
      grid.cell_position(cell, at);
      for (int a = 0; a < D; ++a)
        for (int side = 0; side < 2; ++side) {
          if (at[a] != (side == 0 ? 0 : grid.cells[a] - 1)) continue;
          double mean = 0.0;
          for (int i = 0; i < 1 << D; ++i)
            if (StokesGrid<D>::corner_bit(i, a) == side)
              mean += v[(node + grid.corner_offset[i]) * D + a] / (1 << (D - 1));
          const double flux = mean * grid.face_area(a) * geometry.aperture(cell, a, side);
          net[u(region)] += side == 0 ? -flux : flux;
          gross[u(region)] += std::abs(flux);
        }
      const CutCell<D>* cut = geometry.cut(cell);
      if (!cut || !wall_velocity) continue;
      const double* normal = geometry.facet_normal(cell);
      for (int q = 0; q < CutCell<D>::kPoints; ++q)
        for (int i = 0; i < 1 << D; ++i)
          for (int a = 0; a < D; ++a) {
            const double flux = cut->area()[q] * normal[a] * op.form().basis().N[q][i] *
                                wall_velocity[(node + grid.corner_offset[i]) * D + a];
            net[u(region)] += flux;
            gross[u(region)] += std::abs(flux);
          }
    }
    double worst = 0.0;
    for (std::size_t i = 0; i < net.size(); ++i)
      if (gross[i] > 0.0) worst = std::max(worst, std::abs(net[i]) / gross[i]);
    return worst;
  }

 private:
  struct Part {
    std::int64_t num_cells = 0;
    bool open = false, prescribed = false;
  };
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }
  std::int64_t find(std::int64_t cell) {
    while (region_[u(cell)] != cell) cell = region_[u(cell)] = region_[u(region_[u(cell)])];
    return cell;
  }
  void join(std::int64_t a, std::int64_t b) {
    a = find(a);
    b = find(b);
    region_[u(std::max(a, b))] = std::min(a, b);
  }

  std::vector<std::int64_t> region_;  // (num_cells,) index of the part, -1 without fluid
  std::vector<Part> parts_;
};

}  // namespace diffsim
