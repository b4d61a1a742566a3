// Derivative of the discrete Stokes operator along a direction of the level set, v and p held: the
// transpose of FlowOperator::gradient. Cut cells by forward-mode numbers through the same formulas.
#pragma once

#include <vector>

#include "kernels/stokes/flow_operator.h"

namespace diffsim {

template <int D>
class FlowTangent {
 public:
  using Rate = Dual<1>;

  /// @param op    outlives this
  /// @param d_phi (num_nodes,) direction
  FlowTangent(const FlowOperator<D>& op, const double* d_phi);

  /// Adds d/dphi of e(v, .) - p C(., 0) - traction to r, (num_nodes, D).
  void add_momentum(const double* v, const FlowData& data, const double* p, double eta, double* r,
                    ThreadPool& pool) const;
  /// Adds d/dphi of C(v, g) to C, (num_cells,).
  void add_mass(const double* v, const double* wall_velocity, double* C, ThreadPool& pool) const;
  double fluid_volume(std::int64_t cell) const {
    return fraction_[u(cell)] * op_.geometry().grid().cell_volume;
  }
  /// Of M of PressureVolume.
  double pressure_volume(std::int64_t cell) const;
  /// Of the fluid fraction, (num_cells,).
  const std::vector<double>& fractions() const { return fraction_; }

 private:
  using Cut = CutCell<D>;
  using Form = CellForm<D>;
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }
  const Rate* values(std::int64_t cell) const {
    return values_.data() + index_[u(cell)] * Cut::kSize;
  }
  double aperture(std::int64_t cell, int axis, int side) const {
    if (index_[u(cell)] < 0) return 0.0;
    return values(cell)[Cut::kAperture + 2 * axis + side].grad[0];
  }
  double face_aperture(std::int64_t cell, int axis, FaceKind kind) const;
  void add_traction(const double* traction, double* r) const;

  const FlowOperator<D>& op_;
  std::vector<std::int64_t> index_;  // (num_cells,) of active cut cells, or -1
  std::vector<Rate> values_;         // (active cut cells, CutCell::kSize)
  std::vector<double> fraction_, d_phi_;
};

}  // namespace diffsim
