// The pressures that make a flow incompressible, by conjugate gradients with a factor of
// K = E + bulk C' M^-1 C (flow_matrix.h): C K^-1 C' d = remainder.
//
// The inverse of C K^-1 C' is S^-1 + bulk M^-1 with S = C E^-1 C'. In most cells the second part
// is all but the whole; where a wall enters a cell through a corner, C is tiny and M is not, and it
// is next to nothing. flow_schur.h adds what holds such a pressure. S^-1 times the remainder is
// about the error of the pressures, in every cell, and tells when to stop: the divergence alone
// does not see these cells. The second part of the inverse is no error: p is corrected by bulk M^-1
// C dv.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "kernels/stokes/flow_schur.h"
#include "kernels/stokes/flow_space.h"

namespace diffsim {

/// Solves K x = b in place, (unknowns, cases).
using FactorSolve = std::function<void(double* b, std::int64_t cases)>;

template <int D>
class FlowPressures {
 public:
  /// @param space  outlives this
  /// @param values K, as FlowMatrix assembles it
  FlowPressures(const FlowSpace<D>& space, const FlowMatrix<D>& matrix,
                const std::vector<double>& values, ThreadPool& pool);

  /// Corrects dv and p until the divergence of v + dv and the estimated error of the pressures,
  /// both relative, are below the tolerance.
  /// @param v (cases, num_nodes, D)
  /// @param[in,out] dv (cases, num_nodes, D), p (cases, num_cells)
  /// @param[in,out] remainder (cases, num_cells), minus what of C(v) must vanish
  void close(double eta, std::int64_t cases, const FactorSolve& solve, const double* v, double* dv,
             double* p, double* remainder, FlowStats* stats, ThreadPool& pool);
  std::int64_t bytes() const { return schur_->bytes(); }

 private:
  struct Search {  // of one case
    std::vector<double> direction, correction;
    double product = 0.0;
  };

  void precondition(double eta, const double* remainder, double* pressure, ThreadPool& pool);
  /// Where the iteration stands; whether it may end.
  /// @param correction the preconditioned remainder
  bool judge(double eta, double speed, const double* p, const double* remainder,
             const double* correction, FlowStats& stats) const;
  void set_rounding(ThreadPool& pool);
  const FlowOperator<D>& op() const { return space_.op(); }

  const FlowSpace<D>& space_;
  std::vector<std::uint8_t> fixed_;
  FlowDivergence<D> divergence_;
  std::vector<double> mass_, compliance_, inverse_diagonal_;
  std::unique_ptr<FlowSchur<D>> schur_;
  std::vector<double> given_, found_;  // of active cells
  double rounding_ = 0.0;
};

}  // namespace diffsim
