#include "kernels/soft/block_matrix.h"

#include "kernels/linalg/lanes.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
std::size_t at(Index i) { return static_cast<std::size_t>(i); }
constexpr Index kRowsPerTask = 128;

template <typename F>
void for_rows(const SoftModel& model, ThreadPool& pool, F&& f) {
  pool.run((model.num_nodes + kRowsPerTask - 1) / kRowsPerTask, [&](Index task) {
    const Index last = std::min(model.num_nodes, (task + 1) * kRowsPerTask);
    for (Index i = task * kRowsPerTask; i < last; ++i) f(i);
  });
}

/// Three dot products of length n with one gathered vector; buffers are padded to whole lanes.
void strip_times(const double* strip, const double* gathered, Index n, double out[3]) {
  Lane total[3] = {};
  Index k = 0;
  for (; k + kLanes <= n; k += kLanes) {
    const Lane v = load(gathered + k);
    for (int i = 0; i < 3; ++i) total[i] += load(strip + i * n + k) * v;
  }
  for (int i = 0; i < 3; ++i) {
    out[i] = sum(total[i]);
    for (Index j = k; j < n; ++j) out[i] += strip[i * n + j] * gathered[j];
  }
}

}  // namespace

void block_multiply(const SoftModel& model, const double* values, const double* inertia,
                    const double* x, double* y, ThreadPool& pool) {
  pool.run((model.num_nodes + kRowsPerTask - 1) / kRowsPerTask, [&](Index task) {
    std::vector<double> gathered;
    const Index last = std::min(model.num_nodes, (task + 1) * kRowsPerTask);
    for (Index i = task * kRowsPerTask; i < last; ++i) {
      const Index begin = model.row_start[at(i)], end = model.row_start[at(i + 1)];
      const Index n = 3 * (end - begin);
      if (static_cast<Index>(gathered.size()) < n) gathered.resize(at(2 * n));
      double* v = gathered.data();
      for (Index k = begin; k < end; ++k, v += 3) {
        const double* from = x + 3 * model.column[at(k)];
        v[0] = from[0], v[1] = from[1], v[2] = from[2];
      }
      double out[3];
      strip_times(values + 9 * begin, gathered.data(), n, out);
      for (int axis = 0; axis < 3; ++axis)
        y[3 * i + axis] = out[axis] + inertia[i] * x[3 * i + axis];
    }
  });
}

void export_blocks(const SoftModel& model, const double* values, const double* inertia,
                   const std::uint8_t* fixed, double fixed_diagonal, double* blocks,
                   ThreadPool& pool) {
  for_rows(model, pool, [&](Index row) {
    const Index begin = model.row_start[at(row)], end = model.row_start[at(row + 1)];
    const Index width = 3 * (end - begin);
    for (Index k = begin; k < end; ++k) {
      const Index col = model.column[at(k)];
      double* block = blocks + 9 * k;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          const bool diagonal = row == col && i == j;
          if (fixed[3 * row + i] || fixed[3 * col + j])
            block[3 * i + j] = diagonal ? fixed_diagonal : 0.0;
          else
            block[3 * i + j] = values[9 * begin + i * width + 3 * (k - begin) + j] +
                               (diagonal ? inertia[row] : 0.0);
        }
    }
  });
}

}  // namespace diffsim
