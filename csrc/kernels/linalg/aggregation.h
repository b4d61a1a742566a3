// Groups of neighboring nodes, the coarse nodes of algebraic multigrid.
#pragma once

#include <cstdint>
#include <vector>

namespace diffsim {

/// Rows and columns of a sparse matrix of blocks, columns ascending.
struct Pattern {
  std::vector<std::int64_t> row_start;  // (num_rows + 1)
  std::vector<std::int32_t> column;

  std::int64_t num_rows() const { return static_cast<std::int64_t>(row_start.size()) - 1; }
  std::int64_t begin(std::int64_t row) const { return row_start[static_cast<std::size_t>(row)]; }
  std::int64_t end(std::int64_t row) const { return row_start[static_cast<std::size_t>(row + 1)]; }
  std::int32_t operator[](std::int64_t entry) const {
    return column[static_cast<std::size_t>(entry)];
  }
};

struct Aggregates {
  std::int64_t count = 0;
  std::vector<std::int32_t> of_node;  // (num_nodes,)
};

/// A node whose neighbors are all free takes them; what is left joins the aggregate of a neighbor
/// (Vanek, Mandel and Brezina 1996, "Algebraic multigrid by smoothed aggregation", algorithm 5.1).
/// Depends on the order of the nodes alone.
/// @param graph  symmetric, the diagonal included
Aggregates aggregate_nodes(const Pattern& graph);

}  // namespace diffsim
