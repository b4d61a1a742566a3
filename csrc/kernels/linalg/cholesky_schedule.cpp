#include "kernels/linalg/cholesky_schedule.h"

#include <cstddef>
#include <iterator>
#include <map>

namespace diffsim {
namespace {

constexpr double kTasksWanted = 24;    // enough to balance a handful of threads
constexpr double kSerialWork = 30000;  // below this much work one task does everything

/// Work of a supernode: entries streamed by a solve plus a share of the factorization.
double work(const CholeskySupernode& s) {
  const double c = s.num_cols, r = s.num_rows;
  const double entries = c * (0.5 * c + r);
  const double flops = c * (c * c / 3 + c * r + r * r);
  return entries + flops / 64 + 8 * (c + r);
}

/// Two stacks for the results that children leave for their parent. Children sit at one depth and
/// their parent at another, so a result is pushed on one stack while the children's, on top of the
/// other, are still being read.
class ParityStacks {
 public:
  std::int64_t push(int depth, std::int64_t size) {
    const std::int64_t offset = top_[depth & 1];
    top_[depth & 1] += size;
    peak_[depth & 1] = std::max(peak_[depth & 1], top_[depth & 1]);
    return offset;
  }
  void pop(int depth, std::int64_t size) { top_[depth & 1] -= size; }
  std::int64_t place(std::int64_t base, int depth, std::int64_t offset) const {
    return base + (depth & 1 ? peak_[0] : 0) + offset;
  }
  std::int64_t peak() const { return peak_[0] + peak_[1]; }

 private:
  std::int64_t top_[2] = {0, 0}, peak_[2] = {0, 0};
};

/// Hands out ranges of one stretch of memory, the lowest that fits.
class Arena {
 public:
  explicit Arena(std::int64_t end) : end_(end) {}

  std::int64_t take(std::int64_t size) {
    for (auto range = free_.begin(); range != free_.end(); ++range) {
      if (range->second - range->first < size) continue;
      const std::int64_t offset = range->first;
      const std::int64_t rest = offset + size, end = range->second;
      free_.erase(range);
      if (rest < end) free_[rest] = end;
      return offset;
    }
    // None: the end grows, from where the last range begins if that reaches it.
    std::int64_t offset = end_;
    if (!free_.empty() && free_.rbegin()->second == end_) {
      offset = free_.rbegin()->first;
      free_.erase(offset);
    }
    end_ = offset + size;
    return offset;
  }
  void give_back(std::int64_t begin, std::int64_t end) {
    if (begin >= end) return;
    auto next = free_.lower_bound(begin);
    if (next != free_.end() && next->first == end) {
      end = next->second;
      next = free_.erase(next);
    }
    if (next != free_.begin() && std::prev(next)->second == begin) {
      std::prev(next)->second = end;
    } else {
      free_[begin] = end;
    }
  }
  std::int64_t end() const { return end_; }

 private:
  std::int64_t end_;
  std::map<std::int64_t, std::int64_t> free_;  // begin -> end, never touching each other
};

class Scheduler {
 public:
  explicit Scheduler(CholeskySymbolic& symbolic) : sym_(symbolic) {}

  void run() {
    measure();
    cut();
    for (std::size_t t = 0; t < sym_.tasks.size(); ++t) place_task(static_cast<int>(t));
    place_top();
  }

 private:
  int count() const { return static_cast<int>(sym_.supernodes.size()); }

  void measure() {
    total_.assign(count(), 0);
    first_.resize(count());
    depth_.assign(count(), 0);
    for (int s = 0; s < count(); ++s) first_[s] = s;
    for (int s = 0; s < count(); ++s) {
      total_[s] += work(sym_.supernodes[s]);
      const int parent = sym_.supernodes[s].parent;
      if (parent < 0) {
        all_ += total_[s];
        continue;
      }
      total_[parent] += total_[s];
      first_[parent] = std::min(first_[parent], first_[s]);
    }
    for (int s = count() - 1; s >= 0; --s) {
      const int parent = sym_.supernodes[s].parent;
      if (parent >= 0) depth_[s] = depth_[parent] + 1;
    }
  }

  /// Largest subtrees that are small enough become tasks; tiny neighbors share one.
  void cut() {
    const double limit = all_ < kSerialWork ? all_ : all_ / kTasksWanted;
    std::vector<std::pair<double, CholeskyTask>> tasks;
    std::vector<int> height(count(), 0);
    for (int s = 0; s < count(); ++s) {
      const int parent = sym_.supernodes[s].parent;
      if (total_[s] <= limit) {
        if (parent >= 0 && total_[parent] <= limit) continue;  // inside a larger subtree
        if (tasks.empty() || tasks.back().first + total_[s] > limit) tasks.push_back({0.0, {}});
        tasks.back().first += total_[s];
        tasks.back().second.emplace_back(first_[s], s + 1);
        continue;
      }
      if (height[s] >= static_cast<int>(sym_.levels.size())) sym_.levels.resize(height[s] + 1);
      sym_.levels[height[s]].push_back(s);
      if (parent >= 0) height[parent] = std::max(height[parent], height[s] + 1);
    }
    std::stable_sort(tasks.begin(), tasks.end(),
                     [](const auto& a, const auto& b) { return a.first > b.first; });
    for (auto& task : tasks) sym_.tasks.push_back(std::move(task.second));
  }

  void place_task(int t) {
    ParityStacks fronts, messages;
    std::int64_t local = 0;
    for (const auto& [begin, end] : sym_.tasks[t]) {
      for (int s = begin; s < end; ++s) {
        CholeskySupernode& node = sym_.supernodes[s];
        node.task = t;
        node.update = fronts.push(depth_[s], triangle_size(node.update_tiles()));
        node.message = messages.push(depth_[s], node.update_tiles() * kTile);
        local = std::max(local, std::int64_t{node.num_tiles()} * kTile);
        for (std::int64_t i = node.children; i < node.children_end; ++i) {
          const CholeskySupernode& child = sym_.supernodes[sym_.children[i]];
          fronts.pop(depth_[s] + 1, triangle_size(child.update_tiles()));
          messages.pop(depth_[s] + 1, child.update_tiles() * kTile);
        }
      }
    }
    for (const auto& [begin, end] : sym_.tasks[t]) {
      for (int s = begin; s < end; ++s) {
        CholeskySupernode& node = sym_.supernodes[s];
        node.update = fronts.place(sym_.fronts_size, depth_[s], node.update);
        node.message = messages.place(sym_.workspace_size, depth_[s], node.message);
        node.scratch = sym_.workspace_size + messages.peak();
      }
    }
    sym_.fronts_size += fronts.peak();
    sym_.workspace_size += messages.peak() + local;
  }

  /// What of the tasks' memory holds no result for the top of the tree.
  Arena after_tasks() const {
    std::vector<std::pair<std::int64_t, std::int64_t>> results;
    for (const std::vector<int>& level : sym_.levels) {
      for (int s : level) {
        for (std::int64_t c = sym_.supernodes[s].children; c < sym_.supernodes[s].children_end;
             ++c) {
          const CholeskySupernode& child = sym_.supernodes[sym_.children[c]];
          if (child.task < 0) continue;
          results.emplace_back(child.update, child.update + triangle_size(child.update_tiles()));
        }
      }
    }
    std::sort(results.begin(), results.end());
    Arena arena(sym_.fronts_size);
    std::int64_t begin = 0;
    for (const auto& [first, last] : results) {
      arena.give_back(begin, first);
      begin = last;
    }
    arena.give_back(begin, sym_.fronts_size);
    return arena;
  }

  /// Supernodes of one level run side by side: none may use what another one reads or writes. A
  /// level's children are read by it alone.
  void place_top() {
    Arena arena = after_tasks();
    for (const std::vector<int>& level : sym_.levels) {
      for (int s : level) {
        CholeskySupernode& node = sym_.supernodes[s];
        node.update = arena.take(triangle_size(node.update_tiles()));
      }
      for (int s : level) {
        for (std::int64_t c = sym_.supernodes[s].children; c < sym_.supernodes[s].children_end;
             ++c) {
          const CholeskySupernode& child = sym_.supernodes[sym_.children[c]];
          arena.give_back(child.update, child.update + triangle_size(child.update_tiles()));
        }
      }
    }
    sym_.fronts_size = arena.end();
    for (const std::vector<int>& level : sym_.levels) {
      for (int s : level) {
        CholeskySupernode& node = sym_.supernodes[s];
        node.message = sym_.workspace_size;
        sym_.workspace_size += node.update_tiles() * kTile;
        node.scratch = sym_.workspace_size;
        sym_.workspace_size += std::int64_t{node.num_tiles()} * kTile;
      }
    }
  }

  CholeskySymbolic& sym_;
  std::vector<double> total_;  // work of the subtree
  std::vector<int> first_;     // first supernode of the subtree
  std::vector<int> depth_;
  double all_ = 0;
};

}  // namespace

void schedule_cholesky(CholeskySymbolic& symbolic) { Scheduler(symbolic).run(); }

}  // namespace diffsim
