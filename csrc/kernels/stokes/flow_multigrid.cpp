#include "kernels/stokes/flow_multigrid.h"

#include <Eigen/LU>
#include <algorithm>
#include <map>
#include <utility>
#if defined(__F16C__)
#include <immintrin.h>
#endif

#include "kernels/stokes/row_chunks.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

constexpr std::int64_t kCoarsest = 1200;  // nodes that are factorized rather than coarsened
constexpr int kMaxLevels = 12;
// Fine nodes for each coarse one, at least: a thin shape gains nothing from fewer.
constexpr std::size_t kLeastCoarsening = 2;
// Nodes couple with nodes up to two planes away.
constexpr std::int64_t kPlaneColors = 3;

// Numbers of 16 bits have 11 digits and end at 65504; below 6e-5 they lose digits.
constexpr float kHalfScale = 64.0f, kLargestHalf = 6e4f;
#if defined(__F16C__)
constexpr bool kHasHalf = true;
using Quad = float __attribute__((vector_size(16)));
std::uint16_t to_half(float x) { return _cvtss_sh(x, _MM_FROUND_TO_NEAREST_INT); }
Quad four_halves(const std::uint16_t* from) {
  return reinterpret_cast<Quad>(
      _mm_cvtph_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(from))));
}
#else
constexpr bool kHasHalf = false;
#endif

constexpr int pow5(int d) { return d == 0 ? 1 : 5 * pow5(d - 1); }

}  // namespace

template <int D>
FlowMultigrid<D>::FlowMultigrid(const NodeMatrix<D>& matrix, const NodePositions<D>& positions,
                                const std::vector<std::uint8_t>& fixed, double scale,
                                ThreadPool& pool) {
  NodeMatrix<D> held;
  NodePositions<D> at = positions;
  const NodeMatrix<D>* A = &matrix;
  std::vector<std::uint8_t> held_fixed = fixed;
  while (A->num_nodes() > kCoarsest && levels_.size() < kMaxLevels) {
    levels_.emplace_back();
    levels_.back().fixed = std::move(held_fixed);
    CoarseNodes<D> coarse = coarsen(at, levels_.back());
    if (kLeastCoarsening * coarse.positions.size() > at.size()) {
      held_fixed = std::move(levels_.back().fixed);
      levels_.pop_back();
      break;
    }
    add_level(*A, at, scale, pool);
    NodeMatrix<D> next = galerkin(*A, at, coarse, levels_.back(), pool);
    held = std::move(next);
    A = &held;
    at = std::move(coarse.positions);
    hold_empty(held, scale, held_fixed);
  }
  factorize(*A, at, scale, pool);
}

/// What no fine unknown gives to becomes a row of the identity.
template <int D>
void FlowMultigrid<D>::hold_empty(NodeMatrix<D>& A, double scale,
                                  std::vector<std::uint8_t>& fixed) const {
  std::vector<std::uint8_t> of_row(u(A.rows.num_rows() * D), 0);
  for (std::int64_t row = 0; row < A.rows.num_rows(); ++row) {
    const std::int64_t i = A.rows.holder[u(row)], begin = A.indptr[u(i)];
    for (std::int64_t k = begin; k < A.indptr[u(i) + 1]; ++k)
      for (int a = 0; a < D && A.columns[u(k)] == i; ++a) {
        double& diagonal = A.values[u((A.rows.begin[u(row)] + k - begin) * D * D + a * D + a)];
        if (diagonal > 0.0) continue;
        diagonal = 1.0 / scale;
        of_row[u(row * D + a)] = 1;
      }
  }
  fixed.clear();
  for (std::int32_t row : A.rows.of)
    fixed.insert(fixed.end(), of_row.begin() + row * D, of_row.begin() + (row + 1) * D);
}

template <int D>
CoarseNodes<D> FlowMultigrid<D>::coarsen(const NodePositions<D>& positions, Level& level) const {
  std::int32_t size[D] = {};
  for (const auto& p : positions)
    for (int a = 0; a < D; ++a) size[a] = std::max(size[a], p[u(a)] / 2 + 2);
  CoarseNodes<D> found;
  std::int64_t total = 1;
  std::int64_t* stride = found.stride;
  for (int a = D - 1; a >= 0; --a) {
    stride[a] = total;
    total *= size[a];
  }
  // Parents of a fine node: along each axis one coarse node, or the two about it.
  const auto for_parents = [&](const std::array<std::int32_t, D>& p, auto&& f) {
    for (int bits = 0; bits < 1 << D; ++bits) {
      std::int64_t index = 0;
      float weight = 1.0f;
      for (int a = 0; a < D; ++a) {
        const bool odd = p[u(a)] % 2 != 0, high = (bits >> (D - 1 - a)) & 1;
        if (high && !odd) weight = 0.0f;
        if (odd) weight *= 0.5f;
        index += (p[u(a)] / 2 + (high ? 1 : 0)) * stride[a];
      }
      if (weight > 0.0f) f(index, weight);
    }
  };
  std::vector<std::int32_t>& number = found.number;
  number.assign(u(total), -1);
  for (const auto& p : positions)
    for_parents(p, [&](std::int64_t index, float) { number[u(index)] = 0; });
  NodePositions<D>& coarse = found.positions;
  for (std::int64_t index = 0; index < total; ++index) {
    if (number[u(index)] < 0) continue;
    number[u(index)] = static_cast<std::int32_t>(coarse.size());
    std::array<std::int32_t, D> p;
    std::int64_t rest = index;
    for (int a = 0; a < D; ++a) {
      p[u(a)] = static_cast<std::int32_t>(rest / stride[a]);
      rest %= stride[a];
    }
    coarse.push_back(p);
  }
  level.parent_start.assign(1, 0);
  level.child_start.assign(coarse.size() + 1, 0);
  for (const auto& p : positions) {
    for_parents(p, [&](std::int64_t index, float weight) {
      level.parent.push_back(number[u(index)]);
      level.parent_weight.push_back(weight);
      ++level.child_start[u(number[u(index)]) + 1];
    });
    level.parent_start.push_back(static_cast<std::int64_t>(level.parent.size()));
  }
  for (std::size_t i = 0; i < coarse.size(); ++i) level.child_start[i + 1] += level.child_start[i];
  level.child.resize(level.parent.size());
  level.child_weight.resize(level.parent.size());
  std::vector<std::int64_t> next(level.child_start.begin(), level.child_start.end() - 1);
  for (std::size_t i = 0; i < positions.size(); ++i)
    for (std::int64_t k = level.parent_start[i]; k < level.parent_start[i + 1]; ++k) {
      const std::int64_t to = next[u(level.parent[u(k)])]++;
      level.child[u(to)] = static_cast<std::int32_t>(i);
      level.child_weight[u(to)] = level.parent_weight[u(k)];
    }
  return found;
}

/// Where the half rows lie, in blocks, and their columns. A row that several nodes have is split in
/// one way for each color of planes.
template <int D>
std::int64_t FlowMultigrid<D>::split_rows(const NodeMatrix<D>& A, const NodePositions<D>& positions,
                                          Level& level, ThreadPool& pool) const {
  const std::int64_t n = A.num_nodes();
  const auto turn = [&](std::int64_t j) {  // of a forward sweep
    return std::make_pair((positions[u(j)][0] - positions[0][0]) % kPlaneColors, j);
  };
  level.begin.assign(u(2 * n + 1), 0);
  level.values.resize(u(2 * n));
  for_chunks(n, pool, [&](std::int64_t i) {
    for (std::int64_t k = A.indptr[u(i)]; k < A.indptr[u(i) + 1]; ++k)
      if (A.columns[u(k)] != i) ++level.begin[u(turn(A.columns[u(k)]) < turn(i) ? i : n + i) + 1];
  });
  for (std::size_t q = 0; q < level.values.size(); ++q) level.begin[q + 1] += level.begin[q];
  level.columns.resize(u(level.begin.back()));
  for_chunks(n, pool, [&](std::int64_t i) {
    std::int64_t earlier = level.begin[u(i)], later = level.begin[u(n + i)];
    for (std::int64_t k = A.indptr[u(i)]; k < A.indptr[u(i) + 1]; ++k) {
      const std::int32_t j = A.columns[u(k)];
      if (j != i) level.columns[u(turn(j) < turn(i) ? earlier++ : later++)] = j;
    }
  });
  std::vector<std::int64_t> known(u(A.rows.num_rows() * kPlaneColors * 2), -1);
  level.holds.assign(u(n), 0);
  std::int64_t kept = 0;
  for (std::int64_t q = 0; q < 2 * n; ++q) {
    const std::int64_t i = q % n, color = turn(i).first;
    std::int64_t& at = known[u((A.rows.of[u(i)] * kPlaneColors + color) * 2 + q / n)];
    if (at < 0) {
      at = kept;
      kept += level.begin[u(q) + 1] - level.begin[u(q)];
      level.holds[u(i)] = 1;
    }
    level.values[u(q)] = at;
  }
  return kept;
}

template <int D>
void FlowMultigrid<D>::add_level(const NodeMatrix<D>& A, const NodePositions<D>& positions,
                                 double scale, ThreadPool& pool) {
  Level& level = levels_.back();
  const std::int64_t n = A.num_nodes();
  const std::int64_t num_blocks = split_rows(A, positions, level, pool);
  float largest = 0.0f;
  for (double value : A.values)
    largest = std::max(largest, static_cast<float>(std::abs(scale * value)));
  level.is_half = kHasHalf && levels_.size() == 1 && largest * kHalfScale < kLargestHalf;
  const std::int64_t block_size = D * (level.is_half ? D : kLanes);
  for (std::int64_t& at : level.values) at *= block_size;
  if (level.is_half)
    level.halves.resize(u(num_blocks * block_size + 1));  // they are read four at a time
  else
    level.blocks.resize(u(num_blocks * block_size));
  level.inverse.assign(u(n * D * kLanes), 0.0f);
  for (AlignedBuffer<float>* v : {&level.x, &level.b, &level.r}) {
    v->resize(u(n * kLanes));
    std::fill(v->data(), v->data() + n * kLanes, 0.0f);
  }
  for_chunks(n, pool, [&](std::int64_t i) {
    const double* from = A.values.data() + A.rows.first(i) * D * D;
    std::int64_t earlier = level.begin[u(i)];
    std::int64_t next[2] = {level.values[u(i)], level.values[u(n + i)]};
    for (std::int64_t k = A.indptr[u(i)]; k < A.indptr[u(i) + 1]; ++k, from += D * D) {
      if (A.columns[u(k)] == i) {
        Eigen::Map<const Eigen::Matrix<double, D, D, Eigen::RowMajor>> block(from);
        const Eigen::Matrix<double, D, D> inverse = (scale * block).inverse();
        for (int a = 0; a < D; ++a)
          for (int b = 0; b < D; ++b)
            level.inverse[u((i * D + b) * kLanes + a)] = static_cast<float>(inverse(a, b));
        continue;
      }
      if (!level.holds[u(i)]) continue;
      const bool is_earlier =
          earlier < level.begin[u(i) + 1] && level.columns[u(earlier)] == A.columns[u(k)];
      earlier += is_earlier;
      std::int64_t& at = next[is_earlier ? 0 : 1];
      for (int b = 0; b < D; ++b)
        for (int a = 0; a < kLanes; ++a) {
          const float value = a < D ? static_cast<float>(scale * from[a * D + b]) : 0.0f;
          if (!level.is_half) level.blocks.data()[at + b * kLanes + a] = value;
#if defined(__F16C__)
          if (level.is_half && a < D)
            level.halves.data()[at + b * D + a] = to_half(kHalfScale * value);
#endif
        }
      at += block_size;
    }
  });
  level.planes.assign(1, 0);
  for (std::int64_t i = 1; i < n; ++i)
    for (std::int32_t p = positions[u(i - 1)][0]; p < positions[u(i)][0]; ++p)
      level.planes.push_back(i);
  level.planes.push_back(n);
  bytes_ += num_blocks * block_size * (level.is_half ? 2 : 4) + level.begin.back() * 4 +
            n * (2 * 16 + (D * kLanes + 3 * kLanes) * 4);
}

/// Coarse rows are equal where their children lie alike and have equal rows, so that these couple
/// with neighbors that lie alike. Rows that one fine node has alone make no equal ones.
template <int D>
MatrixRows FlowMultigrid<D>::coarse_rows(const NodeMatrix<D>& A, const NodePositions<D>& fine,
                                         const NodePositions<D>& coarse, const Level& level) const {
  constexpr std::size_t kPlaces = pow3(D);  // of children about a coarse node
  std::vector<std::int32_t> count(u(A.rows.num_rows()), 0);
  for (std::int32_t row : A.rows.of) ++count[u(row)];
  std::map<std::array<std::int32_t, kPlaces>, std::int32_t> known;
  MatrixRows rows;
  for (std::size_t I = 0; I < coarse.size(); ++I) {
    std::array<std::int32_t, kPlaces> told;
    told.fill(-1);
    bool alone = false;
    for (std::int64_t c = level.child_start[I]; c < level.child_start[I + 1] && !alone; ++c) {
      const std::int32_t i = level.child[u(c)], row = A.rows.of[u(i)];
      int place = 0;
      for (std::size_t a = 0; a < D; ++a) place = 3 * place + fine[u(i)][a] - 2 * coarse[I][a] + 1;
      told[u(place)] = row;
      alone = count[u(row)] == 1;
    }
    const auto found = alone ? known.end() : known.find(told);
    if (found != known.end()) {
      rows.add_known(found->second);
      continue;
    }
    rows.add(0);
    if (!alone) known.emplace(told, rows.of.back());
  }
  return rows;
}

template <int D>
NodeMatrix<D> FlowMultigrid<D>::galerkin(const NodeMatrix<D>& A, const NodePositions<D>& fine,
                                         const CoarseNodes<D>& nodes, const Level& level,
                                         ThreadPool& pool) const {
  constexpr int kSlots = pow5(D);     // nodes at most two away along each axis
  constexpr std::int64_t kRows = 64;  // of a task
  const NodePositions<D>& coarse = nodes.positions;
  NodeMatrix<D> out;
  out.rows = coarse_rows(A, fine, coarse, level);
  const std::int64_t n = out.rows.num_rows();
  struct Part {
    std::vector<std::int64_t> counts, offsets;  // of columns; these in places of the coarse box
    std::vector<double> values;
  };
  std::vector<Part> parts(u((n + kRows - 1) / kRows));
  pool.run(static_cast<std::int64_t>(parts.size()), [&](std::int64_t task) {
    Part& part = parts[u(task)];
    std::vector<double> row(kSlots * D * D);
    std::vector<std::uint8_t> taken(kSlots);
    for (std::int64_t R = task * kRows; R < std::min(n, (task + 1) * kRows); ++R) {
      const std::int64_t I = out.rows.holder[u(R)];
      std::fill(row.begin(), row.end(), 0.0);
      std::fill(taken.begin(), taken.end(), 0);
      for (std::int64_t c = level.child_start[u(I)]; c < level.child_start[u(I) + 1]; ++c) {
        const std::int64_t i = level.child[u(c)];
        const std::uint8_t* fixed_i = level.fixed.data() + i * D;
        const double* values = A.values.data() + A.rows.first(i) * D * D;
        for (std::int64_t k = A.indptr[u(i)]; k < A.indptr[u(i) + 1]; ++k, values += D * D) {
          const std::int64_t j = A.columns[u(k)];
          const std::uint8_t* fixed_j = level.fixed.data() + j * D;
          double block[D * D];
          for (int a = 0; a < D; ++a)
            for (int b = 0; b < D; ++b)
              block[a * D + b] =
                  fixed_i[a] || fixed_j[b]
                      ? 0.0
                      : static_cast<double>(level.child_weight[u(c)]) * values[a * D + b];
          for (std::int64_t q = level.parent_start[u(j)]; q < level.parent_start[u(j) + 1]; ++q) {
            const std::int32_t J = level.parent[u(q)];
            int slot = 0;
            for (int a = 0; a < D; ++a)
              slot = 5 * slot + coarse[u(J)][u(a)] - coarse[u(I)][u(a)] + 2;
            taken[u(slot)] = 1;
            const double w = level.parent_weight[u(q)];
            for (int e = 0; e < D * D; ++e) row[u(slot * D * D + e)] += w * block[e];
          }
        }
      }
      part.counts.push_back(0);
      for (int slot = 0; slot < kSlots; ++slot) {
        if (!taken[u(slot)]) continue;
        ++part.counts.back();
        part.offsets.push_back(0);
        for (int a = D - 1, rest = slot; a >= 0; --a, rest /= 5)
          part.offsets.back() += (rest % 5 - 2) * nodes.stride[a];
        part.values.insert(part.values.end(), row.begin() + slot * D * D,
                           row.begin() + (slot + 1) * D * D);
      }
    }
  });
  std::size_t num_blocks = 0;
  for (const Part& part : parts) num_blocks += part.offsets.size();
  std::vector<std::int64_t> offsets;
  offsets.reserve(num_blocks);
  out.values.reserve(num_blocks * D * D);
  out.rows.begin.assign(1, 0);
  for (const Part& part : parts) {
    for (std::int64_t count : part.counts) out.rows.begin.push_back(out.rows.begin.back() + count);
    offsets.insert(offsets.end(), part.offsets.begin(), part.offsets.end());
    out.values.insert(out.values.end(), part.values.begin(), part.values.end());
  }
  out.indptr.assign(1, 0);
  for (std::size_t I = 0; I < coarse.size(); ++I) {
    std::int64_t place = 0;
    for (std::size_t a = 0; a < D; ++a) place += coarse[I][a] * nodes.stride[a];
    const std::size_t row = u(out.rows.of[I]);
    for (std::int64_t k = out.rows.begin[row]; k < out.rows.begin[row + 1]; ++k)
      out.columns.push_back(nodes.number[u(place + offsets[u(k)])]);
    out.indptr.push_back(static_cast<std::int64_t>(out.columns.size()));
  }
  return out;
}

template <int D>
void FlowMultigrid<D>::factorize(const NodeMatrix<D>& A, const NodePositions<D>& positions,
                                 double scale, ThreadPool& pool) {
  std::vector<std::int64_t> indices(A.columns.begin(), A.columns.end());
  std::vector<double> coords(positions.size() * 3, 0.0), values;
  for (std::int64_t i = 0; i < A.num_nodes(); ++i) {
    const double* row = A.values.data() + A.rows.first(i) * D * D;
    values.insert(values.end(), row, row + (A.indptr[u(i) + 1] - A.indptr[u(i)]) * D * D);
  }
  for (std::size_t i = 0; i < positions.size(); ++i)
    for (std::size_t a = 0; a < D; ++a) coords[3 * i + a] = positions[i][a];
  for (double& v : values) v *= scale;
  // Coarse functions coincide where all the fine nodes that they reach do, at the fluid's edge:
  // only what they give together counts. This much on the diagonal makes the matrix definite.
  constexpr double kRegular = 1e-7;
  for (std::int64_t i = 0; i < A.num_nodes(); ++i)
    for (std::int64_t k = A.indptr[u(i)]; k < A.indptr[u(i) + 1]; ++k)
      for (int a = 0; a < D && A.columns[u(k)] == i; ++a)
        values[u(k * D * D + a * D + a)] *= 1.0 + kRegular;
  coarsest_ = std::make_unique<CholeskyFactor>(
      analyze_cholesky(A.num_nodes(), A.indptr.data(), indices.data(), coords.data(), D));
  coarsest_->refactor(values.data(), pool);
  coarsest_->release_refactor_memory();
  coarse_b_.assign(u(A.num_nodes() * D), 0.0);
  bytes_ += coarsest_->bytes();
}

/// A half row's blocks times x; the last lanes mean nothing.
template <int D>
template <bool kHalf>
typename FlowMultigrid<D>::Lanes FlowMultigrid<D>::sum_blocks(const Level& level,
                                                              std::int64_t half_row) const {
  constexpr int kBlock = D * (kHalf ? D : kLanes);
  const float* x = level.x.data();
  const std::int32_t* column = level.columns.data() + level.begin[u(half_row)];
  const std::int64_t count = level.begin[u(half_row) + 1] - level.begin[u(half_row)];
  const std::int64_t first = level.values[u(half_row)];
  Lanes s[2][D] = {};  // chains of sums that do not wait for each other
  const auto add = [&](std::int64_t k, Lanes* sum) {
    const float* y = x + static_cast<std::int64_t>(column[k]) * kLanes;
    const std::int64_t at = first + k * kBlock;
    for (int c = 0; c < D; ++c) {
#if defined(__F16C__)
      if constexpr (kHalf) {
        sum[c] += four_halves(level.halves.data() + at + c * D) * y[c];
        continue;
      }
#endif
      sum[c] += reinterpret_cast<const Lanes*>(level.blocks.data() + at)[c] * y[c];
    }
  };
  std::int64_t k = 0;
  for (; k + 2 <= count; k += 2) {
    add(k, s[0]);
    add(k + 1, s[1]);
  }
  if (k < count) add(k, s[0]);
  Lanes total = {};
  for (int c = 0; c < D; ++c) total += s[0][c] + s[1][c];
  return kHalf ? total * (1.0f / kHalfScale) : total;
}

/// Forward as from x = 0, so that only the blocks of earlier nodes count, or backward.
template <int D>
void FlowMultigrid<D>::sweep(Level& level, bool backward, ThreadPool& pool) const {
  const std::int64_t num_planes = static_cast<std::int64_t>(level.planes.size()) - 1;
  const float* b = level.b.data();
  float* x = level.x.data();
  const auto update = [&](std::int64_t i) {
    Lanes s = *reinterpret_cast<const Lanes*>(b + i * kLanes) - product(level, i);
    if (backward) s -= product(level, level.num_nodes() + i);
    const Lanes* inverse = reinterpret_cast<const Lanes*>(level.inverse.data() + i * D * kLanes);
    Lanes solved = {};
    for (int c = 0; c < D; ++c) solved += inverse[c] * s[c];
    *reinterpret_cast<Lanes*>(x + i * kLanes) = solved;
  };
  for (std::int64_t turn = 0; turn < kPlaneColors; ++turn) {
    const std::int64_t color = backward ? kPlaneColors - 1 - turn : turn;
    const std::int64_t num_tasks = (num_planes - color + kPlaneColors - 1) / kPlaneColors;
    pool.run(num_tasks, [&](std::int64_t task) {
      const std::int64_t p = kPlaneColors * task + color;
      const std::int64_t begin = level.planes[u(p)], end = level.planes[u(p) + 1];
      if (backward)
        for (std::int64_t i = end - 1; i >= begin; --i) update(i);
      else
        for (std::int64_t i = begin; i < end; ++i) update(i);
    });
  }
}

/// After a forward sweep from zero, which leaves the blocks of later nodes alone.
template <int D>
void FlowMultigrid<D>::residual(Level& level, ThreadPool& pool) const {
  float* r = level.r.data();
  for_chunks(level.num_nodes(), pool, [&](std::int64_t i) {
    const Lanes s = -product(level, level.num_nodes() + i);
    for (int a = 0; a < D; ++a) r[i * kLanes + a] = level.fixed[u(i * D + a)] ? 0.0f : s[a];
  });
}

template <int D>
void FlowMultigrid<D>::cycle(std::size_t l, ThreadPool& pool) {
  Level& level = levels_[l];
  sweep(level, false, pool);
  residual(level, pool);
  const bool last = l + 1 == levels_.size();
  const std::int64_t num_coarse = static_cast<std::int64_t>(level.child_start.size()) - 1;
  for_chunks(num_coarse, pool, [&](std::int64_t I) {
    Lanes s = {};
    for (std::int64_t c = level.child_start[u(I)]; c < level.child_start[u(I) + 1]; ++c)
      s += *reinterpret_cast<const Lanes*>(level.r.data() +
                                           static_cast<std::int64_t>(level.child[u(c)]) * kLanes) *
           level.child_weight[u(c)];
    for (int a = 0; a < D; ++a)
      if (last)
        coarse_b_[u(I * D + a)] = static_cast<double>(s[a]);
      else
        levels_[l + 1].b.data()[I * kLanes + a] = s[a];
  });
  if (last)
    coarsest_->solve(coarse_b_.data(), coarse_b_.data(), 1, workspace_, pool);
  else
    cycle(l + 1, pool);
  for_chunks(level.num_nodes(), pool, [&](std::int64_t i) {
    for (std::int64_t q = level.parent_start[u(i)]; q < level.parent_start[u(i) + 1]; ++q)
      for (int a = 0; a < D; ++a) {
        if (level.fixed[u(i * D + a)]) continue;
        const std::int64_t J = level.parent[u(q)];
        const float y = last ? static_cast<float>(coarse_b_[u(J * D + a)])
                             : levels_[l + 1].x.data()[J * kLanes + a];
        level.x.data()[i * kLanes + a] += level.parent_weight[u(q)] * y;
      }
  });
  sweep(level, true, pool);
}

template <int D>
void FlowMultigrid<D>::apply(const double* b, double* x, ThreadPool& pool) {
  if (levels_.empty()) {
    coarsest_->solve(b, x, 1, workspace_, pool);
    return;
  }
  Level& level = levels_[0];
  for_chunks(level.num_nodes(), pool, [&](std::int64_t i) {
    for (int a = 0; a < D; ++a) level.b.data()[i * kLanes + a] = static_cast<float>(b[i * D + a]);
  });
  cycle(0, pool);
  for_chunks(level.num_nodes(), pool, [&](std::int64_t i) {
    for (int a = 0; a < D; ++a) x[i * D + a] = static_cast<double>(level.x.data()[i * kLanes + a]);
  });
}

template <int D>
std::int64_t FlowMultigrid<D>::bytes() const {
  return bytes_;
}

template class FlowMultigrid<2>;
template class FlowMultigrid<3>;

}  // namespace diffsim
