// CholeskyFactor::solve: forward and backward substitution along the elimination tree.
#include <algorithm>
#include <cstring>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/cholesky_symbolic.h"
#include "kernels/linalg/panel_kernels.h"

namespace diffsim {

namespace {

constexpr int kMaxGroups = 4;  // groups of three right-hand sides that one pass over L serves

}  // namespace

/// One pass over L for `groups` groups of NR right-hand sides; T is the type L is stored in. The
/// groups take turns on each panel of L while it is in cache, so a column's result does not depend
/// on how many there are.
template <typename T>
struct CholeskyFactor::Solver {
  const CholeskySymbolic& sym;
  const T* factor;
  const double* b;
  double* x;
  std::int64_t num_rhs;  // row length of b and x
  double* workspace;
  const std::uint8_t* used;  // nonzero where a supernode takes part, or nullptr
  int groups;

  bool takes_part(int s) const { return !used || used[s]; }

  /// Forward: eliminates the supernode's unknowns from b and sends the rest to the parent.
  template <int NR>
  void forward(int s) const {
    if (!takes_part(s)) return;
    const CholeskySupernode& node = sym.supernodes[s];
    const int columns = NR * groups;
    const std::int64_t ld = std::int64_t{node.num_tiles()} * kTile;
    const std::int64_t own = std::int64_t{node.panels()} * kTile, below = ld - own;
    double* const w = workspace + node.scratch * columns;
    for (int g = 0; g < columns; g += NR) {
      double* const target = w + g * ld;
      for (int i = 0; i < node.num_cols; ++i) {
        const double* source = b + sym.unknown[node.first + i] * num_rhs + g;
        for (int r = 0; r < NR; ++r) target[r * ld + i] = source[r];
      }
      for (int r = 0; r < NR; ++r) {
        std::memset(target + r * ld + node.num_cols, 0, sizeof(double) * (ld - node.num_cols));
      }
    }
    for (std::int64_t c = node.children; c < node.children_end; ++c) {
      if (!takes_part(sym.children[c])) continue;
      const CholeskySupernode& child = sym.supernodes[sym.children[c]];
      const int* map = sym.row_in_parent.data() + child.rows;
      const std::int64_t length = std::int64_t{child.update_tiles()} * kTile;
      for (int g = 0; g < columns; g += NR) {
        const double* message = workspace + child.message * columns + g * length;
        double* const target = w + g * ld;
        for (int i = 0; i < child.num_rows; ++i) {
          for (int r = 0; r < NR; ++r) target[r * ld + map[i]] += message[r * length + i];
        }
      }
    }
    for (int p = 0; p < node.panels(); ++p) {
      const T* panel = factor + node.factor + node.panel(p);
      for (int g = 0; g < columns; g += NR) {
        panels::forward<NR>(panel, node.width(p), node.num_tiles() - p, w + g * ld + p * kTile, ld);
      }
    }
    for (int r = 0; r < columns; ++r) {
      std::memcpy(workspace + node.own * columns + r * own, w + r * ld, sizeof(double) * own);
      std::memcpy(workspace + node.message * columns + r * below, w + r * ld + own,
                  sizeof(double) * below);
    }
  }

  /// Backward: the supernode's part of x, once all its ancestors' parts are known.
  template <int NR>
  void backward(int s) const {
    if (!takes_part(s)) return;
    const CholeskySupernode& node = sym.supernodes[s];
    const int columns = NR * groups;
    const std::int64_t ld = std::int64_t{node.num_tiles()} * kTile;
    const std::int64_t own = std::int64_t{node.panels()} * kTile;
    double* const w = workspace + node.scratch * columns;
    const int* rows = sym.row_unknown.data() + node.rows;
    for (int r = 0; r < columns; ++r) {
      std::memcpy(w + r * ld, workspace + node.own * columns + r * own, sizeof(double) * own);
      for (std::int64_t i = own + node.num_rows; i < ld; ++i) w[r * ld + i] = 0;
    }
    for (int g = 0; g < columns; g += NR) {
      double* const target = w + g * ld + own;
      for (int i = 0; i < node.num_rows; ++i) {
        const double* source = x + rows[i] * num_rhs + g;
        for (int r = 0; r < NR; ++r) target[r * ld + i] = source[r];
      }
    }
    for (int p = node.panels() - 1; p >= 0; --p) {
      const T* panel = factor + node.factor + node.panel(p);
      for (int g = 0; g < columns; g += NR) {
        panels::backward<NR>(panel, node.width(p), node.num_tiles() - p, w + g * ld + p * kTile,
                             ld);
      }
    }
    for (int g = 0; g < columns; g += NR) {
      const double* source = w + g * ld;
      for (int i = 0; i < node.num_cols; ++i) {
        double* target = x + sym.unknown[node.first + i] * num_rhs + g;
        for (int r = 0; r < NR; ++r) target[r] = source[r * ld + i];
      }
    }
  }

  template <int NR>
  void run(ThreadPool& pool) const {
    const std::int64_t num_tasks = static_cast<std::int64_t>(sym.tasks.size());
    pool.run(num_tasks, [&](std::int64_t t) {
      for (const auto& [begin, end] : sym.tasks[t]) {
        for (int s = begin; s < end; ++s) forward<NR>(s);
      }
    });
    for (const std::vector<int>& level : sym.levels) {
      pool.run(static_cast<std::int64_t>(level.size()),
               [&](std::int64_t i) { forward<NR>(level[i]); });
    }
    for (auto level = sym.levels.rbegin(); level != sym.levels.rend(); ++level) {
      pool.run(static_cast<std::int64_t>(level->size()),
               [&](std::int64_t i) { backward<NR>((*level)[i]); });
    }
    pool.run(num_tasks, [&](std::int64_t t) {
      const CholeskyTask& task = sym.tasks[t];
      for (auto range = task.rbegin(); range != task.rend(); ++range) {
        for (int s = range->second - 1; s >= range->first; --s) backward<NR>(s);
      }
    });
  }

  void run_all(ThreadPool& pool) {
    for (std::int64_t left = num_rhs; left > 0;) {
      const int size = static_cast<int>(std::min<std::int64_t>(left, 3));
      groups = static_cast<int>(std::clamp<std::int64_t>(left / 3, 1, kMaxGroups));
      if (size == 3) {
        run<3>(pool);
      } else if (size == 2) {
        run<2>(pool);
      } else {
        run<1>(pool);
      }
      b += size * groups;
      x += size * groups;
      left -= size * groups;
    }
  }
};

void CholeskyFactor::solve_with(const std::uint8_t* used, const double* b, double* x, int num_rhs,
                                CholeskyWorkspace& ws, ThreadPool& pool) const {
  if (!usable_) throw std::logic_error("CholeskyFactor::solve before a successful refactor");
  const std::int64_t together = std::min(num_rhs, 3 * kMaxGroups);
  double* workspace = ws.reserve(symbolic_->workspace_size * together);
  const CholeskySymbolic& sym = *symbolic_;
  if (precision_ == FactorPrecision::kFloat32) {
    Solver<float>{sym, memory_.factor32.data(), b, x, num_rhs, workspace, used, 1}.run_all(pool);
  } else {
    Solver<double>{sym, memory_.factor.data(), b, x, num_rhs, workspace, used, 1}.run_all(pool);
  }
  for (int i : sym.absent) std::fill_n(x + std::int64_t{i} * num_rhs, num_rhs, 0.0);
}

void CholeskyFactor::solve(const double* b, double* x, int num_rhs, CholeskyWorkspace& ws,
                           ThreadPool& pool) const {
  solve_with(nullptr, b, x, num_rhs, ws, pool);
}

void CholeskyFactor::solve_among(const std::int64_t* among, std::int64_t count, const double* b,
                                 double* x, int num_rhs, CholeskyWorkspace& ws,
                                 ThreadPool& pool) const {
  const CholeskySymbolic& sym = *symbolic_;
  std::vector<std::uint8_t> is_among(static_cast<std::size_t>(sym.num_unknowns), 0);
  for (std::int64_t i = 0; i < count; ++i) is_among[static_cast<std::size_t>(among[i])] = 1;
  std::vector<std::uint8_t> used(sym.supernodes.size(), 0);
  // Children come before their parents.
  for (std::size_t s = 0; s < used.size(); ++s) {
    const CholeskySupernode& node = sym.supernodes[s];
    for (int i = node.first; i < node.first + node.num_cols && !used[s]; ++i)
      used[s] = is_among[static_cast<std::size_t>(sym.unknown[static_cast<std::size_t>(i)])];
    if (used[s] && node.parent >= 0) used[static_cast<std::size_t>(node.parent)] = 1;
  }
  solve_with(used.data(), b, x, num_rhs, ws, pool);
}

}  // namespace diffsim
