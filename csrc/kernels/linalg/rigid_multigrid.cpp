#include "kernels/linalg/rigid_multigrid.h"

#include <cmath>

#include "kernels/linalg/block3.h"
#include "kernels/linalg/float_lanes.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

// Chebyshev polynomials of this degree damp the upper part of the spectrum, down to this of its
// largest eigenvalue.
constexpr int kDegree = 2;
constexpr float kSmoothedRange = 1.0F / 10.0F;
constexpr Index kRowsPerTask = 256;

template <typename F>
void for_rows(Index num_rows, ThreadPool& pool, F&& f) {
  const Index tasks = (num_rows + kRowsPerTask - 1) / kRowsPerTask;
  const auto run = [&](Index task) {
    f(task * kRowsPerTask, std::min(num_rows, (task + 1) * kRowsPerTask));
  };
  if (tasks < 4)  // waking threads would cost more than the work
    for (Index task = 0; task < tasks; ++task) run(task);
  else
    pool.run(tasks, run);
}

/// y = A x for rows of blocks (3, 3).
void multiply_fine(const Pattern& pattern, const float* values, const float* x, float* y,
                   Index begin, Index end) {
  for (Index i = begin; i < end; ++i)
    block3_row(values, pattern.column.data(), pattern.begin(i), pattern.end(i), x, y + 3 * i);
}

/// y = A x for rows of blocks (6, 8).
void multiply_blocks(const Pattern& pattern, const float* values, const float* x, float* y,
                     Index begin, Index end) {
  for (Index i = begin; i < end; ++i) {
    FloatLane even = {}, odd = {};
    for (Index e = pattern.begin(i); e < pattern.end(i); ++e) {
      const float* from = x + kFloatLanes * pattern[e];
      const float* block = values + e * kFloatBlock;
      for (int c = 0; c < 6; c += 2) {
        even += from[c] * load_floats(block + c * kFloatLanes);
        odd += from[c + 1] * load_floats(block + (c + 1) * kFloatLanes);
      }
    }
    store_floats(y + kFloatLanes * i, even + odd);
  }
}

template <int K>
void scale_block(const float* inverse, const float* r, float* z) {
  for (int k = 0; k < K; ++k) {
    float total = 0.0F;
    for (int m = 0; m < K; ++m) total += inverse[k * K + m] * r[m];
    z[k] = total;
  }
}

}  // namespace

RigidMultigrid::RigidMultigrid(std::shared_ptr<const RigidHierarchy> hierarchy)
    : hierarchy_(std::move(hierarchy)),
      levels_(at(hierarchy_->num_levels())),
      coarsest_(hierarchy_->coarsest()) {
  for (int l = 0; l < hierarchy_->num_levels(); ++l) {
    Level& level = levels_[at(l)];
    const std::size_t size = at(pattern(l).num_rows() * stride(l));
    for (std::vector<float>* v : {&level.x, &level.b, &level.residual, &level.step, &level.image})
      v->assign(size, 0.0F);
  }
}

void RigidMultigrid::multiply(int l, const float* x, float* y, ThreadPool& pool) const {
  const Level& level = levels_[at(l)];
  for_rows(pattern(l).num_rows(), pool, [&](Index begin, Index end) {
    if (l == 0)
      multiply_fine(pattern(0), level.matrix.data(), x, y, begin, end);
    else
      multiply_blocks(pattern(l), level.matrix.data(), x, y, begin, end);
  });
}

void RigidMultigrid::scale(int l, const float* r, float* z, ThreadPool& pool) const {
  const float* inverse = levels_[at(l)].inverse.data();
  for_rows(pattern(l).num_rows(), pool, [&](Index begin, Index end) {
    for (Index i = begin; i < end; ++i) {
      if (l == 0)
        scale_block<3>(inverse + 9 * i, r + 3 * i, z + 3 * i);
      else
        scale_block<6>(inverse + 36 * i, r + kFloatLanes * i, z + kFloatLanes * i);
    }
  });
}

void RigidMultigrid::smooth(int l, bool from_zero, bool keep_residual, ThreadPool& pool) {
  Level& v = levels_[at(l)];
  const std::size_t size = v.x.size();
  const float high = v.largest, low = kSmoothedRange * high;
  const float center = 0.5F * (high + low), radius = 0.5F * (high - low);
  const float sigma = center / radius;
  float rho = 1.0F / sigma;
  const auto subtract = [&](const std::vector<float>& from) {  // residual = from - A ...
    for (std::size_t i = 0; i < size; ++i) v.residual[i] = from[i] - v.image[i];
  };
  if (from_zero) {
    std::fill(v.x.begin(), v.x.end(), 0.0F);
    v.residual = v.b;
  } else {
    multiply(l, v.x.data(), v.image.data(), pool);
    subtract(v.b);
  }
  scale(l, v.residual.data(), v.image.data(), pool);
  for (std::size_t i = 0; i < size; ++i) {
    v.step[i] = v.image[i] / center;
    v.x[i] += v.step[i];
  }
  for (int k = 1; k < kDegree; ++k) {
    multiply(l, v.step.data(), v.image.data(), pool);
    subtract(v.residual);
    scale(l, v.residual.data(), v.image.data(), pool);
    const float next = 1.0F / (2.0F * sigma - rho);
    const float keep = next * rho, add = 2.0F * next / radius;
    rho = next;
    for (std::size_t i = 0; i < size; ++i) {
      v.step[i] = keep * v.step[i] + add * v.image[i];
      v.x[i] += v.step[i];
    }
  }
  if (!keep_residual) return;
  multiply(l, v.step.data(), v.image.data(), pool);
  subtract(v.residual);
}

void RigidMultigrid::restrict_residual(int l, ThreadPool& pool) {
  const RigidTransfer& t = hierarchy_->transfer(l);
  const Level& fine = levels_[at(l)];
  Level& coarse = levels_[at(l + 1)];
  const int K = l == 0 ? 3 : 6, from = stride(l);
  for_rows(t.aggregates.count, pool, [&](Index begin, Index end) {
    for (Index I = begin; I < end; ++I) {
      FloatLane total = {};
      for (Index e = t.restriction.begin(I); e < t.restriction.end(I); ++e) {
        const float* P = fine.prolongation.data() + t.restriction_entry[at(e)] * K * kFloatLanes;
        const float* r = fine.residual.data() + from * t.restriction[e];
        for (int k = 0; k < K; ++k) total += r[k] * load_floats(P + k * kFloatLanes);
      }
      store_floats(coarse.b.data() + kFloatLanes * I, total);
    }
  });
}

void RigidMultigrid::prolong(int l, ThreadPool& pool) {
  const Pattern& p = hierarchy_->transfer(l).prolongation;
  Level& fine = levels_[at(l)];
  const Level& coarse = levels_[at(l + 1)];
  const int K = l == 0 ? 3 : 6, to = stride(l);
  for_rows(p.num_rows(), pool, [&](Index begin, Index end) {
    for (Index i = begin; i < end; ++i) {
      FloatLane total[6] = {};
      for (Index e = p.begin(i); e < p.end(i); ++e) {
        const FloatLane c = load_floats(coarse.x.data() + kFloatLanes * p[e]);
        const float* P = fine.prolongation.data() + e * K * kFloatLanes;
        for (int k = 0; k < K; ++k) total[k] += c * load_floats(P + k * kFloatLanes);
      }
      for (int k = 0; k < K; ++k) fine.x[at(to * i + k)] += sum_floats(total[k]);
    }
  });
}

void RigidMultigrid::cycle(int l, ThreadPool& pool) {
  Level& level = levels_[at(l)];
  if (l + 1 == hierarchy_->num_levels()) {
    const std::size_t n = at(pattern(l).num_rows());
    coarse_rhs_.resize(6 * n);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t k = 0; k < 6; ++k)
        coarse_rhs_[6 * i + k] = static_cast<double>(level.b[kFloatLanes * i + k]);
    coarsest_.solve(coarse_rhs_.data(), coarse_rhs_.data(), 1, cholesky_, pool);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t k = 0; k < 6; ++k)
        level.x[kFloatLanes * i + k] = static_cast<float>(coarse_rhs_[6 * i + k]);
    return;
  }
  smooth(l, true, true, pool);
  restrict_residual(l, pool);
  cycle(l + 1, pool);
  prolong(l, pool);
  smooth(l, false, false, pool);
}

void RigidMultigrid::apply(const Vector& r, Vector& z, ThreadPool& pool) {
  Level& fine = levels_[0];
  double largest = 0.0;
  for (double v : r) largest = std::max(largest, std::abs(v));
  z.resize(r.size());
  if (!(largest > 0.0) || !std::isfinite(largest)) {
    z = r;
    return;
  }
  const double unit = 1.0 / largest;  // float32 has no room for forces of any size
  for (std::size_t i = 0; i < r.size(); ++i)
    fine.b[i] = fixed_[i] ? 0.0F : static_cast<float>(unit * r[i]);
  cycle(0, pool);
  for (std::size_t i = 0; i < r.size(); ++i) z[i] = largest * static_cast<double>(fine.x[i]);
}

std::int64_t RigidMultigrid::bytes() const {
  std::int64_t floats = 0;
  for (int l = 0; l < hierarchy_->num_levels(); ++l) {
    floats += static_cast<Index>(pattern(l).column.size()) * (l == 0 ? kBlock3 : kFloatBlock);
    if (l + 1 == hierarchy_->num_levels()) break;
    const RigidTransfer& t = hierarchy_->transfer(l);
    floats += static_cast<Index>(t.prolongation.column.size() + t.product.column.size()) *
              (l == 0 ? 3 : 6) * kFloatLanes;
  }
  return 4 * floats;
}

}  // namespace diffsim
