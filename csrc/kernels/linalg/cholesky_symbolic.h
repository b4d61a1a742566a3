// What the symbolic analysis of a sparse Cholesky factorization knows.
//
// Storage. Supernode s has `num_cols` own unknowns and `num_rows` rows below. Locally they are
// numbered [own, padding to 8][rows below, padding to 8]. Its part of L is cut into panels of 8
// columns (the last may be narrower, `width` w); panel p holds the 8-row tiles p, p+1, ..,
// num_tiles-1, one after the other, each tile column by column: (w, 8) doubles. Padding is zero.
// A solve thus reads L front to back in whole cache lines. The tile on the diagonal holds the
// inverse of the panel's lower triangular block. Update matrices (the Schur complement that a
// supernode sends to its parent) use the same layout with full panels.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace diffsim {

constexpr int kTile = 8;  // rows and columns of a tile

inline std::int64_t tiles_of(std::int64_t n) { return (n + kTile - 1) / kTile; }

/// Doubles in a lower triangle of `tiles` x `tiles` full tiles.
inline std::int64_t triangle_size(std::int64_t tiles) {
  return tiles * (tiles + 1) / 2 * kTile * kTile;
}

struct CholeskySupernode {
  int first = 0;     // first unknown in elimination order
  int num_cols = 0;  // own unknowns
  int num_rows = 0;  // unknowns below
  int parent = -1;
  int task = -1;          // subtree task, -1 in the top of the tree
  std::int64_t rows = 0;  // offset of its rows in `row_unknown` and `row_in_parent`
  std::int64_t children = 0, children_end = 0;  // range in `children`
  std::int64_t entries = 0, entries_end = 0;    // range in `entries`
  std::int64_t factor = 0;                      // offset of its panels in the factor
  std::int64_t update = 0;                      // offset of its update matrix among the fronts
  // In the workspace of a solve, in doubles per right-hand side: offsets of its own unknowns, of
  // the update vector for its parent, and of the local vector it works on.
  std::int64_t own = 0, message = 0, scratch = 0;

  int panels() const { return static_cast<int>(tiles_of(num_cols)); }
  int update_tiles() const { return static_cast<int>(tiles_of(num_rows)); }
  int num_tiles() const { return panels() + update_tiles(); }
  int width(int panel) const { return std::min(kTile, num_cols - panel * kTile); }
  /// Offset of a panel from the supernode's first one: all panels before it are full.
  std::int64_t panel(std::int64_t p) const {
    return (p * num_tiles() - p * (p - 1) / 2) * kTile * kTile;
  }
  std::int64_t factor_size() const {
    const int last = panels() - 1;
    return panel(last) + std::int64_t{num_tiles() - last} * kTile * width(last);
  }
};

/// One scalar block of the input and where it lands in its supernode.
struct CholeskyEntry {
  std::int64_t source;              // index of the block in the CSR's order
  int row, col;                     // local position of the block's first present unknown
  std::uint8_t row_mask, col_mask;  // which of the block's rows and columns are present, by bit
};

/// Ranges [begin, end) of supernodes; each is one whole subtree.
using CholeskyTask = std::vector<std::pair<int, int>>;

class CholeskySymbolic {
 public:
  std::int64_t num_nodes = 0, num_unknowns = 0, num_blocks = 0;
  int block = 1;
  std::vector<CholeskySupernode> supernodes;  // postorder
  std::vector<int> children;
  std::vector<int> unknown;               // elimination order -> caller's numbering
  std::vector<int> absent;                // unknowns without a place in the matrix
  std::vector<int> row_unknown;           // every supernode's rows in the caller's numbering
  std::vector<int> row_in_parent;         // and as local indices of the parent (padding counted)
  std::vector<int> row_offset_in_parent;  // (row / 8) * 64 + row % 8 of those
  std::vector<CholeskyEntry> entries;

  // The schedule, which depends on the matrix alone and never on the number of threads: first all
  // tasks, then the levels of the top of the tree; supernodes within a level are independent.
  std::vector<CholeskyTask> tasks;
  std::vector<std::vector<int>> levels;

  std::int64_t factor_size = 0;     // stored entries of L
  std::int64_t fronts_size = 0;     // doubles for all update matrices alive at one time
  std::int64_t workspace_size = 0;  // doubles per right-hand side of a solve
  std::int64_t nnz = 0;
  double flops = 0;
};

}  // namespace diffsim
