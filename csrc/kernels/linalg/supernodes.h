// Elimination tree and relaxed supernodes of an ordered graph.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/graph.h"

namespace diffsim {

/// Columns of the factor, grouped into supernodes that share their row structure. Supernodes and
/// columns are numbered in postorder: a subtree of the elimination tree is a contiguous range.
struct Supernodes {
  std::vector<int> order;                // order[k] = node eliminated k-th
  std::vector<int> begin;                // (count + 1) first column of each supernode
  std::vector<int> parent;               // (count) parent supernode, -1 for a root
  std::vector<std::int64_t> rows_begin;  // (count + 1)
  std::vector<int> rows;                 // rows below each supernode's own columns, ascending

  int count() const { return static_cast<int>(parent.size()); }
};

/// Symbolic factorization of `graph` eliminated in `order`. A child is merged into its parent where
/// a cost model of the triangular solve (entries streamed + rows gathered + a fixed share) says so.
/// @param weight (num_nodes) unknowns of every node, which scale the model
Supernodes find_supernodes(const Graph& graph, std::vector<int> order,
                           const std::vector<int>& weight);

}  // namespace diffsim
