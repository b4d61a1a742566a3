// Sparsity pattern and assembly of the Stokes matrix: blocks of D x D on active nodes.
//
// K = e + C' (bulk / M) C for eta = 1, on the nodes of active cells; prescribed components have
// identity rows. A node couples with the nodes of its cells, and across ghost faces two nodes away.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "kernels/linalg/cholesky.h"
#include "kernels/stokes/flow_operator.h"

namespace diffsim {

/// Which of a node's neighbors, at offsets -2..2 per axis, it couples with.
struct NodeStencil {
  std::uint64_t bits[2] = {0, 0};

  void set(int bit) { bits[bit >> 6] |= std::uint64_t{1} << (bit & 63); }
  bool test(int bit) const { return (bits[bit >> 6] >> (bit & 63)) & 1; }
  int count() const { return __builtin_popcountll(bits[0]) + __builtin_popcountll(bits[1]); }
  /// How many come before `bit`.
  int rank(int bit) const {
    const std::uint64_t below = (std::uint64_t{1} << (bit & 63)) - 1;
    return bit < 64 ? __builtin_popcountll(bits[0] & below)
                    : __builtin_popcountll(bits[0]) + __builtin_popcountll(bits[1] & below);
  }
  bool operator==(const NodeStencil& b) const {
    return bits[0] == b.bits[0] && bits[1] == b.bits[1];
  }
};

/// Memory that factors on one grid hand on to each other, one at a time.
class StokesMemory {
 public:
  CholeskyMemory take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    return std::move(memory_);
  }
  void give_back(CholeskyMemory memory) {
    const std::lock_guard<std::mutex> lock(mutex_);
    memory_ = std::move(memory);
  }

 private:
  std::mutex mutex_;
  CholeskyMemory memory_;
};

/// Symbolic analyses of the last few patterns on one grid with one set of prescribed components.
class StokesPlan {
 public:
  using Symbolic = std::shared_ptr<const CholeskySymbolic>;

  /// The analysis of a pattern, or nullptr.
  Symbolic find(const std::vector<std::int64_t>& nodes, const std::vector<NodeStencil>& stencils);
  void keep(const std::vector<std::int64_t>& nodes, const std::vector<NodeStencil>& stencils,
            Symbolic symbolic);
  /// Shared, for a system may outlive the plan.
  const std::shared_ptr<StokesMemory>& memory() const { return memory_; }

 private:
  static constexpr std::size_t kKept = 3;
  struct Entry {
    std::vector<std::int64_t> nodes;
    std::vector<NodeStencil> stencils;
    Symbolic symbolic;
  };
  std::mutex mutex_;
  std::vector<Entry> entries_;  // latest last
  std::shared_ptr<StokesMemory> memory_ = std::make_shared<StokesMemory>();
};

/// Rows of blocks of which equal ones are one: all are, away from walls and faces of the box. They
/// are made once, and a product that finds them in one place finds them in cache.
struct MatrixRows {
  std::vector<std::int32_t> of;        // (num_nodes,) a node's row
  std::vector<std::int64_t> begin{0};  // (num_rows + 1,) in values, in blocks
  std::vector<std::int64_t> holder;    // (num_rows,) the first node that has it

  /// Gives the next node a row of its own.
  void add(std::int64_t num_blocks);
  void add_known(std::int32_t row) { of.push_back(row); }
  std::int64_t num_nodes() const { return static_cast<std::int64_t>(of.size()); }
  std::int64_t num_rows() const { return static_cast<std::int64_t>(holder.size()); }
  std::int64_t first(std::int64_t node) const {
    return begin[static_cast<std::size_t>(of[static_cast<std::size_t>(node)])];
  }
  bool holds(std::int64_t node) const {
    return holder[static_cast<std::size_t>(of[static_cast<std::size_t>(node)])] == node;
  }
};

template <int D>
class FlowMatrix {
 public:
  FlowMatrix(const FlowOperator<D>& op, ThreadPool& pool);

  std::int64_t num_nodes() const { return static_cast<std::int64_t>(stencils_.size()); }
  std::int64_t num_blocks() const { return indptr_.back(); }
  /// Row starts, (num_nodes + 1,), and column nodes, ascending, (num_blocks,).
  const std::vector<std::int64_t>& indptr() const { return indptr_; }
  template <typename Index>
  std::vector<Index> columns() const;
  /// Each row by itself, or equal ones in one place.
  MatrixRows own_rows() const;
  MatrixRows shared_rows(const std::uint8_t* fixed) const;
  /// Puts those into one place whose values are equal, too: walls may be alike from plane to plane.
  void merge_equal(MatrixRows& rows, std::vector<double>& values) const;
  /// From the plan where the pattern is known; prescribed components take no part.
  StokesPlan::Symbolic analyze(const std::uint8_t* fixed, StokesPlan& plan) const;
  /// @param fixed (num_grid_nodes, D) nonzero where the component is prescribed
  /// @param bulk  on C' M^-1 C
  /// @return (blocks of the rows, D, D)
  std::vector<double> assemble(const std::uint8_t* fixed, double bulk, const MatrixRows& rows,
                               ThreadPool& pool) const;
  /// Of such values, (num_nodes, D, D).
  std::vector<double> diagonal(const std::vector<double>& values, const MatrixRows& rows) const;

 private:
  static constexpr int kCorners = 1 << D, kPatch = 3 * kCorners / 2;

  void add_cells(double bulk, const MatrixRows& rows, double* values, ThreadPool& pool) const;
  void add_faces(const MatrixRows& rows, double* values, ThreadPool& pool) const;
  std::vector<std::uint8_t> near_walls() const;
  double* block(double* values, const MatrixRows& rows, std::int64_t node, int bit) const {
    return values +
           (rows.first(node) + stencils_[static_cast<std::size_t>(node)].rank(bit)) * D * D;
  }

  const FlowOperator<D>& op_;
  std::vector<NodeStencil> stencils_;
  std::vector<std::int64_t> indptr_;
  int cell_bit_[kCorners][kCorners];      // stencil bit of corner j seen from corner i
  int patch_bit_[D][kPatch][kPatch];      // the same in the three layers about a face
  std::int64_t patch_offset_[D][kPatch];  // nodes of the patch from the lower cell's first
};

}  // namespace diffsim
