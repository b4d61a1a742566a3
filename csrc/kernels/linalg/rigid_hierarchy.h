// What smoothed aggregation needs to know of a mesh before it sees numbers: aggregates of every
// level, and the patterns of prolongation, of its product with the matrix, and of the coarse
// matrices.
#pragma once

#include <memory>

#include "kernels/linalg/aggregation.h"
#include "kernels/linalg/cholesky.h"

namespace diffsim {

/// From the nodes of one level to those of the next coarser one.
struct RigidTransfer {
  Aggregates aggregates;
  Pattern prolongation;                         // (nodes, coarse nodes)
  Pattern product;                              // matrix times prolongation
  Pattern restriction;                          // (coarse nodes, nodes): the transpose
  std::vector<std::int64_t> restriction_entry;  // where an entry lies in `prolongation`
};

/// Immutable. Level 0 has three unknowns a node, the others six: a translation and a rotation.
class RigidHierarchy {
 public:
  /// @param fine  pattern of the matrix of level 0, the diagonal included
  explicit RigidHierarchy(Pattern fine);

  int num_levels() const { return static_cast<int>(matrices_.size()); }
  const Pattern& matrix(int level) const { return matrices_[static_cast<std::size_t>(level)]; }
  std::int64_t diagonal(int level, std::int64_t row) const {
    return diagonals_[static_cast<std::size_t>(level)][static_cast<std::size_t>(row)];
  }
  const RigidTransfer& transfer(int level) const {
    return transfers_[static_cast<std::size_t>(level)];
  }
  const std::shared_ptr<const CholeskySymbolic>& coarsest() const { return coarsest_; }

 private:
  std::vector<Pattern> matrices_;
  std::vector<std::vector<std::int64_t>> diagonals_;
  std::vector<RigidTransfer> transfers_;  // one less than levels
  std::shared_ptr<const CholeskySymbolic> coarsest_;
};

}  // namespace diffsim
