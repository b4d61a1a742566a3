// Cholesky factors of several sparse matrices of one pattern at once, one in each lane of a
// register.
//
// A small matrix cannot fill registers by itself: its fronts are narrow, and scattering entries
// costs as much as arithmetic. Members of a batch share their pattern, so that every operation on
// 3x3 blocks is the same for all of them. Lanes do not mix: a member's bits do not depend on which
// others are beside it, or on whether there are any.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/linalg/lanes.h"

namespace diffsim {

/// Where the blocks of A (lower triangle in elimination order) and of its factor L lie. Immutable.
class LanePattern {
 public:
  /// A block of A by a CSR entry: its place, and whether the entry is the block's transpose.
  struct Place {
    std::int32_t block;
    bool transposed;
  };

  /// @param row_start, column  CSR graph of the nodes, symmetric, diagonal included
  /// @param order              elimination order: order[k] = node eliminated k-th
  LanePattern(const std::vector<std::int64_t>& row_start, const std::vector<std::int64_t>& column,
              std::vector<int> order);

  std::int64_t num_nodes() const { return static_cast<std::int64_t>(order_.size()); }
  std::int64_t num_blocks() const { return static_cast<std::int64_t>(a_row_.size()); }
  std::int64_t num_factor_blocks() const { return static_cast<std::int64_t>(row_.size()); }
  /// Products of two 3x3 blocks that a factorization takes.
  std::int64_t num_products() const { return num_products_; }
  const Place& place(std::int64_t entry) const { return place_[static_cast<std::size_t>(entry)]; }
  int position(std::int64_t node) const { return position_[static_cast<std::size_t>(node)]; }

 private:
  friend class LaneCholesky;
  struct Update {
    int column, slot;  // a column to the left, and where its block of this column's row lies
  };

  std::vector<int> order_, position_;
  std::vector<Place> place_;
  std::vector<int> a_row_, a_column_, a_slot_;  // of A's blocks, by elimination order; slot in L
  std::vector<int> a_start_;                    // where each column's begin
  std::vector<int> start_, row_;                // columns of L, diagonal first, rows ascending
  std::vector<int> update_start_;               // of panels of columns
  std::vector<Update> update_;
  std::int64_t num_products_ = 0;
};

/// Matrices and factors of one pattern, kNativeLanes of them.
class LaneCholesky {
 public:
  static constexpr int kCount = kNativeLanes;

  /// Begins new matrices: all zero.
  void clear(const LanePattern& pattern);
  /// The same of one lane, the others stay as they are.
  void clear_lane(const LanePattern& pattern, int lane);
  /// Entry (i, k) of a block of one lane is at block(index, lane)[(3 i + k) * kCount].
  double* block(std::int64_t index, int lane) { return matrix_.data() + index * 9 * kCount + lane; }
  /// Factors what was added since clear(). In the factor, rows and columns of fixed unknowns are
  /// those of the identity.
  /// @param fixed  (num_nodes, 3), nonzero where fixed
  /// @return bit l is set where the matrix of lane l is positive definite to working precision
  unsigned factor(const LanePattern& pattern, const std::uint8_t* fixed);

  /// Vectors of all lanes in elimination order, (num_nodes, 3, kCount).
  using Columns = AlignedBuffer<double>;
  static void put(const LanePattern& pattern, const double* from, int lane, Columns& to);
  static void get(const LanePattern& pattern, const Columns& from, int lane, double* to);
  /// x = A^-1 x.
  void solve(const LanePattern& pattern, Columns& x) const;
  /// y = A x.
  void multiply(const LanePattern& pattern, const Columns& x, Columns& y) const;

 private:
  void fill_column(const LanePattern& pattern, const std::uint8_t* fixed, int column);
  NativeMask factor_panel(const LanePattern& pattern, int first);
  NativeMask factor_column(const LanePattern& pattern, int column, const Native floor[3]);

  AlignedBuffer<double> matrix_, factor_;
  std::vector<int> slot_of_row_;
};

}  // namespace diffsim
