#include <Eigen/Cholesky>
#include <cmath>

#include "kernels/linalg/block3.h"
#include "kernels/linalg/float_lanes.h"
#include "kernels/linalg/rigid_multigrid.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

// Smoothing of the tentative prolongation, over the largest eigenvalue (Vanek et al. 1996).
constexpr double kProlongationDamping = 4.0 / 3.0;
// Power iterations, at first and on a matrix that has changed, and what they may have missed.
constexpr int kFirstPowers = 8, kMorePowers = 2;
constexpr float kEigenvalueMargin = 1.1F;
// Unknowns of a coarse level that nothing moves (an aggregate of one node does not turn) get this
// of the largest entry beside them.
constexpr float kLeastDiagonal = 1e-5F;

/// Calls f(row) for every row.
template <typename F>
void for_rows(Index num_rows, Index task_rows, ThreadPool& pool, F&& f) {
  pool.run_ranges(num_rows, task_rows, [&](Index begin, Index end) {
    for (Index i = begin; i < end; ++i) f(i);
  });
}

/// Where the entries of a row lie, by column; what a row does not have is undefined.
class Places {
 public:
  explicit Places(Index num_columns) : place_(new Index[at(num_columns)]) {}
  Index& operator[](Index column) { return place_[at(column)]; }

 private:
  std::unique_ptr<Index[]> place_;
};

/// Calls f(row, places) for every row.
template <typename F>
void for_rows_with_places(Index num_rows, Index task_rows, Index num_columns, ThreadPool& pool,
                          F&& f) {
  pool.run_ranges(num_rows, task_rows, [&](Index begin, Index end) {
    Places places(num_columns);
    for (Index i = begin; i < end; ++i) f(i, places);
  });
}

/// Blocks of the matrix of a level, read as columns that are padded to a register.
template <int K>
struct Blocks;
template <>
struct Blocks<3> {
  static constexpr int kPadded = 3;
  const double* values;
  const float *diagonal, *scale;
  void read(Index entry, Index row, Index column, float out[3][kPadded]) const {
    if (row == column)
      std::memcpy(out, diagonal + row * kBlock3, kBlock3 * sizeof(float));
    else
      scale_block3(values + entry * kBlock3, 1.0F / (scale[row] * scale[column]), out[0]);
  }
};
template <>
struct Blocks<6> {
  static constexpr int kPadded = kFloatLanes;
  const float* values;
  void read(Index entry, Index, Index, float out[6][kPadded]) const {
    std::memcpy(out, values + entry * kFloatBlock, kFloatBlock * sizeof(float));
  }
};
template <int K, typename Finest, typename Level>
Blocks<K> blocks_of(const BlockMatrix& matrix, const Finest& finest, const Level& level) {
  if constexpr (K == 3)
    return {matrix.values, finest.diagonal.data(), finest.scale.data()};
  else
    return {level.matrix.data()};
}

/// P block P, and what the block has of stiffness on the axes that P takes away.
void restrict_to(const float* projection, Eigen::Matrix3d& block) {
  using RowMajor = Eigen::Matrix<float, 3, 3, Eigen::RowMajor>;
  const Eigen::Matrix3d P = Eigen::Map<const RowMajor>(projection).cast<double>();
  const double scale = block.diagonal().cwiseAbs().maxCoeff();
  block = (P * block * P + scale * (Eigen::Matrix3d::Identity() - P)).eval();
}

/// P out P, all of them symmetric.
void project_block(const float* projection, float* out) {
  using RowMajor = Eigen::Matrix<float, 3, 3, Eigen::RowMajor>;
  const RowMajor P = Eigen::Map<const RowMajor>(projection);
  Eigen::Map<RowMajor> block(out);
  block = (P * block * P).eval();
}

/// Inverse of a symmetric block, or of its diagonal where the block is not positive definite.
template <int K>
void invert(const Eigen::Matrix<double, K, K>& block, float* out) {
  using Matrix = Eigen::Matrix<double, K, K>;
  const Eigen::LLT<Matrix> llt(block);
  Matrix inverse = Matrix::Zero();
  if (llt.info() == Eigen::Success)
    inverse = llt.solve(Matrix::Identity());
  else
    inverse.diagonal() = block.diagonal().cwiseAbs().cwiseMax(1e-300).cwiseInverse();
  for (int k = 0; k < K; ++k)
    for (int m = 0; m < K; ++m) out[k * K + m] = static_cast<float>(inverse(k, m));
}

}  // namespace

void RigidMultigrid::prepare(const BlockMatrix& matrix, const double* x, ThreadPool& pool) {
  fixed_.assign(matrix.fixed, matrix.fixed + 3 * matrix.num_nodes);
  hold(matrix.held ? *matrix.held : std::vector<HeldNode>{}, matrix.num_nodes);
  levels_[0].position.assign(x, x + 3 * matrix.num_nodes);
  copy_matrix(matrix, pool);
  for (int l = 0; l + 1 < hierarchy_->num_levels(); ++l) {
    invert_diagonal(l, pool);
    estimate_largest(l, pool);
    place_aggregates(l);
    make_tentative(l, pool);
    if (l == 0) {
      make_prolongation<3>(matrix, l, pool);
      make_product<3>(matrix, l, pool);
      make_coarse<3>(l, pool);
    } else {
      make_prolongation<6>(matrix, l, pool);
      make_product<6>(matrix, l, pool);
      make_coarse<6>(l, pool);
    }
    mirror_coarse(l + 1, pool);
    if (l == 0) restore_translations(pool);
  }
  factorize_coarsest(pool);
}

void RigidMultigrid::forget() {
  for (Level& level : levels_) level.mode.clear();  // all else is overwritten
}

void RigidMultigrid::hold(const std::vector<HeldNode>& held, Index num_nodes) {
  held_.assign(held.empty() ? 0 : at(num_nodes), -1);
  projections_.clear();
  for (const HeldNode& h : held) {
    held_[at(h.node)] = static_cast<std::int32_t>(projections_.size() / kBlock3);
    for (double v : h.free) projections_.push_back(static_cast<float>(v));
  }
}

const float* RigidMultigrid::projection(Index node) const {
  const std::int32_t place = held_.empty() ? -1 : held_[at(node)];
  return place < 0 ? nullptr : projections_.data() + kBlock3 * place;
}

void RigidMultigrid::copy_matrix(const BlockMatrix& matrix, ThreadPool& pool) {
  finest_.blocks.resize(pattern(0).column.size() * kBlock3 + kBehindBlocks3);
  finest_.diagonal.resize(at(matrix.num_nodes * kBlock3 + kBehindBlocks3));
  finest_.lost.resize(at(matrix.num_nodes * kBlock3));
  float* scale = finest_.scale.resize(at(matrix.num_nodes));
  for_rows(matrix.num_nodes, task_rows(0), pool, [&](Index i) {
    Largest3 largest;
    for (Index e = pattern(0).begin(i); e < pattern(0).end(i); ++e) {
      const double* block = matrix.values + kBlock3 * e;
      __builtin_prefetch(block + kBytesAhead3 / sizeof(double));
      if (pattern(0)[e] != i) largest.take(block);
    }
    const float value = largest.value();
    scale[i] = value > 0.0F ? std::sqrt(value / (kLargestShort * kShortUnit)) : 1.0F;
  });
  for_rows(matrix.num_nodes, task_rows(0), pool, [&](Index i) { round_row(matrix, i); });
  if (!matrix.held) return;
  for (const HeldNode& h : *matrix.held) {
    float* own = finest_.diagonal.data() + kBlock3 * h.node;
    const double unit = 1.0 / static_cast<double>(scale[h.node] * scale[h.node]);
    for (int k = 0; k < kBlock3; ++k) own[k] += static_cast<float>(unit * h.stiffness[k]);
  }
}

void RigidMultigrid::round_row(const BlockMatrix& matrix, Index i) {
  const float* scale = finest_.scale.data();
  const Index diagonal = hierarchy_->diagonal(0, i);
  Rounding3 rounding;
  for (Index e = pattern(0).begin(i); e < pattern(0).end(i); ++e) {
    const double* block = matrix.values + kBlock3 * e;
    __builtin_prefetch(block + kBytesAhead3 / sizeof(double));
    const float other = scale[pattern(0)[e]];
    const float unit = e == diagonal ? 0.0F : 1.0F / (scale[i] * other * kShortUnit);
    rounding.write(block, unit, other, finest_.blocks.data() + kBlock3 * e);
  }
  const double* from = matrix.values + kBlock3 * diagonal;
  const double unit = 1.0 / (static_cast<double>(scale[i]) * static_cast<double>(scale[i]));
  float* own = finest_.diagonal.data() + kBlock3 * i;
  float* lost = finest_.lost.data() + kBlock3 * i;
  for (int k = 0; k < 3; ++k)
    for (int m = 0; m < 3; ++m) {
      const int place = block3_place(k, m), other = block3_place(m, k);
      const double inertia = k == m ? matrix.diagonal[i] : 0.0;
      own[place] = static_cast<float>(unit * (from[place] + inertia));
      lost[place] = 0.5F * kShortUnit * (rounding.lost(place) + rounding.lost(other)) / scale[i];
    }
}

/// Once coarse matrices are made of the exact one.
void RigidMultigrid::restore_translations(ThreadPool& pool) {
  for_rows(pattern(0).num_rows(), task_rows(0), pool, [&](Index i) {
    for (Index k = kBlock3 * i; k < kBlock3 * (i + 1); ++k)
      finest_.diagonal.data()[k] += finest_.lost.data()[k];
  });
}

void RigidMultigrid::invert_diagonal(int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  const Index n = pattern(l).num_rows();
  const int size = l == 0 ? 9 : 36;
  float* inverse = level.inverse.resize(at(n * size));
  for_rows(n, task_rows(l), pool, [&](Index i) {
    if (l > 0) {
      const float* own = level.matrix.data() + hierarchy_->diagonal(l, i) * kFloatBlock;
      Eigen::Matrix<double, 6, 6> block;
      for (int k = 0; k < 6; ++k)
        for (int m = 0; m < 6; ++m) block(k, m) = static_cast<double>(own[m * kFloatLanes + k]);
      invert<6>(block, inverse + i * size);
      return;
    }
    const float* own = finest_.diagonal.data() + kBlock3 * i;
    const std::uint8_t* fixed = fixed_.data() + 3 * i;
    Eigen::Matrix3d block;
    for (int k = 0; k < 3; ++k)
      for (int m = 0; m < 3; ++m)
        block(k, m) = fixed[k] || fixed[m] ? (k == m ? 1.0 : 0.0)
                                           : static_cast<double>(own[block3_place(k, m)]);
    float* out = inverse + i * size;
    const float* held = projection(i);
    if (held) restrict_to(held, block);
    invert<3>(block, out);
    if (held) project_block(held, out);
    for (int k = 0; k < 3; ++k)
      if (fixed[k])
        for (int m = 0; m < 3; ++m) out[3 * k + m] = out[3 * m + k] = 0.0F;
  });
}

void RigidMultigrid::estimate_largest(int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  const std::size_t size = at(pattern(l).num_rows() * stride(l));
  const bool is_first = level.mode.empty();
  if (is_first) {
    level.mode.resize(size);
    std::uint64_t random = 1;
    for (float& v : level.mode) {
      random = random * 6364136223846793005u + 1442695040888963407u;  // Knuth's MMIX generator
      v = static_cast<float>(static_cast<double>(random >> 11) * 0x1p-53 - 0.5);
    }
  }
  struct Squares {
    double before = 0.0, after = 0.0;
  };
  const Index rows = pattern(l).num_rows(), width = stride(l);
  std::vector<Squares> of_task(at((rows + task_rows(l) - 1) / task_rows(l)));
  float *mode = level.mode.data(), *image = level.image.data(), *step = level.step.data();
  for (int k = 0; k < (is_first ? kFirstPowers : kMorePowers); ++k) {
    pool.run_ranges(rows, task_rows(l), [&](Index begin, Index end) {
      multiply_rows(l, mode, image, begin, end);
      scale_rows(l, image, step, begin, end);
      Squares sum;
      for (Index i = width * begin; i < width * end; ++i) {
        const double m = static_cast<double>(mode[i]), s = static_cast<double>(step[i]);
        sum.before += m * m;
        sum.after += s * s;
      }
      of_task[at(begin / task_rows(l))] = sum;
    });
    double before = 0.0, after = 0.0;
    for (const Squares& sum : of_task) {
      before += sum.before;
      after += sum.after;
    }
    if (!(after > 0.0)) break;
    level.largest = kEigenvalueMargin * static_cast<float>(std::sqrt(after / before));
    const float norm = static_cast<float>(1.0 / std::sqrt(after));
    pool.run_ranges(rows, task_rows(l), [&](Index begin, Index end) {
      for (Index i = width * begin; i < width * end; ++i) mode[i] = norm * step[i];
    });
  }
}

void RigidMultigrid::place_aggregates(int l) {
  const Aggregates& aggregates = hierarchy_->transfer(l).aggregates;
  const Level& fine = levels_[at(l)];
  Level& coarse = levels_[at(l + 1)];
  const std::size_t n = aggregates.of_node.size();
  coarse.position.assign(at(3 * aggregates.count), 0.0);
  std::vector<double> count(at(aggregates.count), 0.0);
  for (std::size_t i = 0; i < n; ++i) {
    const std::size_t a = at(aggregates.of_node[i]);
    count[a] += 1.0;
    for (std::size_t k = 0; k < 3; ++k) coarse.position[3 * a + k] += fine.position[3 * i + k];
  }
  for (std::size_t a = 0; a < count.size(); ++a)
    for (std::size_t k = 0; k < 3; ++k) coarse.position[3 * a + k] /= count[a];
  double square = 0.0;
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t k = 0; k < 3; ++k) {
      const double d =
          fine.position[3 * i + k] - coarse.position[3 * at(aggregates.of_node[i]) + k];
      square += d * d;
    }
  coarse.length = std::sqrt(square / static_cast<double>(n));
  if (!(coarse.length > 0.0)) coarse.length = 1.0;
}

void RigidMultigrid::make_tentative(int l, ThreadPool& pool) {
  const Aggregates& aggregates = hierarchy_->transfer(l).aggregates;
  Level& fine = levels_[at(l)];
  const Level& coarse = levels_[at(l + 1)];
  const int K = l == 0 ? 3 : 6;
  const Index n = pattern(l).num_rows();
  float* tentative = fine.tentative.resize(at(n * K * kFloatLanes));
  for_rows(n, task_rows(l), pool, [&](Index i) {
    float* T = tentative + i * K * kFloatLanes;
    std::fill(T, T + K * kFloatLanes, 0.0F);
    double d[3];
    for (int k = 0; k < 3; ++k)
      d[k] =
          (fine.position[at(3 * i + k)] - coarse.position[at(3 * aggregates.of_node[at(i)] + k)]) /
          coarse.length;
    for (int k = 0; k < 3; ++k) {  // u = t + w x d
      if (l == 0 && fixed_[at(3 * i + k)]) continue;
      float* row = T + k * kFloatLanes;
      const int p = (k + 1) % 3, q = (k + 2) % 3;
      row[k] = 1.0F;
      row[3 + p] = static_cast<float>(d[q]);
      row[3 + q] = static_cast<float>(-d[p]);
    }
    for (int k = 3; k < K; ++k)
      T[k * kFloatLanes + k] = static_cast<float>(fine.length / coarse.length);
    if (l > 0) return;
    const float scale = finest_.scale.data()[i];
    for (int k = 0; k < 3 * kFloatLanes; ++k) T[k] *= scale;
    const float* P = projection(i);
    if (!P) return;
    FloatLane rows[3];
    for (int k = 0; k < 3; ++k) rows[k] = load_floats(T + k * kFloatLanes);
    for (int k = 0; k < 3; ++k)
      store_floats(T + k * kFloatLanes,
                   P[3 * k] * rows[0] + P[3 * k + 1] * rows[1] + P[3 * k + 2] * rows[2]);
  });
}

template <int K>
void RigidMultigrid::make_prolongation(const BlockMatrix& matrix, int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  const RigidTransfer& t = hierarchy_->transfer(l);
  const Pattern& p = t.prolongation;
  float* out = level.prolongation.resize(p.column.size() * K * kFloatLanes);
  const Blocks<K> blocks = blocks_of<K>(matrix, finest_, level);
  const float omega =
      level.largest > 0.0F ? static_cast<float>(kProlongationDamping) / level.largest : 0.0F;
  for_rows_with_places(
      p.num_rows(), task_rows(l), t.aggregates.count, pool, [&](Index i, Places& place) {
        for (Index e = p.begin(i); e < p.end(i); ++e) {
          place[p[e]] = e;
          std::fill(out + e * K * kFloatLanes, out + (e + 1) * K * kFloatLanes, 0.0F);
        }
        for (Index e = pattern(l).begin(i); e < pattern(l).end(i); ++e) {
          const Index j = pattern(l)[e];
          const float* T = level.tentative.data() + j * K * kFloatLanes;
          float* to = out + place[t.aggregates.of_node[at(j)]] * K * kFloatLanes;
          float a[K][Blocks<K>::kPadded];
          blocks.read(e, i, j, a);
          FloatLane rows[K];
          for (int m = 0; m < K; ++m) rows[m] = load_floats(T + m * kFloatLanes);
          for (int k = 0; k < K; ++k) {
            FloatLane total = load_floats(to + k * kFloatLanes);
            for (int m = 0; m < K; ++m) total += a[m][k] * rows[m];
            store_floats(to + k * kFloatLanes, total);
          }
        }
        const float* inverse = level.inverse.data() + i * K * K;
        for (Index e = p.begin(i); e < p.end(i); ++e) {
          float* to = out + e * K * kFloatLanes;
          FloatLane rows[K];
          for (int m = 0; m < K; ++m) rows[m] = load_floats(to + m * kFloatLanes);
          for (int k = 0; k < K; ++k) {
            FloatLane total = {};
            for (int m = 0; m < K; ++m) total -= (omega * inverse[k * K + m]) * rows[m];
            store_floats(to + k * kFloatLanes, total);
          }
        }
        float* own = out + place[t.aggregates.of_node[at(i)]] * K * kFloatLanes;
        const float* T = level.tentative.data() + i * K * kFloatLanes;
        for (int k = 0; k < K * kFloatLanes; ++k) own[k] += T[k];
      });
}

template <int K>
void RigidMultigrid::make_product(const BlockMatrix& matrix, int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  const RigidTransfer& t = hierarchy_->transfer(l);
  const Pattern& p = t.prolongation;
  const Pattern& ap = t.product;
  float* out = level.product.resize(ap.column.size() * K * kFloatLanes);
  const Blocks<K> blocks = blocks_of<K>(matrix, finest_, level);
  for_rows_with_places(
      ap.num_rows(), task_rows(l), t.aggregates.count, pool, [&](Index i, Places& place) {
        for (Index e = ap.begin(i); e < ap.end(i); ++e) place[ap[e]] = e;
        std::fill(out + ap.begin(i) * K * kFloatLanes, out + ap.end(i) * K * kFloatLanes, 0.0F);
        for (Index e = pattern(l).begin(i); e < pattern(l).end(i); ++e) {
          const Index j = pattern(l)[e];
          float a[K][Blocks<K>::kPadded];
          blocks.read(e, i, j, a);
          for (Index q = p.begin(j); q < p.end(j); ++q) {
            const float* P = level.prolongation.data() + q * K * kFloatLanes;
            float* to = out + place[p[q]] * K * kFloatLanes;
            FloatLane rows[K];
            for (int m = 0; m < K; ++m) rows[m] = load_floats(P + m * kFloatLanes);
            for (int k = 0; k < K; ++k) {
              FloatLane total = load_floats(to + k * kFloatLanes);
              for (int m = 0; m < K; ++m) total += a[m][k] * rows[m];
              store_floats(to + k * kFloatLanes, total);
            }
          }
        }
      });
}

/// Blocks (I, J) with J >= I of P^T A P.
template <int K>
void RigidMultigrid::make_coarse(int l, ThreadPool& pool) {
  const Level& level = levels_[at(l)];
  Level& coarse = levels_[at(l + 1)];
  const RigidTransfer& t = hierarchy_->transfer(l);
  const Pattern& matrix = pattern(l + 1);
  float* out = coarse.matrix.resize(matrix.column.size() * kFloatBlock);
  for_rows_with_places(
      matrix.num_rows(), task_rows(l + 1), matrix.num_rows(), pool, [&](Index I, Places& place) {
        for (Index e = matrix.begin(I); e < matrix.end(I); ++e) place[matrix[e]] = e;
        std::fill(out + matrix.begin(I) * kFloatBlock, out + matrix.end(I) * kFloatBlock, 0.0F);
        for (Index r = t.restriction.begin(I); r < t.restriction.end(I); ++r) {
          const Index i = t.restriction[r];
          const float* P = level.prolongation.data() + t.restriction_entry[at(r)] * K * kFloatLanes;
          FloatLane rows[K];
          for (int m = 0; m < K; ++m) rows[m] = load_floats(P + m * kFloatLanes);
          for (Index e = t.product.begin(i); e < t.product.end(i); ++e) {
            const Index J = t.product[e];
            if (J < I) continue;
            const float* AP = level.product.data() + e * K * kFloatLanes;
            float* to = out + place[J] * kFloatBlock;
            for (int c = 0; c < 6; ++c) {
              FloatLane total = load_floats(to + c * kFloatLanes);
              for (int m = 0; m < K; ++m) total += AP[m * kFloatLanes + c] * rows[m];
              store_floats(to + c * kFloatLanes, total);
            }
          }
        }
      });
}

void RigidMultigrid::mirror_coarse(int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  const Pattern& matrix = pattern(l);
  float* values = level.matrix.data();
  for_rows(matrix.num_rows(), task_rows(l), pool, [&](Index I) {
    for (Index e = matrix.begin(I); e < matrix.end(I); ++e) {
      const Index J = matrix[e];
      if (J >= I) break;
      const auto first = matrix.column.begin() + matrix.begin(J);
      const auto last = matrix.column.begin() + matrix.end(J);
      const Index other =
          std::lower_bound(first, last, static_cast<std::int32_t>(I)) - matrix.column.begin();
      for (int c = 0; c < 6; ++c)
        for (int k = 0; k < 6; ++k)
          values[e * kFloatBlock + c * kFloatLanes + k] =
              values[other * kFloatBlock + k * kFloatLanes + c];
    }
    float* diagonal = values + hierarchy_->diagonal(l, I) * kFloatBlock;
    float largest = 0.0F;
    for (int k = 0; k < 6; ++k)
      largest = std::max(largest, std::abs(diagonal[k * kFloatLanes + k]));
    if (!(largest > 0.0F)) largest = 1.0F / kLeastDiagonal;  // all of its nodes are fixed
    for (int k = 0; k < 6; ++k) diagonal[k * kFloatLanes + k] += kLeastDiagonal * largest;
  });
}

void RigidMultigrid::factorize_coarsest(ThreadPool& pool) {
  const int l = hierarchy_->num_levels() - 1;
  const float* values = levels_[at(l)].matrix.data();
  const Pattern& matrix = pattern(l);
  coarse_blocks_.resize(matrix.column.size() * 36);
  for (std::size_t e = 0; e < matrix.column.size(); ++e)
    for (std::size_t k = 0; k < 6; ++k)
      for (std::size_t m = 0; m < 6; ++m)
        coarse_blocks_[36 * e + 6 * k + m] =
            static_cast<double>(values[e * kFloatBlock + m * kFloatLanes + k]);
  // Float32 leaves a softest mode that is 1e-6 of the stiffest undecided, and a tangent at a saddle
  // has negative ones: a share of the diagonal makes it definite, the least that does.
  for (double share = 1e-3;; share *= 10.0) {
    try {
      coarsest_.refactor(coarse_blocks_.data(), pool);
      return;
    } catch (const NotPositiveDefinite&) {
      if (share > 1e6) throw;
    }
    for (Index I = 0; I < matrix.num_rows(); ++I) {
      double* block = coarse_blocks_.data() + 36 * hierarchy_->diagonal(l, I);
      double largest = 0.0;
      for (int k = 0; k < 6; ++k) largest = std::max(largest, std::abs(block[7 * k]));
      for (int k = 0; k < 6; ++k) block[7 * k] += share * largest;
    }
  }
}

}  // namespace diffsim
