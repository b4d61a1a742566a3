// CholeskyFactor::solve: forward and backward substitution along the elimination tree.
#include <algorithm>
#include <cstring>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/cholesky_symbolic.h"
#include "kernels/linalg/panel_kernels.h"

namespace diffsim {

namespace {

constexpr int kMaxGroups = 4;  // groups of three right-hand sides that one pass over L serves

/// Columns of L^-1 B at those supernodes where they are not zero.
template <typename T>
struct HalfSolved {
  std::vector<std::int64_t> column;  // which of B's they are
  std::vector<int> nodes;            // supernodes, children before their parents
  AlignedBuffer<T> values;           // (width, own unknowns with padding) of each of them

  /// Columns in threes, of which the last may be empty.
  int width() const { return static_cast<int>(column.size() + 2) / 3 * 3; }
};

/// products[r, c] += a_r' b_c for three columns each.
template <typename T>
inline void add_products(const T* a, const T* b, std::int64_t size, simd::Vec (&products)[3][3]) {
  for (std::int64_t i = 0; i < size; i += simd::kLanes) {
    simd::Vec x[3], y[3];
    for (int r = 0; r < 3; ++r) x[r] = simd::load(a + r * size + i);
    for (int c = 0; c < 3; ++c) y[c] = simd::load(b + c * size + i);
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) products[r][c] += x[r] * y[c];
  }
}

/// Entries of the inverse, (count, count), between the columns of two parts.
template <typename T>
void multiply_halves(const CholeskySymbolic& sym, const HalfSolved<T>& a, const HalfSolved<T>& b,
                     std::int64_t count, double* inverse) {
  simd::Vec products[kMaxGroups][kMaxGroups][3][3] = {};
  const T *left = a.values.data(), *right = b.values.data();
  std::size_t k = 0;
  for (const int s : a.nodes) {
    const std::int64_t size =
        std::int64_t{sym.supernodes[static_cast<std::size_t>(s)].panels()} * kTile;
    for (; k < b.nodes.size() && b.nodes[k] < s; ++k)
      right += std::int64_t{sym.supernodes[static_cast<std::size_t>(b.nodes[k])].panels()} * kTile *
               b.width();
    if (k < b.nodes.size() && b.nodes[k] == s)
      for (int r = 0; r < a.width() / 3; ++r)
        for (int c = 0; c < b.width() / 3; ++c)
          add_products(left + 3 * r * size, right + 3 * c * size, size, products[r][c]);
    left += size * a.width();
  }
  for (std::size_t r = 0; r < a.column.size(); ++r)
    for (std::size_t c = 0; c < b.column.size(); ++c) {
      const simd::Vec& lanes = products[r / 3][c / 3][r % 3][c % 3];
      double sum = 0.0;
      for (int i = 0; i < simd::kLanes; ++i) sum += lanes[i];
      inverse[a.column[r] * count + b.column[c]] = sum;
      inverse[b.column[c] * count + a.column[r]] = sum;
    }
}

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
  void run_forward(ThreadPool& pool) const {
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
  }

  template <int NR>
  void run(ThreadPool& pool) const {
    run_forward<NR>(pool);
    const std::int64_t num_tasks = static_cast<std::int64_t>(sym.tasks.size());
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

void CholeskyFactor::solve(const double* b, double* x, int num_rhs, CholeskyWorkspace& ws,
                           ThreadPool& pool) const {
  if (!usable_) throw std::logic_error("CholeskyFactor::solve before a successful refactor");
  const std::int64_t together = std::min(num_rhs, 3 * kMaxGroups);
  double* workspace = ws.reserve(symbolic_->workspace_size * together);
  const CholeskySymbolic& sym = *symbolic_;
  if (precision_ != FactorPrecision::kFloat64) {
    Solver<float>{sym, memory_.factor32.data(), b, x, num_rhs, workspace, nullptr, 1}.run_all(pool);
  } else {
    Solver<double>{sym, memory_.factor.data(), b, x, num_rhs, workspace, nullptr, 1}.run_all(pool);
  }
  for (int i : sym.absent) std::fill_n(x + std::int64_t{i} * num_rhs, num_rhs, 0.0);
}

template <typename T>
void CholeskyFactor::inverse_among_in(const T* factor, const std::int64_t* among,
                                      std::int64_t count, double* inverse, CholeskyWorkspace& ws,
                                      ThreadPool& pool) const {
  const CholeskySymbolic& sym = *symbolic_;
  std::vector<int> place(static_cast<std::size_t>(sym.num_nodes * sym.block), -1);
  for (std::size_t i = 0; i < sym.unknown.size(); ++i)
    place[static_cast<std::size_t>(sym.unknown[i])] = static_cast<int>(i);
  const auto place_of = [&](std::int64_t c) { return place[static_cast<std::size_t>(among[c])]; };
  // Neighbors in elimination order share most of their way to the root.
  std::vector<std::int64_t> order;
  for (std::int64_t c = 0; c < count; ++c)
    if (place_of(c) >= 0) order.push_back(c);
  std::sort(order.begin(), order.end(),
            [&](std::int64_t a, std::int64_t b) { return place_of(a) < place_of(b); });

  constexpr std::size_t kTogether = 3 * kMaxGroups;
  std::vector<HalfSolved<T>> parts((order.size() + kTogether - 1) / kTogether);
  double* workspace = ws.reserve(symbolic_->workspace_size * kTogether);
  std::vector<double> b(place.size() * kTogether, 0.0);
  std::vector<std::uint8_t> used(sym.supernodes.size());
  for (std::size_t g = 0; g < parts.size(); ++g) {
    HalfSolved<T>& part = parts[g];
    const std::size_t first = g * kTogether, end = std::min(first + kTogether, order.size());
    part.column.assign(order.begin() + first, order.begin() + end);
    const int width = part.width();
    std::fill(used.begin(), used.end(), std::uint8_t{0});
    const auto set = [&](double value) {
      for (std::size_t c = 0; c < part.column.size(); ++c)
        b[static_cast<std::size_t>(among[part.column[c]] * width) + c] = value;
    };
    set(1.0);
    for (const std::int64_t c : part.column) {
      const auto after =
          std::upper_bound(sym.supernodes.begin(), sym.supernodes.end(), place_of(c),
                           [](int at, const CholeskySupernode& node) { return at < node.first; });
      used[static_cast<std::size_t>(after - sym.supernodes.begin() - 1)] = 1;
    }
    for (std::size_t s = 0; s < used.size(); ++s) {  // children come before their parents
      if (!used[s]) continue;
      part.nodes.push_back(static_cast<int>(s));
      if (sym.supernodes[s].parent >= 0)
        used[static_cast<std::size_t>(sym.supernodes[s].parent)] = 1;
    }
    const Solver<T> solver{sym,   factor,    b.data(),    nullptr,
                           width, workspace, used.data(), width / 3};
    solver.template run_forward<3>(pool);
    std::int64_t rows = 0;
    for (const int s : part.nodes)
      rows += sym.supernodes[static_cast<std::size_t>(s)].panels() * kTile;
    T* values = part.values.resize(static_cast<std::size_t>(rows * width));
    for (const int s : part.nodes) {
      const CholeskySupernode& node = sym.supernodes[static_cast<std::size_t>(s)];
      const double* own = workspace + node.own * width;
      for (std::int64_t i = 0; i < std::int64_t{node.panels()} * kTile * width; ++i)
        *values++ = static_cast<T>(own[i]);
    }
    set(0.0);
  }

  std::fill_n(inverse, count * count, 0.0);
  const std::int64_t num = static_cast<std::int64_t>(parts.size());
  pool.run(num, [&](std::int64_t g) {
    for (std::int64_t h = 0; h <= g; ++h)
      multiply_halves(sym, parts[static_cast<std::size_t>(g)], parts[static_cast<std::size_t>(h)],
                      count, inverse);
  });
}

void CholeskyFactor::inverse_among(const std::int64_t* among, std::int64_t count, double* inverse,
                                   CholeskyWorkspace& ws, ThreadPool& pool) const {
  if (!usable_) throw std::logic_error("CholeskyFactor::inverse_among before a refactor");
  if (precision_ != FactorPrecision::kFloat64)
    inverse_among_in(memory_.factor32.data(), among, count, inverse, ws, pool);
  else
    inverse_among_in(memory_.factor.data(), among, count, inverse, ws, pool);
}

}  // namespace diffsim
