// LU factors of a few small matrices side by side, one in each lane.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "kernels/linalg/lanes.h"

namespace diffsim {

/// P A = L U with row pivots, of a matrix in each lane. What a lane holds does not depend on
/// others.
class LaneLu {
 public:
  explicit LaneLu(int size)
      : size_(size), lu_(at(size * size)), order_(at(size * kNativeLanes)), ordered_(at(size)) {}

  /// Factors A in the lanes of a mask; others keep their factors.
  /// @param A (size, size) column by column, used up
  void factor(Native* A, const NativeMask& wanted) {
    for (int k = 0; k < size_; ++k)
      for (int lane = 0; lane < kNativeLanes; ++lane)
        if (wanted[lane]) order(k, lane) = k;
    for (int k = 0; k < size_; ++k) {
      Native* column = A + k * size_;
      for (int lane = 0; lane < kNativeLanes; ++lane)
        if (wanted[lane]) choose_pivot(A, k, lane);
      const Native one = broadcast<Native>(1.0), none{};
      const NativeMask is_zero = column[k] == none;  // all below is, too
      const Native inverse = one / select(is_zero, one, column[k]);
      for (int i = k + 1; i < size_; ++i) column[i] *= inverse;
      for (int j = k + 1; j < size_; ++j) {
        Native* other = A + j * size_;
        const Native scale = other[k];
        for (int i = k + 1; i < size_; ++i) other[i] -= scale * column[i];
      }
    }
    for (std::size_t i = 0; i < lu_.size(); ++i) lu_[i] = select(wanted, A[i], lu_[i]);
  }

  /// x = A^-1 b, (size); x may be b.
  void solve(const Native* b, Native* x) {
    for (int k = 0; k < size_; ++k)
      for (int lane = 0; lane < kNativeLanes; ++lane)
        ordered_[at(k)][lane] = b[order(k, lane)][lane];
    for (int k = 0; k < size_; ++k) {
      const Native* column = lu_.data() + k * size_;
      const Native own = ordered_[at(k)];
      for (int i = k + 1; i < size_; ++i) ordered_[at(i)] -= own * column[i];
    }
    for (int k = size_ - 1; k >= 0; --k) {
      const Native* column = lu_.data() + k * size_;
      const Native own = x[k] = ordered_[at(k)] / column[k];
      for (int i = 0; i < k; ++i) ordered_[at(i)] -= own * column[i];
    }
  }

 private:
  static std::size_t at(int i) { return static_cast<std::size_t>(i); }
  int& order(int k, int lane) { return order_[at(k * kNativeLanes + lane)]; }

  /// Brings the largest entry of what is left of column k to its diagonal, in one lane.
  void choose_pivot(Native* A, int k, int lane) {
    const Native* column = A + k * size_;
    int best = k;
    for (int i = k + 1; i < size_; ++i)
      if (std::abs(column[i][lane]) > std::abs(column[best][lane])) best = i;
    if (best == k) return;
    for (int j = 0; j < size_; ++j) {
      Native *to = A + j * size_ + k, *from = A + j * size_ + best;
      const double kept = (*to)[lane];
      (*to)[lane] = (*from)[lane];
      (*from)[lane] = kept;
    }
    std::swap(order(k, lane), order(best, lane));
  }

  int size_;
  std::vector<Native> lu_;
  std::vector<int> order_;  // (size, lanes) row of A that stands in each row
  std::vector<Native> ordered_;
};

}  // namespace diffsim
