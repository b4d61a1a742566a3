// Geometric multigrid for the velocity matrix on the active nodes of a grid: one V-cycle as an
// approximate inverse, in single precision.
//
// Coarse grids have half the cells per axis; a coarse node is active where it carries a share of an
// active fine node. Multilinear prolongation, Galerkin matrices, one sweep of Gauss-Seidel by nodes
// before and after the coarse correction, backwards after, so that a cycle is symmetric. Planes of
// nodes across axis 0 are swept in three colors (a node couples with nodes up to two planes away),
// so the result does not depend on the number of threads. The coarsest matrix is factorized. Time
// is that of reading the finest matrix: where the processor converts numbers of 16 bits, it has
// those. What a row has before its diagonal and what behind lie apart, for a sweep that starts from
// zero reads the one and its residual the other; equal rows are kept once (MatrixRows).
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/linalg/cholesky.h"
#include "kernels/parallel.h"
#include "kernels/stokes/flow_matrix.h"

namespace diffsim {

/// Blocks of D x D by rows of nodes; columns ascend.
template <int D>
struct NodeMatrix {
  std::vector<std::int64_t> indptr;   // (num_nodes + 1,)
  std::vector<std::int32_t> columns;  // (num_blocks,)
  MatrixRows rows;                    // where they are in the values
  std::vector<double> values;         // (blocks of the rows, D, D)

  std::int64_t num_nodes() const { return static_cast<std::int64_t>(indptr.size()) - 1; }
};

/// Where nodes lie on their grid: (num_nodes, D), sorted by the first axis, then the next.
template <int D>
using NodePositions = std::vector<std::array<std::int32_t, D>>;

/// Nodes of a coarse grid, and the node at each place of the box about them, or -1.
template <int D>
struct CoarseNodes {
  NodePositions<D> positions;
  std::vector<std::int32_t> number;
  std::int64_t stride[D];
};

template <int D>
class FlowMultigrid {
 public:
  /// @param matrix    symmetric positive definite; couples nodes at most two apart per axis
  /// @param fixed     (num_nodes, D) nonzero: row and column are those of the identity
  /// @param scale     on the matrix, so that its entries are about one
  FlowMultigrid(const NodeMatrix<D>& matrix, const NodePositions<D>& positions,
                const std::vector<std::uint8_t>& fixed, double scale, ThreadPool& pool);

  /// x about (scale * matrix)^-1 b; both (num_nodes, D).
  void apply(const double* b, double* x, ThreadPool& pool);
  std::int64_t bytes() const;

 private:
  static constexpr int kLanes = 4;  // a node's components padded for vector registers
  using Lanes = float __attribute__((vector_size(16)));

  struct Level {
    // Half rows: first each node's blocks with nodes that come earlier in a sweep, then each
    // node's with later ones. The diagonal is kept as its inverse alone.
    std::vector<std::int64_t> begin;   // of half rows in `columns`, (2 num_nodes + 1,)
    std::vector<std::int64_t> values;  // of half rows in `blocks` or `halves`, (2 num_nodes,)
    std::vector<std::uint8_t> holds;   // (num_nodes,) whether these are put there by the node
    std::vector<std::int32_t> columns;
    AlignedBuffer<float> blocks;          // (distinct, D, kLanes), columns of the blocks, or
    AlignedBuffer<std::uint16_t> halves;  // (distinct, D, D) times kHalfScale
    bool is_half = false;
    std::vector<float> inverse;             // (num_nodes, D, kLanes) of the diagonal blocks
    std::vector<std::int64_t> planes;       // first row of each plane, and the end
    std::vector<std::uint8_t> fixed;        // (num_nodes, D)
    AlignedBuffer<float> x, b, r;           // (num_nodes, kLanes)
    std::vector<std::int64_t> child_start;  // of coarse nodes: (num_coarse + 1,)
    std::vector<std::int32_t> child;        // fine nodes
    std::vector<float> child_weight;
    std::vector<std::int64_t> parent_start;  // of fine nodes
    std::vector<std::int32_t> parent;
    std::vector<float> parent_weight;
    std::int64_t num_nodes() const { return static_cast<std::int64_t>(values.size()) / 2; }
  };

  void add_level(const NodeMatrix<D>& A, const NodePositions<D>& positions, double scale,
                 ThreadPool& pool);
  CoarseNodes<D> coarsen(const NodePositions<D>& positions, Level& level) const;
  MatrixRows coarse_rows(const NodeMatrix<D>& A, const NodePositions<D>& fine,
                         const NodePositions<D>& coarse, const Level& level) const;
  NodeMatrix<D> galerkin(const NodeMatrix<D>& A, const NodePositions<D>& fine,
                         const CoarseNodes<D>& coarse, const Level& level, ThreadPool& pool) const;
  void hold_empty(NodeMatrix<D>& A, double scale, std::vector<std::uint8_t>& fixed) const;
  void factorize(const NodeMatrix<D>& A, const NodePositions<D>& positions, double scale,
                 ThreadPool& pool);
  void cycle(std::size_t l, ThreadPool& pool);
  /// How many blocks the half rows have that are kept.
  std::int64_t split_rows(const NodeMatrix<D>& A, const NodePositions<D>& positions, Level& level,
                          ThreadPool& pool) const;
  template <bool kHalf>
  Lanes sum_blocks(const Level& level, std::int64_t half_row) const;
  Lanes product(const Level& level, std::int64_t half_row) const {
    return level.is_half ? sum_blocks<true>(level, half_row) : sum_blocks<false>(level, half_row);
  }
  void sweep(Level& level, bool backward, ThreadPool& pool) const;
  void residual(Level& level, ThreadPool& pool) const;

  std::vector<Level> levels_;
  std::unique_ptr<CholeskyFactor> coarsest_;
  CholeskyWorkspace workspace_;
  std::vector<double> coarse_b_;
  std::int64_t bytes_ = 0;
};

}  // namespace diffsim
