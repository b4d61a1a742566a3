// The Stokes equations of one geometry with velocities and pressures as unknowns, iteratively:
//
//   E v - C' p = f,   C v + p M / bulk = g
// for eta = 1: the equations whose pressures flow_system.cpp eliminates for its direct path.
// gamma C' M^-1 times the second row is added to the first, which makes
//   [ E_gamma  -C' ] [ v ]    E_gamma = E + gamma C' M^-1 C,
//   [ C   M / (bulk - gamma) ] [ p (1 - gamma / bulk) ]
// Flexible GMRES with the block triangular preconditioner [V^-1 -C'; 0 S]: V a multigrid cycle on
// E_gamma, and for the Schur complement
//   S^-1 = (1 + gamma) M^-1 + diag(L)^-1 + Q (Q' L Q)^-1 Q',   L = C diag(E)^-1 C' + M / bulk.
// One pressure per cell with multilinear velocities is not inf-sup stable: pressures that alternate
// in sign along two or three axes, times anything smooth, are held by far less than M. They are
// waves of the shortest length, for which E is about its diagonal. So L stands for S on them; Q
// spans them, patterns of alternating signs with one amplitude each per 2^D cells.
//
// Where incompressible, B = V V' / (bulk W) in closed regions (closed_regions.h), and nothing
// elsewhere, takes the place of M / bulk. Then p - gamma M^-1 B p is the unknown, and
// V V' / ((bulk - gamma) W) the lower right block.
#pragma once

#include <memory>
#include <vector>

#include "kernels/linalg/krylov.h"
#include "kernels/stokes/closed_regions.h"
#include "kernels/stokes/flow_matrix.h"
#include "kernels/stokes/flow_multigrid.h"

namespace diffsim {

template <int D>
class FlowMixed {
 public:
  /// @param closed outlives this
  /// @param fixed  (num_grid_nodes, D) nonzero where the component is prescribed
  /// @throws NotPositiveDefinite with an unknown of a coarse grid
  FlowMixed(const FlowOperator<D>& op, const ClosedRegions<D>& closed, const FlowMatrix<D>& matrix,
            const std::uint8_t* fixed, ThreadPool& pool);

  /// @param f (num_grid_nodes, D), read at free components of active nodes
  /// @param g (num_cells,), read in active cells
  /// @param[out] v (num_grid_nodes, D), p (num_cells,): set at the same places
  /// @param rtol on the norm of both residuals, scaled by powers of the cell size
  /// @return residual_norm relative to the right-hand side
  KrylovResult solve(const double* f, const double* g, double* v, double* p, double rtol,
                     int max_iters, ThreadPool& pool);
  std::int64_t bytes() const;

 private:
  static constexpr int kCorners = 1 << D, kPatterns = D == 2 ? 1 : 4;

  void set_divergence();
  void set_diagonals(ThreadPool& pool);
  void set_patterns(ThreadPool& pool);
  double sign(std::int64_t cell, int pattern) const;
  const double* divergence(std::int64_t cell) const {
    const std::int32_t index = cut_index_[static_cast<std::size_t>(cell)];
    return index < 0 ? full_ : cut_.data() + static_cast<std::int64_t>(index) * kCorners * D;
  }
  void apply(const Vector& x, Vector& y, ThreadPool& pool) const;
  void precondition(const Vector& r, Vector& z, ThreadPool& pool);
  void add_gradient(double scale, const double* p, double* y, ThreadPool& pool) const;
  void take_divergence(const double* v, double* q, ThreadPool& pool) const;
  bool strict() const { return op_.options().incompressible; }
  /// V.p / ((bulk - gamma) W) of closed regions, where incompressible.
  typename ClosedRegions<D>::Sums closed_sums(const double* p) const;

  // Velocities and pressures are scaled so that all matrices have entries about one.
  const FlowOperator<D>& op_;
  const ClosedRegions<D>& closed_;
  double gamma_, velocity_scale_, divergence_scale_;
  NodeMatrix<D> matrix_;             // scaled E_gamma
  std::vector<std::uint8_t> fixed_;  // (num_nodes, D) of active nodes
  std::int64_t num_velocities_ = 0;
  std::vector<std::int64_t> cells_;       // active ones
  std::vector<std::int32_t> number_;      // of the grid's cells among them
  std::vector<std::int32_t> cell_nodes_;  // (active cells, 2^D)
  std::vector<std::int32_t> cut_index_;   // of active cells, -1 where full
  std::vector<double> cut_;               // (cut cells, 2^D, D) divergence
  double full_[kCorners * D];
  std::vector<double> mass_, shift_;      // of active cells: M, M / (bulk - gamma) or 0
  std::vector<double> inverse_diagonal_;  // (num_nodes, D, D) of E, zero where fixed
  std::vector<double> weight_;            // (1 + gamma) / M + 1 / diag(L)
  std::vector<std::int32_t> macro_;       // of active cells
  std::unique_ptr<CholeskyFactor> patterns_;
  CholeskyWorkspace workspace_;
  std::vector<double> amplitude_;
  Vector scratch_;
  std::unique_ptr<FlowMultigrid<D>> multigrid_;
};

}  // namespace diffsim
