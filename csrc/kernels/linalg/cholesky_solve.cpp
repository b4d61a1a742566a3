// CholeskyFactor::solve: forward and backward substitution along the elimination tree.
#include <algorithm>
#include <cstring>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/cholesky_symbolic.h"
#include "kernels/linalg/panel_kernels.h"

namespace diffsim {

/// One solve of NR right-hand sides; T is the type L is stored in.
template <typename T>
struct CholeskyFactor::Solver {
  const CholeskySymbolic& sym;
  const T* factor;
  const double* b;
  double* x;
  std::int64_t num_rhs;  // row length of b and x
  double* workspace;

  /// Forward: eliminates the supernode's unknowns from b and sends the rest to the parent.
  template <int NR>
  void forward(int s) const {
    const CholeskySupernode& node = sym.supernodes[s];
    const std::int64_t ld = std::int64_t{node.num_tiles()} * kTile;
    const std::int64_t own = std::int64_t{node.panels()} * kTile, below = ld - own;
    double* const w = workspace + node.scratch * NR;
    for (int r = 0; r < NR; ++r) {
      double* target = w + r * ld;
      for (int i = 0; i < node.num_cols; ++i) {
        target[i] = b[sym.unknown[node.first + i] * num_rhs + r];
      }
      std::memset(target + node.num_cols, 0, sizeof(double) * (ld - node.num_cols));
    }
    for (std::int64_t c = node.children; c < node.children_end; ++c) {
      const CholeskySupernode& child = sym.supernodes[sym.children[c]];
      const int* map = sym.row_in_parent.data() + child.rows;
      const std::int64_t length = std::int64_t{child.update_tiles()} * kTile;
      const double* message = workspace + child.message * NR;
      for (int i = 0; i < child.num_rows; ++i) {
        for (int r = 0; r < NR; ++r) w[r * ld + map[i]] += message[r * length + i];
      }
    }
    for (int p = 0; p < node.panels(); ++p) {
      panels::forward<NR>(factor + node.factor + node.panel(p), node.width(p),
                          node.num_tiles() - p, w + p * kTile, ld);
    }
    for (int r = 0; r < NR; ++r) {
      std::memcpy(workspace + node.own * NR + r * own, w + r * ld, sizeof(double) * own);
      std::memcpy(workspace + node.message * NR + r * below, w + r * ld + own,
                  sizeof(double) * below);
    }
  }

  /// Backward: the supernode's part of x, once all its ancestors' parts are known.
  template <int NR>
  void backward(int s) const {
    const CholeskySupernode& node = sym.supernodes[s];
    const std::int64_t ld = std::int64_t{node.num_tiles()} * kTile;
    const std::int64_t own = std::int64_t{node.panels()} * kTile;
    double* const w = workspace + node.scratch * NR;
    const int* rows = sym.row_unknown.data() + node.rows;
    for (int r = 0; r < NR; ++r) {
      std::memcpy(w + r * ld, workspace + node.own * NR + r * own, sizeof(double) * own);
      for (int i = node.num_rows; i < ld - own; ++i) w[r * ld + own + i] = 0;
    }
    for (int i = 0; i < node.num_rows; ++i) {
      for (int r = 0; r < NR; ++r) w[r * ld + own + i] = x[rows[i] * num_rhs + r];
    }
    for (int p = node.panels() - 1; p >= 0; --p) {
      panels::backward<NR>(factor + node.factor + node.panel(p), node.width(p),
                           node.num_tiles() - p, w + p * kTile, ld);
    }
    for (int i = 0; i < node.num_cols; ++i) {
      for (int r = 0; r < NR; ++r) x[sym.unknown[node.first + i] * num_rhs + r] = w[r * ld + i];
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
    std::int64_t left = num_rhs;
    const auto advance = [&](int count) {
      b += count;
      x += count;
      left -= count;
    };
    for (; left >= 6; advance(6)) run<6>(pool);
    for (; left >= 3; advance(3)) run<3>(pool);
    for (; left >= 1; advance(1)) run<1>(pool);
  }
};

void CholeskyFactor::solve(const double* b, double* x, int num_rhs, CholeskyWorkspace& ws,
                           ThreadPool& pool) const {
  if (!usable_) throw std::logic_error("CholeskyFactor::solve before a successful refactor");
  const std::int64_t together = std::min(num_rhs, 6);
  double* workspace = ws.reserve(symbolic_->workspace_size * together);
  if (precision_ == FactorPrecision::kFloat32) {
    Solver<float>{*symbolic_, factor32_.data(), b, x, num_rhs, workspace}.run_all(pool);
  } else {
    Solver<double>{*symbolic_, factor64_.data(), b, x, num_rhs, workspace}.run_all(pool);
  }
}

}  // namespace diffsim
