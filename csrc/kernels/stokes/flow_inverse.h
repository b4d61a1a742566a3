// The linear system of a Stokes flow in one geometry, solved by a factor or iteratively.
//
// Sought are v at free components and one pressure p per cell with
//   e(v, z) - p C(z, 0) + r(z) = 0  for all free z,   C(v, 0) + q + p M / (bulk eta) = 0,
// r and q given. Where incompressible there is no term in p but in closed regions, where
// C(v, 0) + q = f V - V (V.p) / (bulk eta W) (closed_regions.h). Flow, tangent and adjoint differ
// in r, q, f and the prescribed values of v alone: the matrix is symmetric.
#pragma once

#include <functional>
#include <memory>

#include "kernels/stokes/flow_mixed.h"
#include "kernels/stokes/flow_pressures.h"

namespace diffsim {

/// What is left of both equations at the current v of case k, for given pressures.
struct FlowResidual {
  /// r(k, pressure, out): e(v, .) - pressure C(., 0) + r; pressure (num_cells,) or nullptr.
  std::function<void(std::int64_t, const double*, double*)> momentum;
  /// q(k, out): C(v, 0) + q, (num_cells,).
  std::function<void(std::int64_t, double*)> mass;
};

template <int D>
class FlowInverse {
 public:
  /// @param space, report outlive this; the report changes where "auto" turns to the factor
  FlowInverse(const FlowSpace<D>& space, StokesPlan& plan, ThreadPool& pool, FlowReport& report,
              double start);
  ~FlowInverse();
  FlowInverse(const FlowInverse&) = delete;
  FlowInverse& operator=(const FlowInverse&) = delete;

  /// Dilatation f of every closed region and case.
  using Forced = std::vector<typename ClosedRegions<D>::Sums>;

  /// @param residual of the v below, which it reads
  /// @param forced   (cases,), where incompressible
  /// @param[in,out] v (cases, num_nodes, D), prescribed values on entry
  /// @param[out]    p (cases, num_cells), zero on entry; with its level
  void solve(std::int64_t cases, double eta, const FlowResidual& residual, const Forced& forced,
             double* v, double* p, FlowStats* stats, ThreadPool& pool);
  /// C(v, 0) + q - f V where it must vanish, (num_cells,).
  void take_mass(const FlowResidual& residual, std::int64_t k, const Forced& forced,
                 double* C) const;

 private:
  void factorize(const FlowMatrix<D>& matrix, StokesPlan& plan, ThreadPool& pool);
  void prepare_iterative(const FlowMatrix<D>& matrix, ThreadPool& pool);
  bool fall_back(ThreadPool& pool);
  void solve_direct(std::int64_t cases, double eta, const FlowResidual& residual,
                    const Forced& forced, double* v, double* p, FlowStats* stats, ThreadPool& pool);
  void solve_mixed(std::int64_t cases, double eta, const FlowResidual& residual,
                   const Forced& forced, double* v, double* p, FlowStats* stats, ThreadPool& pool);
  void correct(std::int64_t cases, double eta, const FlowResidual& residual, const Forced& forced,
               double* r, double* v, double* p, FlowStats* stats, ThreadPool& pool);
  /// All of the second equation, left of its zero.
  void take_excess(const FlowResidual& residual, std::int64_t k, const Forced& forced, double eta,
                   const double* p, double* C) const;
  /// Norm of both equations, the first scaled by the cell size and the second by eta.
  double size_of(double eta, const double* r, const double* C) const;
  const FlowOperator<D>& op() const { return space_.op(); }
  const FlowOptions& options() const { return space_.options(); }
  const StokesGrid<D>& grid() const { return space_.grid(); }

  const FlowSpace<D>& space_;
  FlowReport& report_;
  std::shared_ptr<StokesMemory> memory_;
  std::unique_ptr<CholeskyFactor> factor_;  // or
  std::unique_ptr<FlowMixed<D>> mixed_;
  std::unique_ptr<FlowPressures<D>> pressures_;  // beside the factor, where incompressible
  CholeskyWorkspace workspace_;
};

}  // namespace diffsim
