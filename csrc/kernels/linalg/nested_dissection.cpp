#include "kernels/linalg/nested_dissection.h"

#include <algorithm>
#include <bitset>
#include <cmath>
#include <cstddef>
#include <utility>

#include "kernels/linalg/separator.h"

namespace diffsim {
namespace {

constexpr std::size_t kLeafSize = 32;   // parts up to here are ordered by minimum degree
constexpr std::size_t kMaskSize = 512;  // leaf nodes and the neighbors around them

class Dissector {
 public:
  Dissector(const Graph& graph, const double* coords, bool lattice)
      : graph_(graph),
        coords_(coords),
        lattice_(lattice),
        owner_(graph.num_nodes, 0),
        mark_(graph.num_nodes, -1),
        finder_(graph),
        order_(graph.num_nodes) {}

  std::vector<int> run() {
    // A node coupled to almost everything would spoil every separator: eliminate it last.
    const double dense = std::max(64.0, 10.0 * std::sqrt(double(graph_.num_nodes)));
    std::vector<int> rest, hubs;
    for (int v = 0; v < graph_.num_nodes; ++v) {
      (graph_.degree(v) > dense ? hubs : rest).push_back(v);
    }
    for (int v : hubs) owner_[v] = -1;
    std::copy(hubs.begin(), hubs.end(), order_.begin() + rest.size());
    work_.push_back({std::move(rest), 0, 0});
    while (!work_.empty()) {
      Item item = std::move(work_.back());
      work_.pop_back();
      dissect(item);
    }
    return std::move(order_);
  }

 private:
  struct Item {
    std::vector<int> nodes;
    std::size_t begin;  // slots [begin, begin + nodes.size()) of the order are theirs
    int id;
  };

  void push(std::vector<int> nodes, std::size_t begin) {
    if (nodes.empty()) return;
    const int id = ++last_id_;
    for (int v : nodes) owner_[v] = id;
    work_.push_back({std::move(nodes), begin, id});
  }

  void dissect(const Item& item) {
    if (item.nodes.size() <= kLeafSize) return order_leaf(item);
    if (split_components(item)) return;
    const Part part{item.nodes, owner_, item.id};
    Separation best;
    for (const std::vector<double>& key : directions(item)) {
      const auto [low, high] = std::minmax_element(key.begin(), key.end());
      if (!(*high > *low)) continue;
      Separation s = finder_.split(part, key);
      if (best.score == 0 || s.score < best.score) best = std::move(s);
    }
    const std::size_t n = item.nodes.size();
    if (best.score == 0 || best.left.empty() || best.right.empty() ||
        best.separator.size() > n / 2) {
      return order_levels(item);
    }
    const std::size_t right_begin = item.begin + best.left.size();
    const std::size_t separator_begin = right_begin + best.right.size();
    for (int v : best.separator) owner_[v] = -1;
    std::copy(best.separator.begin(), best.separator.end(), order_.begin() + separator_begin);
    push(std::move(best.left), item.begin);
    push(std::move(best.right), right_begin);
  }

  /// Nodes of the part reached from `start`, nearest first; distances go to distance_.
  std::vector<int> breadth_first(int start, int id) {
    ++stamp_;
    std::vector<int> queue{start};
    mark_[start] = stamp_;
    distance_.resize(graph_.num_nodes);
    distance_[start] = 0;
    for (std::size_t head = 0; head < queue.size(); ++head) {
      const int v = queue[head];
      for (const int* u = graph_.first(v); u != graph_.last(v); ++u) {
        if (owner_[*u] != id || mark_[*u] == stamp_) continue;
        mark_[*u] = stamp_;
        distance_[*u] = distance_[v] + 1;
        queue.push_back(*u);
      }
    }
    return queue;
  }

  /// Where the part is not connected, makes every component a part of its own.
  bool split_components(const Item& item) {
    std::vector<int> component = breadth_first(item.nodes[0], item.id);
    if (component.size() == item.nodes.size()) return false;
    std::size_t begin = item.begin;
    for (int v : item.nodes) {
      if (owner_[v] != item.id) continue;
      component = breadth_first(v, item.id);
      const std::size_t size = component.size();
      push(std::move(component), begin);
      begin += size;
    }
    return true;
  }

  std::vector<std::vector<double>> directions(const Item& item) {
    const std::size_t n = item.nodes.size();
    std::vector<std::vector<double>> keys;
    if (coords_) {
      for (int axis = 0; axis < 3; ++axis) {
        keys.emplace_back(n);
        for (std::size_t i = 0; i < n; ++i) keys.back()[i] = coords_[3 * item.nodes[i] + axis];
      }
    }
    // On a lattice the axes suffice: the graph's directions, taken where their separators happen to
    // be smaller, led to 16-20 % more work for three fluidic funnels and to three times the time.
    if (coords_ && lattice_) return keys;
    // Difference of the distances to two far-apart nodes, for up to three pairs of them.
    std::vector<double> nearest(n, 1e30);  // distance to the nearest node already used
    int start = breadth_first(item.nodes[0], item.id).back();
    for (int pair = 0; pair < 3; ++pair) {
      const int end = breadth_first(start, item.id).back();
      keys.emplace_back(n);
      std::vector<double>& key = keys.back();
      for (std::size_t i = 0; i < n; ++i) key[i] = distance_[item.nodes[i]];
      breadth_first(end, item.id);
      std::size_t farthest = 0;
      for (std::size_t i = 0; i < n; ++i) {
        const double d = distance_[item.nodes[i]];
        nearest[i] = std::min({nearest[i], key[i], d});
        key[i] -= d;
        if (nearest[i] > nearest[farthest]) farthest = i;
      }
      smooth(item, key);
      start = item.nodes[farthest];
    }
    return keys;
  }

  /// Averages a key over neighbors a few times, which breaks the ties of integer distances.
  void smooth(const Item& item, std::vector<double>& key) {
    value_.resize(graph_.num_nodes);
    for (int sweep = 0; sweep < 12; ++sweep) {
      for (std::size_t i = 0; i < key.size(); ++i) value_[item.nodes[i]] = key[i];
      for (std::size_t i = 0; i < key.size(); ++i) {
        const int v = item.nodes[i];
        double sum = value_[v];
        int count = 1;
        for (const int* u = graph_.first(v); u != graph_.last(v); ++u) {
          if (owner_[*u] != item.id) continue;
          sum += value_[*u];
          ++count;
        }
        key[i] = sum / count;
      }
    }
  }

  /// Minimum degree on the leaf's elimination graph, its surroundings included as never eliminated.
  void order_leaf(const Item& item) {
    const int n = static_cast<int>(item.nodes.size());
    ++stamp_;
    local_.resize(graph_.num_nodes);
    int next = n;
    for (int i = 0; i < n; ++i) {
      mark_[item.nodes[i]] = stamp_;
      local_[item.nodes[i]] = i;
    }
    std::vector<std::bitset<kMaskSize>> adjacent(n);
    for (int i = 0; i < n; ++i) {
      for (const int* u = graph_.first(item.nodes[i]); u != graph_.last(item.nodes[i]); ++u) {
        if (mark_[*u] != stamp_) {
          mark_[*u] = stamp_;
          local_[*u] = next++;
        }
        if (local_[*u] < static_cast<int>(kMaskSize)) adjacent[i].set(local_[*u]);
      }
    }
    std::vector<char> done(n, 0);
    for (int k = 0; k < n; ++k) {
      int best = -1;
      std::size_t least = kMaskSize + 1;
      for (int i = 0; i < n; ++i) {
        if (done[i]) continue;
        const std::size_t degree = adjacent[i].count();
        if (degree < least) {
          least = degree;
          best = i;
        }
      }
      done[best] = 1;
      order_[item.begin + k] = item.nodes[best];
      for (int i = 0; i < n; ++i) {
        if (done[i] || !adjacent[best][i]) continue;
        adjacent[i] |= adjacent[best];
        adjacent[i].reset(i);
        adjacent[i].reset(best);
      }
    }
  }

  /// Reverse Cuthill-McKee for a part that has no good separator.
  void order_levels(const Item& item) {
    const int start = breadth_first(item.nodes[0], item.id).back();
    const std::vector<int> levels = breadth_first(start, item.id);
    std::copy(levels.rbegin(), levels.rend(), order_.begin() + item.begin);
  }

  const Graph& graph_;
  const double* coords_;
  const bool lattice_;
  std::vector<int> owner_;  // node -> id of its part; -1 once ordered
  std::vector<int> mark_, distance_, local_;
  std::vector<double> value_;
  SeparatorFinder finder_;
  std::vector<int> order_;
  std::vector<Item> work_;
  int last_id_ = 0, stamp_ = 0;
};

}  // namespace

std::vector<int> nested_dissection(const Graph& graph, const double* coords, bool lattice) {
  if (graph.num_nodes == 0) return {};
  return Dissector(graph, coords, lattice).run();
}

}  // namespace diffsim
