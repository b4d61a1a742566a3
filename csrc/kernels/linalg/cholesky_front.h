// One supernode's dense share of a factorization: its panels of L and its update matrix.
#pragma once

#include <cstdint>

#include "kernels/linalg/cholesky_symbolic.h"
#include "kernels/parallel.h"

namespace diffsim {

/// First failed pivot; column < 0 where there is none.
struct FailedPivot {
  int column = -1;
  double value = 0;
};

/// The front of a supernode: tiles (i, p) with i >= p, over own panels and update panels alike.
/// @tparam T  double or float, what it computes in
template <typename T>
class Front {
 public:
  /// @param own  its panels of L; may be null where the update matrix alone is read
  Front(const CholeskySupernode& node, T* own, T* fronts)
      : node_(node),
        own_(own),
        update_(fronts + node.update),
        panels_(node.panels()),
        tiles_(node.num_tiles()) {}

  int panels() const { return panels_; }
  int tiles() const { return tiles_; }
  int width(int p) const { return p < panels_ ? node_.width(p) : kTile; }
  T* tile(int i, int p) const {
    if (p < panels_) return own_ + node_.panel(p) + (i - p) * kTile * node_.width(p);
    const std::int64_t q = p - panels_, below = tiles_ - panels_;
    return update_ + (q * below - q * (q - 1) / 2 + (i - p)) * kTile * kTile;
  }
  T& at(int row, int col) const {
    return tile(row / kTile, col / kTile)[(col % kTile) * kTile + row % kTile];
  }

  /// @param pool splits the memory, or nullptr
  void set_zero(ThreadPool* pool) const;
  /// Adds the update matrix of a child.
  /// @param map    (child's rows) local rows here
  /// @param offset (child's rows) the same as offsets within a column of full panels
  /// @param pool   splits the columns, or nullptr
  void add(const Front& child, const int* map, const int* offset, ThreadPool* pool) const;
  /// Partial Cholesky: own panels become L (diagonal tiles inverted), the update matrix the Schur
  /// complement.
  /// @param floor (num_cols) pivots must be above this
  /// @param pool  splits the rows, or nullptr
  FailedPivot factor(const double* floor, ThreadPool* pool) const;

 private:
  struct Diagonals;
  void add_column(const Front& child, int c, const int* map, const int* offset) const;
  FailedPivot factor_block(int p0, int p1, const double* floor, Diagonals& diagonals) const;
  void solve_rows(int i, int count, int p0, int p1, const Diagonals& diagonals) const;
  void update_rows(int i, int count, int c0, int c1, int p0, int p1) const;
  void multiply(int i, int count, int p, int q0, int q1) const;

  const CholeskySupernode& node_;
  T* own_;
  T* update_;
  int panels_, tiles_;
};

}  // namespace diffsim
