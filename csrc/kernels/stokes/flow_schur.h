// About the inverse of S = C E^-1 C' + M / bulk, what pressures feel of each other through the
// velocities of a Stokes flow:
//   S^-1 = (1 + gamma) M^-1 + diag(L)^-1 + Q (Q' L Q)^-1 Q',   L = C diag(E)^-1 C' + M / bulk.
// One pressure per cell with multilinear velocities is not inf-sup stable: pressures that alternate
// in sign along two or three axes, times anything smooth, are held by far less than M. They are
// waves of the shortest length, for which E is about its diagonal. So L stands for S on them; Q
// spans them, patterns of alternating signs with one amplitude each per 2^D cells.
//
// Where a wall enters a cell through a corner, C is tiny, and so is E at the nodes that none but
// such cells have: their pressures feel each other, and hardly any else. In cut cells the inverse
// of L among them takes the place of diag(L)^-1.
//
// Where incompressible, L has next to nothing in the place of M / bulk: in such cells M is large
// (PressureVolume), and would hide C diag(E)^-1 C', which alone holds these pressures.
#pragma once

#include <memory>
#include <vector>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/krylov.h"
#include "kernels/stokes/flow_divergence.h"

namespace diffsim {

/// In the place of 1 / bulk in L where incompressible, on the fluid volume.
constexpr double kLeastCompliance = 1e-8;

/// Inverses of the diagonal blocks of E, (num_nodes, D, D), zero where prescribed.
/// @param blocks those of E + gamma C' M^-1 C
template <int D>
std::vector<double> invert_diagonals(std::vector<double> blocks,
                                     const FlowDivergence<D>& divergence,
                                     const std::vector<double>& mass, double gamma,
                                     ThreadPool& pool);

template <int D>
class FlowSchur {
 public:
  /// @param divergence       C; outlives this
  /// @param inverse_diagonal (num_nodes, D, D) of E, zero where prescribed
  /// @param mass, compliance (cells,) M, and M / bulk as it stands in L
  FlowSchur(const FlowOperator<D>& op, const FlowDivergence<D>& divergence,
            const std::vector<double>& inverse_diagonal, const std::vector<double>& mass,
            const std::vector<double>& compliance, double gamma, ThreadPool& pool);

  /// p about S^-1 g; (cells,)
  void apply(const double* g, double* p, ThreadPool& pool);
  std::int64_t bytes() const {
    return patterns_->bytes() + (among_cuts_ ? among_cuts_->bytes() : 0);
  }

 private:
  static constexpr int kCorners = 1 << D, kPatterns = D == 2 ? 1 : 4;
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

  /// Cells taken together: index of their group, or -1, and where groups lie, in units of theirs.
  struct Groups {
    std::vector<std::int32_t> of;  // (cells,)
    std::vector<double> coords;    // (groups, 3)
    std::int64_t size() const { return static_cast<std::int64_t>(coords.size()) / 3; }
  };

  Groups macro_cells() const;
  Groups cut_cells() const;
  void set_signs();
  void set_weights(ThreadPool& pool);
  /// Of R' L R: in a group's pressures are P patterns, by(cell, pattern) in each cell.
  template <int P, typename Pattern>
  std::unique_ptr<CholeskyFactor> factorize(const Groups& groups, Pattern&& by,
                                            ThreadPool& pool) const;
  double sign(std::int64_t cell, int pattern) const {
    return static_cast<double>(signs_[u(cell * kPatterns + pattern)]);
  }

  const FlowOperator<D>& op_;
  const FlowDivergence<D>& divergence_;
  const std::vector<double>&inverse_diagonal_, &mass_, &compliance_;
  double gamma_;
  std::vector<float> signs_;    // (cells, patterns)
  std::vector<double> weight_;  // (1 + gamma) / M, and 1 / diag(L) but in cut cells
  Groups macros_, cuts_;
  std::unique_ptr<CholeskyFactor> patterns_, among_cuts_;
  CholeskyWorkspace workspace_;
  Vector amplitude_, cut_pressure_;
};

}  // namespace diffsim
