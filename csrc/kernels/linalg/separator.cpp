#include "kernels/linalg/separator.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numeric>

namespace diffsim {
namespace {

/// Marks the lower half by key: at a gap between equal keys where one lies in the middle third.
std::vector<char> median_sides(const std::vector<int>& nodes, const std::vector<double>& key) {
  const std::size_t n = key.size();
  const auto [low, high] = std::minmax_element(key.begin(), key.end());
  const double tie = 1e-6 * (*high - *low);
  std::vector<double> sorted = key;
  std::nth_element(sorted.begin(), sorted.begin() + n / 2, sorted.end());
  const double median = sorted[n / 2];
  std::size_t below = 0, upto = 0;
  for (double k : key) {
    below += k < median - tie;
    upto += k <= median + tie;
  }
  std::vector<char> side(n);
  const double gap_below = std::abs(double(below) / n - 0.5);
  const double gap_upto = std::abs(double(upto) / n - 0.5);
  if (std::min(gap_below, gap_upto) < 0.17) {
    const double cut = gap_below < gap_upto ? median - tie : median + tie;
    for (std::size_t i = 0; i < n; ++i) side[i] = key[i] >= cut;
    return side;
  }
  std::vector<int> rank(n);
  std::iota(rank.begin(), rank.end(), 0);
  std::nth_element(rank.begin(), rank.begin() + n / 2, rank.end(), [&](int a, int b) {
    return key[a] != key[b] ? key[a] < key[b] : nodes[a] < nodes[b];
  });
  for (std::size_t i = n / 2; i < n; ++i) side[rank[i]] = 1;
  return side;
}

}  // namespace

SeparatorFinder::SeparatorFinder(const Graph& graph)
    : graph_(graph), local_(graph.num_nodes, -1), side_(graph.num_nodes, 0) {}

bool SeparatorFinder::augment(int start) {
  // Depth-first search for an augmenting path, with an explicit stack of (vertex, next edge).
  std::vector<std::pair<int, std::size_t>> path{{start, 0}};
  while (!path.empty()) {
    const int v = path.back().first;
    std::size_t& next = path.back().second;
    if (next == edges_[v].size()) {
      path.pop_back();
      continue;
    }
    const int right = edges_[v][next++];
    if (visited_[right] == visit_) continue;
    visited_[right] = visit_;
    if (match_right_[right] >= 0) {
      path.emplace_back(match_right_[right], 0);
      continue;
    }
    for (auto step = path.rbegin(); step != path.rend(); ++step) {
      const int target = edges_[step->first][step->second - 1];
      match_right_[target] = step->first;
      match_left_[step->first] = target;
    }
    return true;
  }
  return false;
}

Separation SeparatorFinder::assemble(const Part& part, const std::vector<char>& cut) const {
  Separation s;
  for (int v : part.nodes) {
    if (local_[v] >= 0 && cut[2 * local_[v] + side_[v]]) {
      s.separator.push_back(v);
    } else {
      (side_[v] ? s.right : s.left).push_back(v);
    }
  }
  const double n = static_cast<double>(part.nodes.size());
  const double imbalance = std::abs(double(s.left.size()) - double(s.right.size())) / n;
  s.score = (s.separator.size() + 1e-3) * (1.0 + imbalance);
  return s;
}

Separation SeparatorFinder::split(const Part& part, const std::vector<double>& key) {
  const std::vector<char> sides = median_sides(part.nodes, key);
  for (std::size_t i = 0; i < sides.size(); ++i) side_[part.nodes[i]] = sides[i];

  std::vector<int> left, right;
  for (int v : part.nodes) {
    if (side_[v]) continue;
    for (const int* u = graph_.first(v); u != graph_.last(v); ++u) {
      if (part.owner[*u] != part.id || !side_[*u]) continue;
      if (local_[v] < 0) {
        local_[v] = static_cast<int>(left.size());
        left.push_back(v);
        if (edges_.size() < left.size()) edges_.emplace_back();
        edges_[local_[v]].clear();
      }
      if (local_[*u] < 0) {
        local_[*u] = static_cast<int>(right.size());
        right.push_back(*u);
      }
      edges_[local_[v]].push_back(local_[*u]);
    }
  }
  match_left_.assign(left.size(), -1);
  match_right_.assign(right.size(), -1);
  visited_.assign(right.size(), 0);
  visit_ = 0;
  for (std::size_t v = 0; v < left.size(); ++v) {  // greedy start, then augmenting paths
    for (int u : edges_[v]) {
      if (match_right_[u] >= 0) continue;
      match_right_[u] = static_cast<int>(v);
      match_left_[v] = u;
      break;
    }
  }
  for (std::size_t v = 0; v < left.size(); ++v) {
    ++visit_;
    if (match_left_[v] < 0) augment(static_cast<int>(v));
  }
  // Koenig: Z = what alternating paths reach from free left vertices; cover = (L \ Z) + (R & Z).
  std::vector<char> reached_left(left.size(), 0), reached_right(right.size(), 0);
  std::vector<int> queue;
  for (std::size_t v = 0; v < left.size(); ++v) {
    if (match_left_[v] < 0) queue.push_back(static_cast<int>(v));
  }
  for (int v : queue) reached_left[v] = 1;
  for (std::size_t head = 0; head < queue.size(); ++head) {
    for (int u : edges_[queue[head]]) {
      if (reached_right[u]) continue;
      reached_right[u] = 1;
      const int v = match_right_[u];
      if (v >= 0 && !reached_left[v]) {
        reached_left[v] = 1;
        queue.push_back(v);
      }
    }
  }
  const std::size_t width = std::max(left.size(), right.size());
  std::vector<char> cover(2 * width, 0), all_left(2 * width, 0), all_right(2 * width, 0);
  for (std::size_t v = 0; v < left.size(); ++v) {
    cover[2 * v] = !reached_left[v];
    all_left[2 * v] = 1;
  }
  for (std::size_t u = 0; u < right.size(); ++u) {
    cover[2 * u + 1] = reached_right[u];
    all_right[2 * u + 1] = 1;
  }
  // One whole side of the cut may be as small as the cover and better balanced.
  Separation best = assemble(part, cover);
  for (const auto* candidate : {&all_left, &all_right}) {
    Separation other = assemble(part, *candidate);
    if (other.score < best.score) best = std::move(other);
  }
  for (int v : left) local_[v] = -1;
  for (int v : right) local_[v] = -1;
  return best;
}

}  // namespace diffsim
