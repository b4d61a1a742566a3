#include "kernels/linalg/aggregation.h"

#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
constexpr std::int32_t kFree = -1;

bool is_surrounded_by_free(const Pattern& graph, const std::vector<std::int32_t>& of_node,
                           Index node) {
  for (Index k = graph.begin(node); k < graph.end(node); ++k)
    if (of_node[at(graph[k])] != kFree) return false;
  return true;
}

}  // namespace

Aggregates aggregate_nodes(const Pattern& graph) {
  const Index n = graph.num_rows();
  Aggregates found;
  std::vector<std::int32_t>& of_node = found.of_node;
  of_node.assign(at(n), kFree);
  for (Index i = 0; i < n; ++i) {
    if (!is_surrounded_by_free(graph, of_node, i)) continue;
    for (Index k = graph.begin(i); k < graph.end(i); ++k)
      of_node[at(graph[k])] = static_cast<std::int32_t>(found.count);
    ++found.count;
  }
  // Those next to an aggregate join the one that most of their neighbors are in; decided on what
  // the first pass left, or aggregates would grow chains.
  const std::vector<std::int32_t> first = of_node;
  std::vector<std::int32_t> votes(at(found.count), 0);
  for (Index i = 0; i < n; ++i) {
    if (of_node[at(i)] != kFree) continue;
    std::int32_t best = kFree;
    for (Index k = graph.begin(i); k < graph.end(i); ++k) {
      const std::int32_t a = first[at(graph[k])];
      if (a == kFree) continue;
      ++votes[at(a)];
      if (best == kFree || votes[at(a)] > votes[at(best)]) best = a;
    }
    of_node[at(i)] = best;
    for (Index k = graph.begin(i); k < graph.end(i); ++k)
      if (first[at(graph[k])] != kFree) votes[at(first[at(graph[k])])] = 0;
  }
  // What has no aggregate beside it founds one with its free neighbors.
  for (Index i = 0; i < n; ++i) {
    if (of_node[at(i)] != kFree) continue;
    for (Index k = graph.begin(i); k < graph.end(i); ++k)
      if (of_node[at(graph[k])] == kFree)
        of_node[at(graph[k])] = static_cast<std::int32_t>(found.count);
    ++found.count;
  }
  return found;
}

}  // namespace diffsim
