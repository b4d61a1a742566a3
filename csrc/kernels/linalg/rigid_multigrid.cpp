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

template <typename F>
void for_rows(Index num_rows, Index task_rows, ThreadPool& pool, F&& f) {
  if (num_rows > 3 * task_rows) return pool.run_ranges(num_rows, task_rows, f);
  for (Index begin = 0; begin < num_rows; begin += task_rows)  // waking threads would cost more
    f(begin, std::min(num_rows, begin + task_rows));
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
    for (std::vector<float>* v :
         {&level.x, &level.b, &level.residual, &level.step, &level.next, &level.image})
      v->assign(size, 0.0F);
  }
}

void RigidMultigrid::multiply_rows(int l, const float* x, float* y, Index begin, Index end) const {
  const Pattern& p = pattern(l);
  if (l > 0) return multiply_blocks(p, levels_[at(l)].matrix.data(), x, y, begin, end);
  for (Index i = begin; i < end; ++i)
    short_block3_row(finest_.blocks.data(), finest_.diagonal.data(), p.column.data(), i, p.begin(i),
                     p.end(i), x, y + 3 * i);
}

void RigidMultigrid::scale_rows(int l, const float* r, float* z, Index begin, Index end) const {
  const float* inverse = levels_[at(l)].inverse.data();
  for (Index i = begin; i < end; ++i) {
    if (l == 0)
      scale_block<3>(inverse + 9 * i, r + 3 * i, z + 3 * i);
    else
      scale_block<6>(inverse + 36 * i, r + kFloatLanes * i, z + kFloatLanes * i);
  }
}

/// One pass over the rows for each polynomial: what a row needs of others is the last step alone,
/// so the next one is written beside it.
void RigidMultigrid::smooth(int l, bool from_zero, bool keep_residual, ThreadPool& pool) {
  Level& v = levels_[at(l)];
  const Index width = stride(l), rows = pattern(l).num_rows();
  const float high = v.largest, low = kSmoothedRange * high;
  const float center = 0.5F * (high + low), radius = 0.5F * (high - low);
  const float sigma = center / radius;
  float rho = 1.0F / sigma;
  float *x = v.x.data(), *residual = v.residual.data(), *image = v.image.data();
  float *step = v.step.data(), *next = v.next.data();
  const auto subtract = [&](const float* from, Index first, Index last) {
    for (Index i = first; i < last; ++i) residual[i] = from[i] - image[i];
  };
  for_rows(rows, task_rows(l), pool, [&](Index begin, Index end) {
    const Index first = width * begin, last = width * end;
    if (from_zero) {
      std::copy(v.b.data() + first, v.b.data() + last, residual + first);
    } else {
      multiply_rows(l, x, image, begin, end);
      subtract(v.b.data(), first, last);
    }
    scale_rows(l, residual, image, begin, end);
    for (Index i = first; i < last; ++i) step[i] = image[i] / center;
  });
  bool at_zero = from_zero;  // x is to be overwritten
  const auto advance = [&](Index first, Index last) {
    for (Index i = first; i < last; ++i) x[i] = (at_zero ? 0.0F : x[i]) + step[i];
  };
  for (int k = 1; k < kDegree; ++k) {
    const float factor = 1.0F / (2.0F * sigma - rho);
    const float keep = factor * rho, add = 2.0F * factor / radius;
    rho = factor;
    for_rows(rows, task_rows(l), pool, [&](Index begin, Index end) {
      const Index first = width * begin, last = width * end;
      advance(first, last);
      multiply_rows(l, step, image, begin, end);
      subtract(residual, first, last);
      scale_rows(l, residual, image, begin, end);
      for (Index i = first; i < last; ++i) next[i] = keep * step[i] + add * image[i];
    });
    at_zero = false;
    std::swap(step, next);
  }
  for_rows(rows, task_rows(l), pool, [&](Index begin, Index end) {
    const Index first = width * begin, last = width * end;
    advance(first, last);
    if (!keep_residual) return;
    multiply_rows(l, step, image, begin, end);
    subtract(residual, first, last);
  });
}

void RigidMultigrid::restrict_residual(int l, ThreadPool& pool) {
  const RigidTransfer& t = hierarchy_->transfer(l);
  const Level& fine = levels_[at(l)];
  Level& coarse = levels_[at(l + 1)];
  const int K = l == 0 ? 3 : 6, from = stride(l);
  for_rows(t.aggregates.count, task_rows(l + 1), pool, [&](Index begin, Index end) {
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
  for_rows(p.num_rows(), task_rows(l), pool, [&](Index begin, Index end) {
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
  const Index rows = pattern(0).num_rows();
  largest_of_.assign(at((rows + task_rows(0) - 1) / task_rows(0)), 0.0);
  for_rows(rows, task_rows(0), pool, [&](Index begin, Index end) {
    double largest = 0.0;
    for (Index i = 3 * begin; i < 3 * end; ++i) largest = std::max(largest, std::abs(r[at(i)]));
    largest_of_[at(begin / task_rows(0))] = largest;
  });
  double largest = 0.0;
  for (double v : largest_of_) largest = std::max(largest, v);
  z.resize(r.size());
  if (!(largest > 0.0) || !std::isfinite(largest)) {
    z = r;
    return;
  }
  const double unit = 1.0 / largest;  // float32 has no room for forces of any size
  const float* scale = finest_.scale.data();
  for_rows(rows, task_rows(0), pool, [&](Index begin, Index end) {
    for (Index i = begin; i < end; ++i) {
      const float own = 1.0F / scale[i];
      for (std::size_t k = at(3 * i); k < at(3 * i + 3); ++k)
        fine.b[k] = fixed_[k] ? 0.0F : own * static_cast<float>(unit * r[k]);
    }
  });
  cycle(0, pool);
  for_rows(rows, task_rows(0), pool, [&](Index begin, Index end) {
    for (Index i = begin; i < end; ++i) {
      const double own = largest / static_cast<double>(scale[i]);
      for (std::size_t k = at(3 * i); k < at(3 * i + 3); ++k)
        z[k] = own * static_cast<double>(fine.x[k]);
    }
  });
}

std::int64_t RigidMultigrid::bytes() const {
  const auto finest = static_cast<Index>(pattern(0).column.size()) * kBlock3;
  std::int64_t floats = pattern(0).num_rows() * (2 * kBlock3 + 1);
  for (int l = 0; l < hierarchy_->num_levels(); ++l) {
    if (l > 0) floats += static_cast<Index>(pattern(l).column.size()) * kFloatBlock;
    if (l + 1 == hierarchy_->num_levels()) break;
    const RigidTransfer& t = hierarchy_->transfer(l);
    floats += static_cast<Index>(t.prolongation.column.size() + t.product.column.size()) *
              (l == 0 ? 3 : 6) * kFloatLanes;
  }
  return 4 * floats + 2 * finest;
}

}  // namespace diffsim
