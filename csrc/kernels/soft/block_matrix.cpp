#include "kernels/soft/block_matrix.h"

#include "kernels/linalg/block3.h"
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

}  // namespace

void block_multiply(const SoftModel& model, const double* values, const double* inertia,
                    const double* x, double* y, ThreadPool& pool, const std::uint8_t* wanted) {
  for_rows(model, pool, [&](Index i) {
    if (wanted && !(wanted[3 * i] | wanted[3 * i + 1] | wanted[3 * i + 2])) return;
    double out[3];
    block3_row(values, model.column.data(), model.row_start[at(i)], model.row_start[at(i + 1)], x,
               out);
    for (int axis = 0; axis < 3; ++axis) y[3 * i + axis] = out[axis] + inertia[i] * x[3 * i + axis];
  });
}

void export_blocks(const SoftModel& model, const double* values, const double* inertia,
                   const std::uint8_t* fixed, double fixed_diagonal, double* blocks,
                   ThreadPool& pool) {
  for_rows(model, pool, [&](Index row) {
    const Index begin = model.row_start[at(row)], end = model.row_start[at(row + 1)];
    for (Index k = begin; k < end; ++k) {
      const Index col = model.column[at(k)];
      const double* from = values + kBlock3 * k;
      double* block = blocks + 9 * k;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
          const bool diagonal = row == col && i == j;
          if (fixed[3 * row + i] || fixed[3 * col + j])
            block[3 * i + j] = diagonal ? fixed_diagonal : 0.0;
          else
            block[3 * i + j] = from[block3_place(i, j)] + (diagonal ? inertia[row] : 0.0);
        }
    }
  });
}

}  // namespace diffsim
