#include "kernels/linalg/supernodes.h"

#include <algorithm>
#include <cstddef>
#include <numeric>
#include <utility>

namespace diffsim {
namespace {

// Weights of the cost model, in units of one factor entry streamed in a solve. The time of a solve
// is flat around them (half or double changes it by 5 %); lower ones save memory.
constexpr double kCostPerRow = 8;
constexpr double kCostPerSupernode = 300;

std::vector<int> inverse(const std::vector<int>& order) {
  std::vector<int> position(order.size());
  for (std::size_t k = 0; k < order.size(); ++k) position[order[k]] = static_cast<int>(k);
  return position;
}

/// Parent of every column in the elimination tree (Liu's algorithm with path compression).
std::vector<int> elimination_tree(const Graph& graph, const std::vector<int>& order,
                                  const std::vector<int>& position) {
  std::vector<int> parent(order.size(), -1), ancestor(order.size(), -1);
  for (int k = 0; k < graph.num_nodes; ++k) {
    for (const int* u = graph.first(order[k]); u != graph.last(order[k]); ++u) {
      for (int i = position[*u]; i >= 0 && i < k;) {
        const int next = ancestor[i];
        ancestor[i] = k;
        if (next < 0) parent[i] = k;
        if (next == k) break;
        i = next;
      }
    }
  }
  return parent;
}

/// Vertices of a forest, children before parents, each subtree contiguous.
std::vector<int> postorder(const std::vector<int>& parent) {
  const int n = static_cast<int>(parent.size());
  std::vector<int> child(n, -1), sibling(n, -1), result, stack;
  for (int v = n - 1; v >= 0; --v) {
    if (parent[v] < 0) continue;
    sibling[v] = child[parent[v]];
    child[parent[v]] = v;
  }
  result.reserve(n);
  for (int root = 0; root < n; ++root) {
    if (parent[root] >= 0) continue;
    stack.push_back(root);
    while (!stack.empty()) {
      const int v = stack.back();
      if (child[v] >= 0) {
        stack.push_back(child[v]);
        child[v] = sibling[child[v]];
      } else {
        result.push_back(v);
        stack.pop_back();
      }
    }
  }
  return result;
}

/// Entries in every column of the factor, by walking each row's subtree.
std::vector<int> column_counts(const Graph& graph, const std::vector<int>& order,
                               const std::vector<int>& position, const std::vector<int>& parent) {
  std::vector<int> count(order.size(), 1), mark(order.size(), -1);
  for (int k = 0; k < graph.num_nodes; ++k) {
    mark[k] = k;
    for (const int* u = graph.first(order[k]); u != graph.last(order[k]); ++u) {
      for (int i = position[*u]; i < k && mark[i] != k; i = parent[i]) {
        ++count[i];
        mark[i] = k;
      }
    }
  }
  return count;
}

/// A supernode while merging: columns and rows are positions in the original order.
struct Node {
  std::vector<int> columns, rows, children;
  double own = 0, below = 0;  // unknowns of columns and of rows
  int parent = -1;
  bool alive = true;
};

/// Supernodes without any added zeros.
std::vector<Node> fundamental(const Graph& graph, const std::vector<int>& order,
                              const std::vector<int>& position, const std::vector<int>& parent,
                              const std::vector<int>& count) {
  const int n = graph.num_nodes;
  std::vector<Node> nodes;
  std::vector<int> owner(n), mark(n, -1);
  for (int j = 0; j < n; ++j) {
    if (j == 0 || parent[j - 1] != j || count[j - 1] != count[j] + 1) nodes.emplace_back();
    owner[j] = static_cast<int>(nodes.size()) - 1;
    nodes.back().columns.push_back(j);
  }
  for (std::size_t s = 0; s < nodes.size(); ++s) {
    Node& node = nodes[s];
    const int last = node.columns.back();
    auto add = [&](int row) {
      if (row <= last || mark[row] == static_cast<int>(s)) return;
      mark[row] = static_cast<int>(s);
      node.rows.push_back(row);
    };
    for (int j : node.columns) {
      for (const int* u = graph.first(order[j]); u != graph.last(order[j]); ++u) add(position[*u]);
    }
    for (int c : node.children) {
      for (int row : nodes[c].rows) add(row);
    }
    std::sort(node.rows.begin(), node.rows.end());
    if (parent[last] >= 0) {
      node.parent = owner[parent[last]];
      nodes[node.parent].children.push_back(static_cast<int>(s));
    }
  }
  return nodes;
}

double cost(double c, double r) {
  return c * (0.5 * c + r) + kCostPerRow * (c + r) + kCostPerSupernode;
}

void amalgamate(std::vector<Node>& nodes) {
  for (std::size_t s = 0; s < nodes.size(); ++s) {
    Node& node = nodes[s];
    for (bool merged = true; merged;) {
      merged = false;
      std::vector<int> kept;
      const std::vector<int> children = std::move(node.children);
      node.children.clear();
      for (int c : children) {
        Node& child = nodes[c];
        const double apart = cost(node.own, node.below) + cost(child.own, child.below);
        if (cost(node.own + child.own, node.below) >= apart) {
          kept.push_back(c);
          continue;
        }
        node.columns.insert(node.columns.end(), child.columns.begin(), child.columns.end());
        node.own += child.own;
        for (int grandchild : child.children) {
          nodes[grandchild].parent = static_cast<int>(s);
          kept.push_back(grandchild);
        }
        child = Node{};
        child.alive = false;
        merged = true;
      }
      node.children = std::move(kept);
    }
  }
}

}  // namespace

Supernodes find_supernodes(const Graph& graph, std::vector<int> order,
                           const std::vector<int>& weight) {
  std::vector<int> position = inverse(order);
  {
    const std::vector<int> post = postorder(elimination_tree(graph, order, position));
    std::vector<int> reordered(order.size());
    for (std::size_t k = 0; k < order.size(); ++k) reordered[k] = order[post[k]];
    order = std::move(reordered);
    position = inverse(order);
  }
  const std::vector<int> parent = elimination_tree(graph, order, position);
  std::vector<Node> nodes =
      fundamental(graph, order, position, parent, column_counts(graph, order, position, parent));
  for (Node& node : nodes) {
    for (int j : node.columns) node.own += weight[order[j]];
    for (int row : node.rows) node.below += weight[order[row]];
  }
  amalgamate(nodes);

  std::vector<int> tree, number(nodes.size(), -1), original;
  for (std::size_t s = 0; s < nodes.size(); ++s) {
    if (!nodes[s].alive) continue;
    number[s] = static_cast<int>(original.size());
    original.push_back(static_cast<int>(s));
  }
  for (int s : original) tree.push_back(nodes[s].parent < 0 ? -1 : number[nodes[s].parent]);
  const std::vector<int> post = postorder(tree);
  const std::vector<int> rank = inverse(post);

  Supernodes result;
  std::vector<int> moved(order.size());  // position before -> after
  result.begin.push_back(0);
  for (int t : post) {
    Node& node = nodes[original[t]];
    std::sort(node.columns.begin(), node.columns.end());
    for (int j : node.columns) {
      moved[j] = static_cast<int>(result.order.size());
      result.order.push_back(order[j]);
    }
    result.begin.push_back(static_cast<int>(result.order.size()));
    result.parent.push_back(tree[t] < 0 ? -1 : rank[tree[t]]);
  }
  result.rows_begin.push_back(0);
  for (int t : post) {
    const std::vector<int>& rows = nodes[original[t]].rows;
    const std::size_t first = result.rows.size();
    for (int row : rows) result.rows.push_back(moved[row]);
    std::sort(result.rows.begin() + first, result.rows.end());
    result.rows_begin.push_back(static_cast<std::int64_t>(result.rows.size()));
  }
  return result;
}

}  // namespace diffsim
