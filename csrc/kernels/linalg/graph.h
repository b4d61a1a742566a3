// A symmetric sparsity pattern without its diagonal: what ordering and symbolic analysis work on.
#pragma once

#include <cstdint>
#include <vector>

namespace diffsim {

struct Graph {
  int num_nodes = 0;
  std::vector<std::int64_t> begin;  // (num_nodes + 1)
  std::vector<int> neighbors;       // sorted as given, no self loops

  const int* first(int node) const { return neighbors.data() + begin[node]; }
  const int* last(int node) const { return neighbors.data() + begin[node + 1]; }
  std::int64_t degree(int node) const { return begin[node + 1] - begin[node]; }
};

}  // namespace diffsim
