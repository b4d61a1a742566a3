#include "kernels/stokes/flow_schur.h"

#include <Eigen/LU>

#include "kernels/stokes/row_chunks.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

// Added to the diagonal of Q' L Q, in parts of it.
constexpr double kRegular = 1e-6;

}  // namespace

template <int D>
std::vector<double> invert_diagonals(std::vector<double> blocks,
                                     const FlowDivergence<D>& divergence,
                                     const std::vector<double>& mass, double gamma,
                                     ThreadPool& pool) {
  for (std::int64_t cell = 0; cell < divergence.size(); ++cell) {
    const double* c = divergence.row(cell);
    for (int i = 0; i < 1 << D; ++i) {
      const std::int64_t at = divergence.node(cell, i) * D;
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b)
          if (!divergence.fixed(at + a) && !divergence.fixed(at + b))
            blocks[u((at + a) * D + b)] -= gamma / mass[u(cell)] * c[i * D + a] * c[i * D + b];
    }
  }
  for_chunks(static_cast<std::int64_t>(blocks.size()) / (D * D), pool, [&](std::int64_t i) {
    Eigen::Map<Eigen::Matrix<double, D, D, Eigen::RowMajor>> block(blocks.data() + i * D * D);
    block = block.inverse().eval();
    for (int a = 0; a < D; ++a)
      if (divergence.fixed(i * D + a)) {
        block.row(a).setZero();
        block.col(a).setZero();
      }
  });
  return blocks;
}

template <int D>
FlowSchur<D>::FlowSchur(const FlowOperator<D>& op, const FlowDivergence<D>& divergence,
                        const std::vector<double>& inverse_diagonal,
                        const std::vector<double>& mass, const std::vector<double>& compliance,
                        double gamma, ThreadPool& pool)
    : op_(op),
      divergence_(divergence),
      inverse_diagonal_(inverse_diagonal),
      mass_(mass),
      compliance_(compliance),
      gamma_(gamma),
      macros_(macro_cells()),
      cuts_(cut_cells()) {
  set_signs();
  set_weights(pool);
  patterns_ =
      factorize<kPatterns>(macros_, [&](std::int64_t cell, int s) { return sign(cell, s); }, pool);
  amplitude_.resize(u(macros_.size() * kPatterns));
  if (cuts_.size() > 0)
    among_cuts_ = factorize<1>(cuts_, [](std::int64_t, int) { return 1.0; }, pool);
  cut_pressure_.resize(u(cuts_.size()));
}

template <int D>
typename FlowSchur<D>::Groups FlowSchur<D>::macro_cells() const {
  const StokesGrid<D>& grid = op_.geometry().grid();
  std::int64_t stride[D], total = 1;
  for (int a = D - 1; a >= 0; --a) {
    stride[a] = total;
    total *= (grid.cells[a] + 1) / 2;
  }
  std::vector<std::int32_t> number(u(total), -1);
  std::vector<std::int64_t> place(u(divergence_.size()), 0);
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    std::int64_t at[D];
    grid.cell_position(divergence_.grid_cell(cell), at);
    for (int a = 0; a < D; ++a) place[u(cell)] += at[a] / 2 * stride[a];
    number[u(place[u(cell)])] = 0;
  }
  Groups groups;
  for (std::int64_t m = 0; m < total; ++m) {
    if (number[u(m)] < 0) continue;
    number[u(m)] = static_cast<std::int32_t>(groups.size());
    double at[3] = {};
    for (int a = 0; a < D; ++a)
      at[a] = static_cast<double>(m / stride[a] % ((grid.cells[a] + 1) / 2));
    groups.coords.insert(groups.coords.end(), at, at + 3);
  }
  for (std::int64_t at : place) groups.of.push_back(number[u(at)]);
  return groups;
}

template <int D>
typename FlowSchur<D>::Groups FlowSchur<D>::cut_cells() const {
  Groups groups;
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    groups.of.push_back(-1);
    if (!divergence_.cut(cell)) continue;
    groups.of.back() = static_cast<std::int32_t>(groups.size());
    std::int64_t at[D];
    op_.geometry().grid().cell_position(divergence_.grid_cell(cell), at);
    for (int a = 0; a < 3; ++a) groups.coords.push_back(a < D ? static_cast<double>(at[a]) : 0.0);
  }
  return groups;
}

template <int D>
void FlowSchur<D>::set_weights(ThreadPool& pool) {
  weight_.resize(u(divergence_.size()));
  for_chunks(divergence_.size(), pool, [&](std::int64_t cell) {
    weight_[u(cell)] = (1.0 + gamma_) / mass_[u(cell)];
    if (cuts_.of[u(cell)] >= 0) return;
    const double* c = divergence_.row(cell);
    double sum = compliance_[u(cell)];
    for (int i = 0; i < kCorners; ++i) {
      const double* inverse = inverse_diagonal_.data() + divergence_.node(cell, i) * D * D;
      for (int a = 0; a < D; ++a)
        for (int b = 0; b < D; ++b) sum += c[i * D + a] * inverse[a * D + b] * c[i * D + b];
    }
    weight_[u(cell)] += 1.0 / sum;
  });
}

/// Patterns alternate along axes 0 and 1; 0 and 2; 1 and 2; all. Bit a of kAxes stands for axis a.
template <int D>
void FlowSchur<D>::set_signs() {
  constexpr int kAxes[4] = {0b011, 0b101, 0b110, 0b111};
  signs_.resize(u(divergence_.size() * kPatterns));
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    std::int64_t at[D];
    op_.geometry().grid().cell_position(divergence_.grid_cell(cell), at);
    for (int pattern = 0; pattern < kPatterns; ++pattern) {
      std::int64_t sum = 0;
      for (int a = 0; a < D; ++a)
        if ((kAxes[pattern] >> a) & 1) sum += at[a];
      signs_[u(cell * kPatterns + pattern)] = sum % 2 ? -1.0f : 1.0f;
    }
  }
}

template <int D>
template <int P, typename Pattern>
std::unique_ptr<CholeskyFactor> FlowSchur<D>::factorize(const Groups& groups, Pattern&& by,
                                                        ThreadPool& pool) const {
  // Cells couple through the nodes that they share.
  constexpr int kSlots = pow3(D), kBlock = P * P;  // neighbors, and itself
  const std::int64_t n = groups.size();
  std::vector<double> rows(u(n * kSlots * kBlock), 0.0);
  std::vector<std::int32_t> column(u(n * kSlots), -1);
  const auto slot_of = [&](std::int64_t from, std::int64_t to) {
    int slot = 0;
    for (int a = 0; a < D; ++a)
      slot = 3 * slot +
             static_cast<int>(groups.coords[u(3 * to + a)] - groups.coords[u(3 * from + a)]) + 1;
    return slot;
  };
  const std::int64_t num_nodes = static_cast<std::int64_t>(inverse_diagonal_.size()) / (D * D);
  for (std::int64_t node = 0; node < num_nodes; ++node) {
    std::int32_t of[kCorners];
    double given[kCorners][P][D] = {}, solved[kCorners][P][D] = {};
    int count = 0;
    for (int i = 0; i < kCorners; ++i) {
      const std::int64_t cell = divergence_.cell_about(node, i);
      if (cell < 0 || groups.of[u(cell)] < 0) continue;
      int m = 0;
      while (m < count && of[m] != groups.of[u(cell)]) ++m;
      if (m == count) of[count++] = groups.of[u(cell)];
      for (int s = 0; s < P; ++s)
        for (int a = 0; a < D; ++a)
          given[m][s][a] += by(cell, s) * divergence_.row(cell)[i * D + a];
    }
    const double* inverse = inverse_diagonal_.data() + node * D * D;
    for (int m = 0; m < count; ++m)
      for (int s = 0; s < P; ++s)
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b) solved[m][s][a] += inverse[a * D + b] * given[m][s][b];
    for (int m = 0; m < count; ++m)
      for (int k = 0; k < count; ++k) {
        const std::int64_t at = std::int64_t{of[m]} * kSlots + slot_of(of[m], of[k]);
        column[u(at)] = of[k];
        for (int s = 0; s < P; ++s)
          for (int t = 0; t < P; ++t)
            for (int a = 0; a < D; ++a)
              rows[u(at * kBlock + s * P + t)] += given[m][s][a] * solved[k][t][a];
      }
  }
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    const std::int64_t group = groups.of[u(cell)], at = group * kSlots + kSlots / 2;
    if (group < 0) continue;
    column[u(at)] = static_cast<std::int32_t>(group);
    for (int s = 0; s < P; ++s)
      for (int t = 0; t < P; ++t)
        rows[u(at * kBlock + s * P + t)] += by(cell, s) * by(cell, t) * compliance_[u(cell)];
  }
  std::vector<std::int64_t> indptr(1, 0), indices;
  std::vector<double> values;
  // Where less than 2^D cells of a group are fluid, patterns coincide: Q has no full rank, and only
  // Q times the solution counts. kRegular makes Q' L Q definite.
  for (std::int64_t m = 0; m < n; ++m) {
    for (int slot = 0; slot < kSlots; ++slot) {
      const std::int64_t at = m * kSlots + slot;
      if (column[u(at)] < 0) continue;
      indices.push_back(column[u(at)]);
      double* block = rows.data() + at * kBlock;
      for (int s = 0; s < P && slot == kSlots / 2; ++s) block[s * P + s] *= 1.0 + kRegular;
      values.insert(values.end(), block, block + kBlock);
    }
    indptr.push_back(static_cast<std::int64_t>(indices.size()));
  }
  auto factor = std::make_unique<CholeskyFactor>(
      analyze_cholesky(n, indptr.data(), indices.data(), groups.coords.data(), P, nullptr, true),
      FactorPrecision::kRounded);
  factor->refactor(values.data(), pool);
  factor->release_refactor_memory();
  return factor;
}

template <int D>
void FlowSchur<D>::apply(const double* g, double* p, ThreadPool& pool) {
  std::fill(amplitude_.begin(), amplitude_.end(), 0.0);
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    double* amplitude = amplitude_.data() + std::int64_t{macros_.of[u(cell)]} * kPatterns;
    for (int s = 0; s < kPatterns; ++s) amplitude[s] += sign(cell, s) * g[cell];
    if (cuts_.of[u(cell)] >= 0) cut_pressure_[u(cuts_.of[u(cell)])] = g[cell];
  }
  patterns_->solve(amplitude_.data(), amplitude_.data(), 1, workspace_, pool);
  if (among_cuts_)
    among_cuts_->solve(cut_pressure_.data(), cut_pressure_.data(), 1, workspace_, pool);
  for (std::int64_t cell = 0; cell < divergence_.size(); ++cell) {
    const double* amplitude = amplitude_.data() + std::int64_t{macros_.of[u(cell)]} * kPatterns;
    p[cell] = weight_[u(cell)] * g[cell];
    for (int s = 0; s < kPatterns; ++s) p[cell] += sign(cell, s) * amplitude[s];
    if (cuts_.of[u(cell)] >= 0) p[cell] += cut_pressure_[u(cuts_.of[u(cell)])];
  }
}

template std::vector<double> invert_diagonals<2>(std::vector<double>, const FlowDivergence<2>&,
                                                 const std::vector<double>&, double, ThreadPool&);
template std::vector<double> invert_diagonals<3>(std::vector<double>, const FlowDivergence<3>&,
                                                 const std::vector<double>&, double, ThreadPool&);
template class FlowSchur<2>;
template class FlowSchur<3>;

}  // namespace diffsim
