// Cholesky factors of small sparse matrices of 3x3 blocks, in an order of minimum fill.
//
// What a large factor gains by (wide fronts, threads) a small one has not: its supernodes have one
// to four columns of blocks, and minimum fill takes a quarter of the products that nested
// dissection does. A block is three columns in a register each, so that one matrix fills registers
// by itself.
#pragma once

#include <cstdint>
#include <cstring>
#include <vector>

#include "kernels/linalg/aligned_buffer.h"

namespace diffsim {

/// Where the blocks of A (lower triangle in elimination order) and of its factor L lie. Immutable.
class SmallPattern {
 public:
  /// A block of A by a CSR entry: its place, and whether the entry is the block's transpose.
  struct Place {
    std::int32_t block;
    bool transposed;
  };

  /// @param row_start, column  CSR graph of the nodes, symmetric, diagonal included
  SmallPattern(const std::vector<std::int64_t>& row_start, const std::vector<std::int32_t>& column);

  std::int64_t num_nodes() const { return static_cast<std::int64_t>(order_.size()); }
  std::int64_t num_blocks() const { return static_cast<std::int64_t>(a_row_.size()); }
  std::int64_t num_factor_blocks() const { return static_cast<std::int64_t>(row_.size()); }
  /// Products of two 3x3 blocks that a factorization takes.
  std::int64_t num_products() const { return num_products_; }
  const Place& place(std::int64_t entry) const { return place_[static_cast<std::size_t>(entry)]; }

 private:
  friend class SmallCholesky;
  /// Columns to the left of one with the same rows from slot `slot` of the first of them on, where
  /// that one's row is.
  struct Update {
    int column, count, slot;
  };

  std::vector<int> order_;  // order_[k] = node eliminated k-th
  std::vector<Place> place_;
  std::vector<int> a_row_, a_column_, a_slot_;  // of A's blocks, by elimination order; slot in L
  std::vector<int> a_start_;                    // where each column's begin
  std::vector<int> start_, row_;                // columns of L, diagonal first, rows ascending
  std::vector<int> update_start_;               // of columns
  std::vector<Update> update_;
  std::int64_t num_products_ = 0;
};

/// A matrix of a pattern, and its factor.
class SmallCholesky {
 public:
  /// Entry (i, k) of a block is at [kColumn k + i].
  static constexpr int kColumn = 4, kBlock = 3 * kColumn;

  /// Begins a new matrix: all zero.
  void clear(const SmallPattern& pattern);
  double* block(std::int64_t index) { return matrix_.data() + index * kBlock; }
  /// Adds a block (3, 3), row-major, column by column.
  void add(std::int64_t index, const double entries[9]) {
    using Column = double __attribute__((vector_size(kColumn * sizeof(double))));
    for (int k = 0; k < 3; ++k) {
      double* to = block(index) + k * kColumn;
      Column sum;
      std::memcpy(&sum, to, sizeof(Column));
      sum += Column{entries[k], entries[3 + k], entries[6 + k], 0.0};
      std::memcpy(to, &sum, sizeof(Column));
    }
  }
  /// Factors what was added since clear(). In the factor, rows and columns of fixed unknowns are
  /// those of the identity.
  /// @param fixed  (num_nodes, 3), nonzero where fixed
  /// @return whether the matrix is positive definite to working precision
  bool factor(const SmallPattern& pattern, const std::uint8_t* fixed);
  /// x = A^-1 b, (num_nodes, 3) each; they may be one.
  void solve(const SmallPattern& pattern, const double* b, double* x);
  /// y = A x, (num_nodes, 3) each.
  void multiply(const SmallPattern& pattern, const double* x, double* y);

 private:
  void fill_column(const SmallPattern& pattern, const std::uint8_t* fixed, int column);
  bool factor_column(const SmallPattern& pattern, int column, const double floor[3]);

  AlignedBuffer<double> matrix_, factor_, columns_;
  std::vector<int> slot_of_row_;
};

}  // namespace diffsim
