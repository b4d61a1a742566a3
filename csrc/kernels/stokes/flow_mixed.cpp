#include "kernels/stokes/flow_mixed.h"

#include <Eigen/LU>
#include <algorithm>
#include <cstring>

#include "kernels/stokes/flexible_gmres.h"

namespace diffsim {
namespace {

std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

// Weight gamma of C' M^-1 C, and its largest share of the bulk modulus, which keeps bulk - gamma
// positive.
constexpr double kGamma = 10.0, kLargestGamma = 0.5;
constexpr std::int64_t kChunk = 256;  // rows of a task
// Added to Q' L Q, of its diagonal.
constexpr double kRegular = 1e-6;

template <typename F>
void for_chunks(std::int64_t n, ThreadPool& pool, F&& f) {
  pool.run((n + kChunk - 1) / kChunk, [&](std::int64_t task) {
    for (std::int64_t i = task * kChunk; i < std::min(n, (task + 1) * kChunk); ++i) f(i);
  });
}

}  // namespace

template <int D>
FlowMixed<D>::FlowMixed(const FlowOperator<D>& op, const ClosedRegions<D>& closed,
                        const FlowMatrix<D>& matrix, const std::uint8_t* fixed, ThreadPool& pool)
    : op_(op), closed_(closed), gamma_(std::min(kGamma, kLargestGamma * op.options().bulk)) {
  const FlowGeometry<D>& geometry = op.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  velocity_scale_ = grid.h_min * grid.h_min / grid.cell_volume;
  divergence_scale_ = grid.h_min / grid.cell_volume;
  matrix_.indptr = matrix.indptr();
  {
    const std::vector<std::int64_t> columns = matrix.columns();
    matrix_.columns.assign(columns.begin(), columns.end());
  }
  matrix_.values = matrix.assemble(fixed, gamma_, pool);
  for (double& value : matrix_.values) value *= velocity_scale_;
  matrix_.values.push_back(0.0);  // rows of blocks are read four numbers at a time
  const std::vector<std::int64_t>& nodes = geometry.active_nodes();
  num_velocities_ = static_cast<std::int64_t>(nodes.size()) * D;
  NodePositions<D> positions(nodes.size());
  fixed_.resize(nodes.size() * D);
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    std::int64_t at[D];
    grid.node_position(nodes[i], at);
    for (std::size_t a = 0; a < D; ++a) {
      positions[i][a] = static_cast<std::int32_t>(at[a]);
      fixed_[i * D + a] = fixed[nodes[i] * D + static_cast<std::int64_t>(a)];
    }
  }
  set_divergence();
  set_diagonals(pool);
  set_patterns(pool);
  multigrid_ = std::make_unique<FlowMultigrid<D>>(matrix_, positions, fixed_, 1.0, pool);
}

template <int D>
void FlowMixed<D>::set_divergence() {
  const FlowGeometry<D>& geometry = op_.geometry();
  const StokesGrid<D>& grid = geometry.grid();
  const FlowOptions& options = op_.options();
  number_.assign(u(grid.num_cells), -1);
  typename CellForm<D>::Corner c;
  const auto scaled = [&](const CellWeights& weights, double* out) {
    op_.form().divergence(weights, c);
    for (int i = 0; i < kCorners * D; ++i) out[i] = divergence_scale_ * (&c[0][0])[i];
  };
  scaled({op_.form().basis().weight, nullptr, nullptr}, full_);
  for (std::int64_t cell = 0; cell < grid.num_cells; ++cell) {
    if (!geometry.active(cell)) continue;
    number_[u(cell)] = static_cast<std::int32_t>(cells_.size());
    cells_.push_back(cell);
    const std::int64_t node = geometry.first_node(cell);
    for (std::int64_t offset : grid.corner_offset)
      cell_nodes_.push_back(static_cast<std::int32_t>(geometry.unknown_node(node + offset)));
    cut_index_.push_back(-1);
    if (geometry.cut(cell)) {
      cut_index_.back() = static_cast<std::int32_t>(cut_.size() / (kCorners * D));
      cut_.resize(cut_.size() + kCorners * D);
      scaled(op_.weights(cell), cut_.data() + cut_.size() - kCorners * D);
    }
    const double M = op_.pressure_volume(cell) / grid.cell_volume;
    bool rigid = true;  // all velocities prescribed: no equation, and a pressure of zero
    for (int i = 0; i < kCorners * D; ++i)
      rigid = rigid && fixed_[u(std::int64_t{cell_nodes_[cell_nodes_.size() - kCorners +
                                                         static_cast<std::size_t>(i / D)]} *
                                    D +
                                i % D)];
    mass_.push_back(M);
    shift_.push_back(strict() && !rigid ? 0.0 : M / (options.bulk - gamma_));
  }
}

template <int D>
void FlowMixed<D>::set_diagonals(ThreadPool& pool) {
  const std::int64_t n = num_velocities_ / D;
  inverse_diagonal_.assign(u(n * D * D), 0.0);
  for_chunks(n, pool, [&](std::int64_t i) {
    for (std::int64_t k = matrix_.indptr[u(i)]; k < matrix_.indptr[u(i) + 1]; ++k)
      if (matrix_.columns[u(k)] == i)
        std::copy_n(matrix_.values.data() + k * D * D, D * D, inverse_diagonal_.data() + i * D * D);
  });
  for (std::int64_t cell = 0; cell < static_cast<std::int64_t>(cells_.size()); ++cell) {
    const double* c = divergence(cell);
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t node = cell_nodes_[u(cell * kCorners + i)];
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b)
          if (!fixed_[u(node * D + a)] && !fixed_[u(node * D + b)])
            inverse_diagonal_[u((node * D + a) * D + b)] -=
                gamma_ / mass_[u(cell)] * c[i * D + a] * c[i * D + b];
    }
  }
  for_chunks(n, pool, [&](std::int64_t i) {
    Eigen::Map<Eigen::Matrix<double, D, D, Eigen::RowMajor>> block(inverse_diagonal_.data() +
                                                                   i * D * D);
    block = block.inverse().eval();
    for (int a = 0; a < D; ++a)
      if (fixed_[u(i * D + a)]) {
        block.row(a).setZero();
        block.col(a).setZero();
      }
  });
  weight_.resize(cells_.size());
  for_chunks(static_cast<std::int64_t>(cells_.size()), pool, [&](std::int64_t cell) {
    const double* c = divergence(cell);
    double sum = mass_[u(cell)] / op_.options().bulk;
    for (int i = 0; i < kCorners; ++i) {
      const double* inverse =
          inverse_diagonal_.data() + std::int64_t{cell_nodes_[u(cell * kCorners + i)]} * D * D;
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b) sum += c[i * D + a] * inverse[a * D + b] * c[i * D + b];
    }
    weight_[u(cell)] = (1.0 + gamma_) / mass_[u(cell)] + 1.0 / sum;
  });
}

/// Patterns alternate along axes 0 and 1; 0 and 2; 1 and 2; all. Bit a of kAxes stands for axis a.
template <int D>
double FlowMixed<D>::sign(std::int64_t cell, int pattern) const {
  constexpr int kAxes[4] = {0b011, 0b101, 0b110, 0b111};
  std::int64_t at[D], sum = 0;
  op_.geometry().grid().cell_position(cells_[u(cell)], at);
  for (int a = 0; a < D; ++a)
    if ((kAxes[pattern] >> a) & 1) sum += at[a];
  return sum % 2 ? -1.0 : 1.0;
}

template <int D>
void FlowMixed<D>::set_patterns(ThreadPool& pool) {
  const StokesGrid<D>& grid = op_.geometry().grid();
  const std::int64_t num_cells = static_cast<std::int64_t>(cells_.size());
  std::int64_t stride[D], total = 1;
  for (int a = D - 1; a >= 0; --a) {
    stride[a] = total;
    total *= (grid.cells[a] + 1) / 2;
  }
  std::vector<std::int32_t> number(u(total), -1);
  std::vector<std::int64_t> place(u(num_cells)), macros;
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    std::int64_t at[D];
    grid.cell_position(cells_[u(cell)], at);
    for (int a = 0; a < D; ++a) place[u(cell)] += at[a] / 2 * stride[a];
    number[u(place[u(cell)])] = 0;
  }
  std::vector<double> coords;
  for (std::int64_t m = 0; m < total; ++m) {
    if (number[u(m)] < 0) continue;
    number[u(m)] = static_cast<std::int32_t>(macros.size());
    macros.push_back(m);
    double at[3] = {};
    for (int a = 0; a < D; ++a)
      at[a] = static_cast<double>(m / stride[a] % ((grid.cells[a] + 1) / 2));
    coords.insert(coords.end(), at, at + 3);
  }
  const std::int64_t n = static_cast<std::int64_t>(macros.size());
  macro_.resize(u(num_cells));
  for (std::int64_t cell = 0; cell < num_cells; ++cell) macro_[u(cell)] = number[u(place[u(cell)])];

  // Cells about a node, by node; through it they couple.
  const std::int64_t num_nodes = num_velocities_ / D;
  std::vector<std::int32_t> about(u(num_nodes * kCorners), -1);
  for (std::int64_t cell = 0; cell < num_cells; ++cell)
    for (int i = 0; i < kCorners; ++i)
      about[u(std::int64_t{cell_nodes_[u(cell * kCorners + i)]} * kCorners + i)] =
          static_cast<std::int32_t>(cell);
  constexpr int kSlots = pow3(D), kBlock = kPatterns * kPatterns;  // neighbors, and itself
  std::vector<double> rows(u(n * kSlots * kBlock), 0.0);
  std::vector<std::int32_t> column(u(n * kSlots), -1);
  const auto slot_of = [&](std::int64_t from, std::int64_t to) {
    int slot = 0;
    for (int a = 0; a < D; ++a)
      slot = 3 * slot + static_cast<int>(coords[u(3 * to + a)] - coords[u(3 * from + a)]) + 1;
    return slot;
  };
  for (std::int64_t node = 0; node < num_nodes; ++node) {
    std::int32_t of[kCorners];
    double by[kCorners][kPatterns][D] = {}, solved[kCorners][kPatterns][D] = {};
    int count = 0;
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t cell = about[u(node * kCorners + i)];
      if (cell < 0) continue;
      int m = 0;
      while (m < count && of[m] != macro_[u(cell)]) ++m;
      if (m == count) of[count++] = macro_[u(cell)];
      for (int s = 0; s < kPatterns; ++s)
        for (int a = 0; a < D; ++a) by[m][s][a] += sign(cell, s) * divergence(cell)[i * D + a];
    }
    const double* inverse = inverse_diagonal_.data() + node * D * D;
    for (int m = 0; m < count; ++m)
      for (int s = 0; s < kPatterns; ++s)
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b) solved[m][s][a] += inverse[a * D + b] * by[m][s][b];
    for (int m = 0; m < count; ++m)
      for (int k = 0; k < count; ++k) {
        const std::int64_t at = std::int64_t{of[m]} * kSlots + slot_of(of[m], of[k]);
        column[u(at)] = of[k];
        for (int s = 0; s < kPatterns; ++s)
          for (int t = 0; t < kPatterns; ++t)
            for (int a = 0; a < D; ++a)
              rows[u(at * kBlock + s * kPatterns + t)] += by[m][s][a] * solved[k][t][a];
      }
  }
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    const std::int64_t at = std::int64_t{macro_[u(cell)]} * kSlots + kSlots / 2;
    column[u(at)] = macro_[u(cell)];
    for (int s = 0; s < kPatterns; ++s)
      for (int t = 0; t < kPatterns; ++t)
        rows[u(at * kBlock + s * kPatterns + t)] +=
            sign(cell, s) * sign(cell, t) * mass_[u(cell)] / op_.options().bulk;
  }
  std::vector<std::int64_t> indptr(1, 0), indices;
  std::vector<double> values;
  // Where less than 2^D cells of a block are fluid, patterns coincide: Q has no full rank, and only
  // Q times the solution counts. kRegular makes Q' L Q definite.
  for (std::int64_t m = 0; m < n; ++m) {
    for (int slot = 0; slot < kSlots; ++slot) {
      const std::int64_t at = m * kSlots + slot;
      if (column[u(at)] < 0) continue;
      indices.push_back(column[u(at)]);
      double* block = rows.data() + at * kBlock;
      if (slot == kSlots / 2)
        for (int s = 0; s < kPatterns; ++s) block[s * kPatterns + s] *= 1.0 + kRegular;
      values.insert(values.end(), block, block + kBlock);
    }
    indptr.push_back(static_cast<std::int64_t>(indices.size()));
  }
  patterns_ = std::make_unique<CholeskyFactor>(
      analyze_cholesky(n, indptr.data(), indices.data(), coords.data(), kPatterns),
      FactorPrecision::kFloat32);
  patterns_->refactor(values.data(), pool);
  patterns_->release_refactor_memory();
  amplitude_.resize(u(n * kPatterns));
}

template <int D>
void FlowMixed<D>::add_gradient(double scale, const double* p, double* y, ThreadPool& pool) const {
  run_colors(op_.geometry().cell_colors(), pool, [&](std::int64_t grid_cell) {
    const std::int64_t cell = number_[u(grid_cell)];
    const double* c = divergence(cell);
    const double value = scale * p[cell];
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t node = cell_nodes_[u(cell * kCorners + i)];
      for (int a = 0; a < D; ++a)
        if (!fixed_[u(node * D + a)]) y[node * D + a] += value * c[i * D + a];
    }
  });
}

template <int D>
void FlowMixed<D>::take_divergence(const double* v, double* q, ThreadPool& pool) const {
  for_chunks(static_cast<std::int64_t>(cells_.size()), pool, [&](std::int64_t cell) {
    const double* c = divergence(cell);
    double sum = 0.0;
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t node = cell_nodes_[u(cell * kCorners + i)];
      for (int a = 0; a < D; ++a) sum += c[i * D + a] * v[node * D + a];
    }
    q[cell] = sum;
  });
}

template <int D>
typename ClosedRegions<D>::Sums FlowMixed<D>::closed_sums(const double* p) const {
  typename ClosedRegions<D>::Sums sum = closed_.sums(
      [&](const auto& c) { return strict() ? c.volume * p[number_[u(c.cell)]] : 0.0; });
  for (std::size_t i = 0; i < sum.size(); ++i) {
    const double W = closed_.weight(static_cast<std::int64_t>(i));
    if (W > 0.0) sum[i] /= (op_.options().bulk - gamma_) * W;
  }
  return sum;
}

/// One row of a matrix of blocks times x, of which an entry more than the last is read.
template <int D>
void block_row(const double* A, const std::int32_t* columns, std::int64_t count, const double* x,
               double* s) {
  if constexpr (D == 3) {
    using Four = double __attribute__((vector_size(32)));
    Four sum[3] = {};  // by row: three chains that do not wait for each other
    for (std::int64_t k = 0; k < count; ++k, A += 9) {
      Four v, row[3];
      std::memcpy(&v, x + std::int64_t{columns[k]} * 3, sizeof v);
      for (int a = 0; a < 3; ++a) std::memcpy(&row[a], A + 3 * a, sizeof row[a]);
      for (int a = 0; a < 3; ++a) sum[a] += row[a] * v;
    }
    for (int a = 0; a < 3; ++a) s[a] = sum[a][0] + sum[a][1] + sum[a][2];
  } else {
    double sum[D][D] = {};
    for (std::int64_t k = 0; k < count; ++k, A += D * D)
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b) sum[a][b] += A[a * D + b] * x[std::int64_t{columns[k]} * D + b];
    for (int a = 0; a < D; ++a) {
      s[a] = 0.0;
      for (int b = 0; b < D; ++b) s[a] += sum[a][b];
    }
  }
}

template <int D>
void FlowMixed<D>::apply(const Vector& x, Vector& y, ThreadPool& pool) const {
  const double* p = x.data() + num_velocities_;
  for_chunks(matrix_.num_nodes(), pool, [&](std::int64_t i) {
    const std::int64_t first = matrix_.indptr[u(i)];
    double s[D];
    block_row<D>(matrix_.values.data() + first * D * D, matrix_.columns.data() + first,
                 matrix_.indptr[u(i) + 1] - first, x.data(), s);
    for (int a = 0; a < D; ++a) y[u(i * D + a)] = s[a];
  });
  add_gradient(-1.0, p, y.data(), pool);
  double* q = y.data() + num_velocities_;
  take_divergence(x.data(), q, pool);
  for (std::size_t cell = 0; cell < cells_.size(); ++cell) q[cell] += shift_[cell] * p[cell];
  if (!strict()) return;
  const auto sum = closed_sums(p);
  const double cell_volume = op_.geometry().grid().cell_volume;
  for (const auto& c : closed_.cells())
    q[number_[u(c.cell)]] += c.volume / cell_volume * sum[u(c.region)];
}

template <int D>
void FlowMixed<D>::precondition(const Vector& r, Vector& z, ThreadPool& pool) {
  const double* g = r.data() + num_velocities_;
  double* p = z.data() + num_velocities_;
  const std::int64_t num_cells = static_cast<std::int64_t>(cells_.size());
  std::fill(amplitude_.begin(), amplitude_.end(), 0.0);
  for (std::int64_t cell = 0; cell < num_cells; ++cell)
    for (int s = 0; s < kPatterns; ++s)
      amplitude_[u(std::int64_t{macro_[u(cell)]} * kPatterns + s)] += sign(cell, s) * g[cell];
  patterns_->solve(amplitude_.data(), amplitude_.data(), 1, workspace_, pool);
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    p[cell] = weight_[u(cell)] * g[cell];
    for (int s = 0; s < kPatterns; ++s)
      p[cell] += sign(cell, s) * amplitude_[u(std::int64_t{macro_[u(cell)]} * kPatterns + s)];
  }
  std::copy_n(r.begin(), num_velocities_, scratch_.begin());
  add_gradient(1.0, p, scratch_.data(), pool);
  multigrid_->apply(scratch_.data(), z.data(), pool);
}

template <int D>
KrylovResult FlowMixed<D>::solve(const double* f, const double* g, double* v, double* p,
                                 double rtol, int max_iters, ThreadPool& pool) {
  const std::vector<std::int64_t>& nodes = op_.geometry().active_nodes();
  const std::size_t num_velocities = u(num_velocities_), num_cells = cells_.size();
  Vector b(num_velocities + num_cells), x;
  scratch_.resize(num_velocities);
  for (std::size_t i = 0; i < num_velocities; ++i)
    b[i] =
        fixed_[i] ? 0.0 : velocity_scale_ * f[nodes[i / D] * D + static_cast<std::int64_t>(i % D)];
  Vector pressure(num_cells);
  for (std::size_t cell = 0; cell < num_cells; ++cell) {
    b[num_velocities + cell] = divergence_scale_ * g[cells_[cell]];
    pressure[cell] = b[num_velocities + cell] / mass_[cell];
  }
  add_gradient(gamma_, pressure.data(), b.data(), pool);
  VectorOps ops(pool);
  const double size = ops.norm(b);
  KrylovResult result =
      flexible_gmres([&](const Vector& in, Vector& out) { apply(in, out, pool); },
                     [&](const Vector& in, Vector& out) { precondition(in, out, pool); }, b, x,
                     rtol * size, max_iters, ops);
  result.residual_norm = size > 0.0 ? result.residual_norm / size : 0.0;
  for (std::size_t i = 0; i < num_velocities; ++i)
    if (!fixed_[i]) v[nodes[i / D] * D + static_cast<std::int64_t>(i % D)] = x[i];
  const double by_gamma = strict() ? 1.0 : 1.0 / (1.0 - gamma_ / op_.options().bulk);
  double* q = x.data() + num_velocities;
  if (strict()) {
    const auto sum = closed_sums(q);
    for (const auto& c : closed_.cells())
      q[number_[u(c.cell)]] += gamma_ * c.ratio * sum[u(c.region)];
  }
  for (std::size_t cell = 0; cell < num_cells; ++cell)
    p[cells_[cell]] = q[cell] * by_gamma / op_.geometry().grid().h_min;
  return result;
}

template <int D>
std::int64_t FlowMixed<D>::bytes() const {
  return static_cast<std::int64_t>(matrix_.values.size() * 8 + matrix_.columns.size() * 4) +
         patterns_->bytes() + multigrid_->bytes();
}

template class FlowMixed<2>;
template class FlowMixed<3>;

}  // namespace diffsim
