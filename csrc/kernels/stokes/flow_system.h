// Stokes flow in one geometry: a factorized matrix, the solve, its tangent and its adjoint.
//
//   e(v, z) - p C(z, 0) = traction(z)  for all z,   C(v, g) = -p M / (bulk eta)
// with one pressure p per cell (cell_form.h). Eliminating p gives the symmetric positive definite
// matrix of flow_matrix.h. Where incompressible, C(v, g) = 0 by conjugate gradients on the
// pressure with the same matrix (the augmented Lagrangian iteration, accelerated); in a region
// without open faces C(v, g) = mean V (fluid volume) with the mean that the boundary values leave,
// and sum V p = 0. The factor does not depend on viscosity, boundary values or loads.
// Large systems keep their pressures and are solved iteratively: flow_mixed.h.
#pragma once

#include <cstdint>
#include <memory>

#include "kernels/stokes/flow_matrix.h"

namespace diffsim {

struct FlowGeometryInputs {
  GridShape shape;
  const double* phi = nullptr;          // (num_nodes,) > 0 in the fluid
  const std::uint8_t* fixed = nullptr;  // (num_nodes, D) nonzero: component prescribed
  bool open[2 * kStokesMaxDim] = {};    // faces of the box, axis by axis, low side first
};

/// Numbers about a prepared system.
struct FlowReport {
  std::int64_t num_cells = 0, num_cut_cells = 0, num_nodes = 0;  // active ones
  std::int64_t num_regions = 0;                                  // connected parts of the fluid
  std::int64_t num_loose_regions = 0;             // those without prescribed values or an open face
  std::int64_t num_loose_cells = 0;               // and their cells
  bool iterative = false;                         // or direct
  std::int64_t factor_nnz = 0, factor_bytes = 0;  // direct
  std::int64_t solver_bytes = 0;                  // matrices kept
  double factor_flops = 0.0;
  double geometry_s = 0.0, assembly_s = 0.0, analysis_s = 0.0, factor_s = 0.0;  // wall time
};

struct FlowInputs {
  std::int64_t num_cases = 1;
  double viscosity = 1.0;              // [Pa s]
  const double* prescribed = nullptr;  // (cases, num_nodes, D), read where fixed [m/s]
  FlowData data;                       // of the first case
  std::int64_t wall_stride = 0, force_stride = 0, traction_stride = 0;  // to the next; 0: shared
};

/// Of one case; Python reads these as doubles.
struct FlowStats {
  double num_iters = 0.0, divergence = 0.0, converged = 1.0, net_inflow = 0.0;
  double residual = 0.0;        // |residual| / |right-hand side| of both equations
  double pressure_error = 0.0;  // direct and incompressible: estimated, relative
};

struct FlowGradients {
  double* phi = nullptr;         // (num_nodes,), added to
  double* viscosity = nullptr;   // (1,), added to
  double* prescribed = nullptr;  // (cases, num_nodes, D), overwritten
  FlowDataGradient data;         // same strides as the inputs, added to
};

/// Rates of the inputs; their fields have the inputs' strides and are absent where nothing moves.
struct FlowDirections {
  const double* phi = nullptr;         // (num_nodes,)
  double viscosity = 0.0;              // [Pa]
  const double* prescribed = nullptr;  // (cases, num_nodes, D)
  FlowData data;
};

class StokesSystem {
 public:
  virtual ~StokesSystem() = default;
  virtual const FlowReport& report() const = 0;
  virtual const double* fractions() const = 0;  // (num_cells,)

  /// @param[out] v     (cases, num_nodes, D) [m/s], zero where there is no fluid
  /// @param[out] p     (cases, num_cells) [Pa]
  /// @param[out] stats (cases,)
  virtual void solve(const FlowInputs& in, double* v, double* p, FlowStats* stats,
                     ThreadPool& pool) = 0;
  /// Both equations at given v and p, of the first case: momentum (num_nodes, D), also at
  /// prescribed components, and the outflow of every cell, (num_cells,).
  virtual void equations(const FlowInputs& in, const double* v, const double* p, double* momentum,
                         double* mass, ThreadPool& pool) const = 0;
  /// @param grad_v, grad_p dL/dv, dL/dp; grad_fraction (num_cells,) dL/d(fluid fraction)
  virtual void adjoint(const FlowInputs& in, const double* v, const double* p, const double* grad_v,
                       const double* grad_p, const double* grad_fraction, const FlowGradients& grad,
                       FlowStats* stats, ThreadPool& pool) = 0;
  /// Rates of v, p and the fractions along `along`, from one solve with the system of the flow.
  /// @param[out] d_v, d_p as v and p; d_fraction (num_cells,)
  virtual void tangent(const FlowInputs& in, const double* v, const double* p,
                       const FlowDirections& along, double* d_v, double* d_p, double* d_fraction,
                       FlowStats* stats, ThreadPool& pool) = 0;
};

/// @throws NotPositiveDefinite with the unknown as grid node * D + axis, or -1 (coarse grid)
std::shared_ptr<StokesSystem> make_stokes_system(const FlowGeometryInputs& in,
                                                 const FlowOptions& options, StokesPlan& plan,
                                                 ThreadPool& pool);

}  // namespace diffsim
