// The Stokes equations of one geometry with velocities and pressures as unknowns, iteratively:
//
//   E v - C' p = f,   C v + p M / bulk = g
// for eta = 1: the equations whose pressures flow_system.cpp eliminates for its direct path.
// gamma C' M^-1 times the second row is added to the first, which makes
//   [ E_gamma  -C' ] [ v ]    E_gamma = E + gamma C' M^-1 C,
//   [ C   M / (bulk - gamma) ] [ p (1 - gamma / bulk) ]
// Flexible GMRES with the block triangular preconditioner [V^-1 -C'; 0 S]: V a multigrid cycle on
// E_gamma, S of flow_schur.h.
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
#include "kernels/stokes/flow_schur.h"

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
  static constexpr int kCorners = 1 << D;

  void set_compliances();
  void apply(const Vector& x, Vector& y, ThreadPool& pool) const;
  void precondition(const Vector& r, Vector& z, ThreadPool& pool);
  bool strict() const { return op_.options().incompressible; }
  /// V.p / ((bulk - gamma) W) of closed regions, where incompressible.
  typename ClosedRegions<D>::Sums closed_sums(const double* p) const;

  // Velocities and pressures are scaled so that all matrices have entries about one.
  const FlowOperator<D>& op_;
  const ClosedRegions<D>& closed_;
  double gamma_, divergence_scale_, velocity_scale_;
  std::vector<std::uint8_t> fixed_;  // (num_nodes, D) of active nodes
  FlowDivergence<D> divergence_;
  NodeMatrix<D> matrix_;  // scaled E_gamma
  std::int64_t num_velocities_ = 0;
  std::vector<double> mass_, shift_;      // of active cells: M, M / (bulk - gamma) or 0
  std::vector<double> compliance_;        // and M / bulk as the preconditioner has it
  std::vector<double> inverse_diagonal_;  // (num_nodes, D, D) of E, zero where fixed
  std::unique_ptr<FlowSchur<D>> schur_;
  Vector scratch_;
  std::unique_ptr<FlowMultigrid<D>> multigrid_;
};

}  // namespace diffsim
