// Vertex separators of a part of a graph.
#pragma once

#include <vector>

#include "kernels/linalg/graph.h"

namespace diffsim {

/// A part of a graph: node v belongs to it where owner[v] == id.
struct Part {
  const std::vector<int>& nodes;
  const std::vector<int>& owner;
  int id;
};

struct Separation {
  std::vector<int> left, right, separator;
  double score = 0;  // separator size with a surcharge for imbalance; smaller is better
};

/// Finds separators; owns scratch of the size of the whole graph, so make one and reuse it.
class SeparatorFinder {
 public:
  explicit SeparatorFinder(const Graph& graph);

  /// Splits the part at the median of `key` (one value per entry of part.nodes), at a gap between
  /// groups of equal keys where one lies near the median, and removes a minimum vertex cover of
  /// the cut edges.
  Separation split(const Part& part, const std::vector<double>& key);

 private:
  bool augment(int left_vertex);
  Separation assemble(const Part& part, const std::vector<char>& in_separator) const;

  const Graph& graph_;
  std::vector<int> local_;  // node -> index among the cut's end nodes, -1 elsewhere
  std::vector<char> side_;  // node -> 0 left, 1 right (valid inside the part)
  // Bipartite graph of the cut: left vertices have edges to right vertices.
  std::vector<std::vector<int>> edges_;
  std::vector<int> match_left_, match_right_, visited_;
  int visit_ = 0;
};

}  // namespace diffsim
