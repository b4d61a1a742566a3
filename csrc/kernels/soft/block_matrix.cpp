#include "kernels/soft/block_matrix.h"

#include "kernels/linalg/lanes.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;
constexpr Index kRowsPerTask = 128;

template <typename F>
void for_rows(const SoftModel& model, ThreadPool& pool, F&& f) {
  pool.run((model.num_nodes + kRowsPerTask - 1) / kRowsPerTask, [&](Index task) {
    const Index last = std::min(model.num_nodes, (task + 1) * kRowsPerTask);
    for (Index i = task * kRowsPerTask; i < last; ++i) f(i);
  });
}

/// Copies the 3-vectors of a row's columns side by side, padded with zeros to whole lanes.
void gather_columns(const SoftModel& model, Index row, const double* x, double* out) {
  const Index end = model.row_start[at(row + 1)];
  for (Index k = model.row_start[at(row)]; k < end; ++k, out += 3) {
    const double* from = x + 3 * model.column[at(k)];
    out[0] = from[0], out[1] = from[1], out[2] = from[2];
  }
  for (int i = 0; i < kLanes; ++i) out[i] = 0.0;
}

// How far ahead of its use a strip is asked for: past what the hardware's own streams, which end at
// pages of 4 KiB, have fetched by then. Strips follow one another in memory.
constexpr Index kAhead = 4096 / sizeof(double);

/// Three dot products of the rows of a strip with one gathered vector.
void strip_times(const double* strip, const double* gathered, Index width, double out[3]) {
  Lane total[3] = {};
  for (Index k = 0; k < width; k += kLanes) {
    const Lane v = load(gathered + k);
    for (int i = 0; i < 3; ++i) {
      __builtin_prefetch(strip + i * width + k + kAhead);
      total[i] += load(strip + i * width + k) * v;
    }
  }
  for (int i = 0; i < 3; ++i) out[i] = sum(total[i]);
}

}  // namespace

void block_multiply(const SoftModel& model, const double* values, const double* inertia,
                    const double* x, double* y, ThreadPool& pool) {
  const Index buffer = model.max_strip_width + kLanes;
  pool.run((model.num_nodes + kRowsPerTask - 1) / kRowsPerTask, [&](Index task) {
    std::vector<double> gathered(at(buffer));
    const Index last = std::min(model.num_nodes, (task + 1) * kRowsPerTask);
    for (Index i = task * kRowsPerTask; i < last; ++i) {
      double out[3];
      gather_columns(model, i, x, gathered.data());
      strip_times(values + model.strip_start[at(i)], gathered.data(), model.strip_width(i), out);
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
    const Index width = model.strip_width(row);
    const double* strip = values + model.strip_start[at(row)];
    for (Index k = begin; k < end; ++k) {
      const Index col = model.column[at(k)];
      double* block = blocks + 9 * k;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          const bool diagonal = row == col && i == j;
          if (fixed[3 * row + i] || fixed[3 * col + j])
            block[3 * i + j] = diagonal ? fixed_diagonal : 0.0;
          else
            block[3 * i + j] =
                strip[i * width + 3 * (k - begin) + j] + (diagonal ? inertia[row] : 0.0);
        }
    }
  });
}

}  // namespace diffsim
