// What the kernels over elements share: groups in tasks and stages, the values of a group's
// elements and fibers, and sums of what they leave at nodes.
#pragma once

#include <algorithm>
#include <array>
#include <cstring>
#include <new>

#include "kernels/parallel.h"
#include "kernels/soft/elasticity.h"
#include "kernels/soft/material.h"
#include "kernels/subscript.h"

namespace diffsim::elements {

using Index = std::int64_t;

/// Groups per task: small enough to share, large enough that a task costs microseconds.
constexpr Index kTask = 16;
/// Groups that go together through the stages of a kernel (deformation gradients, principal frames,
/// stresses, nodal forces): each stage is a loop of its own over registers, what passes between
/// them stays in the nearest cache, and singular values are taken of two registers at a time.
constexpr int kStage = 4;
constexpr int kStageParts = kStage * kParts;

inline Index num_tasks(Index count, Index size) { return (count + size - 1) / size; }

/// Calls f(group) for all groups, in tasks of kTask.
template <typename F>
void for_groups(const ElementBlock& block, ThreadPool& pool, F&& f) {
  pool.run(num_tasks(block.num_groups, kTask), [&](Index task) {
    const Index last = std::min(block.num_groups, (task + 1) * kTask);
    for (Index g = task * kTask; g < last; ++g) f(g);
  });
}

/// Calls f(first group, count) for groups [first, last), at most kStage at a time.
template <typename F>
void for_stages(Index first, Index last, F&& f) {
  for (Index g = first; g < last; g += kStage)
    f(g, static_cast<int>(std::min<Index>(kStage, last - g)));
}
template <typename F>
void for_stages(const ElementBlock& block, ThreadPool& pool, F&& f) {
  pool.run(num_tasks(block.num_groups, kTask), [&](Index task) {
    for_stages(task * kTask, std::min(block.num_groups, (task + 1) * kTask), f);
  });
}

/// Samples of the solid kept between evaluations, one after another by part; null where they are
/// not kept, and to be made where not ready but needed.
template <typename M>
struct KeptSamples {
  typename M::template Sample<Native>* data = nullptr;
  bool is_ready = false;
  bool is_needed = true;
};

template <typename M>
KeptSamples<M> kept_samples(ElasticityScratch& scratch, const SoftModel& model, const double* x) {
  using Sample = typename M::template Sample<Native>;
  constexpr std::size_t kMostDoubles = std::size_t{1} << 25;  // 256 MiB
  const std::size_t size = at(model.solid.num_groups) * kParts * sizeof(Sample) / sizeof(double);
  if (!M::kKeepsSamples || !scratch.keep_samples || size > kMostDoubles) return {};
  const std::size_t count = at(3 * model.num_nodes);
  std::vector<double>& kept_at = scratch.kept_at;
  const bool is_ready =
      kept_at.size() == count && std::memcmp(kept_at.data(), x, count * sizeof(double)) == 0;
  if (!is_ready) kept_at.assign(x, x + count);
  return {reinterpret_cast<Sample*>(scratch.samples.resize(size)), is_ready};
}

/// Deformation gradients and samples of the groups of a stage, part by part.
template <typename Group, typename M>
class Stage {
 public:
  using Sample = typename M::template Sample<Native>;
  Native F[kStageParts][9];  // made unless there are samples and no need

  Stage(const ElementBlock& block, Index first, int count, const double* x,
        const KeptSamples<M>& kept = {}, bool needs_F = true) {
    if (kept.data) samples_ = kept.data + first * kParts;
    if (needs_F || !kept.is_ready)
      for (int n = 0; n < count; ++n)
        deformation_gradient<Group>(block, first + n, x, F + n * kParts);
    if (kept.is_ready || !kept.is_needed) return;
    make_samples<M, kStageParts>(F, count * kParts, samples_);
  }
  Stage(const Stage&) = delete;
  Stage& operator=(const Stage&) = delete;

  const Sample& sample(int part) const { return samples_[part]; }

 private:
  alignas(Sample) unsigned char own_[kStageParts * sizeof(Sample)];
  Sample* samples_ = reinterpret_cast<Sample*>(own_);
};

/// One part of nine Lanes in memory.
DIFFSIM_INLINE void split_matrix(const Lane A[9], int part, Native out[9]) {
  for (int i = 0; i < 9; ++i) out[i] = split(A[i], part);
}

DIFFSIM_INLINE Native contract(const Native A[9], const Native B[9]) {
  Native total = A[0] * B[0];
  for (int i = 1; i < 9; ++i) total += A[i] * B[i];
  return total;
}

/// out = H Z, H symmetric, (9, 9) by its entries on and above the diagonal.
DIFFSIM_INLINE void multiply_upper(const Native H[81], const Native Z[9], Native out[9]) {
  for (int a = 0; a < 9; ++a) {
    Native total{};
    for (int b = 0; b < 9; ++b) total += H[a <= b ? 9 * a + b : 9 * b + a] * Z[b];
    out[a] = total;
  }
}

/// Item k of a (count, size) array at a part of a group; zero for null.
template <typename Group>
Native direction_value(const ElementBlock& block, Index g, int part, const double* values,
                       Index k) {
  return values ? Group::part_value(block, g, part, values + k * block.num_elements) : Native{};
}

/// A value of each weight of a material.
template <typename M>
using Weights = std::array<Native, M::kWeights>;

/// The weights of a (num_weights, num_elements) array at a part of a group.
template <typename Group, typename M>
Weights<M> weights_at(const ElementBlock& solid, Index g, int part, const double* values) {
  Weights<M> w;
  for (int k = 0; k < M::kWeights; ++k)
    w[k] = Group::part_value(solid, g, part, values + k * solid.num_elements);
  return w;
}

/// Item k of a (count, num_weights, num_elements) array at a part of a group; zero for null.
template <typename Group, typename M>
Weights<M> weights_along(const SoftModel& model, Index g, int part, const double* values, Index k) {
  if (!values) return {};
  return weights_at<Group, M>(model.solid, g, part, values + k * model.weights_size());
}

/// Adds v[weight][part] to a (num_weights, num_elements) array.
template <typename Group, typename M>
void add_weights(const ElementBlock& solid, Index g, const Native (&v)[M::kWeights][kParts],
                 double* out) {
  for (int k = 0; k < M::kWeights; ++k)
    Group::add_element_value(solid, g, v[k], out + k * solid.num_elements);
}

/// State and pull of the fibers in one part of a group, at their deformation gradients.
struct FiberPart {
  FiberState<Native> state;
  FiberPull<Native> pull;
};
template <typename Group>
FiberPart fiber_part(const SoftModel& model, const SoftParameters& p, Index g, int part,
                     const Native F[9]) {
  Native m[3];
  for (int i = 0; i < 3; ++i)
    m[i] = Group::part_value(model.fiber, g, part, model.fiber_directions.data(), 3, i);
  const FiberState<Native> state = fiber_state(F, m);
  return {state, fiber_pull(state, Group::part_value(model.fiber, g, part, p.fiber_stiffness),
                            Group::part_value(model.fiber, g, part, p.activation),
                            Group::part_value(model.fiber, g, part, model.fiber_pull_only.data()))};
}

/// Sums the vectors buffer into nodes, in element order whatever the number of threads.
inline void gather_vectors(const SoftModel& model, const double* vectors, double* out,
                           ThreadPool& pool) {
  constexpr Index kNodesPerTask = 256;
  pool.run(num_tasks(model.num_nodes, kNodesPerTask), [&](Index task) {
    const Index stride = model.gather_stride;
    const Index last = std::min(model.num_nodes, (task + 1) * kNodesPerTask);
    for (Index i = task * kNodesPerTask; i < last; ++i) {
      double sum[3] = {0.0, 0.0, 0.0};
      for (Index k = model.gather_start[at(i)]; k < model.gather_start[at(i + 1)]; ++k) {
        const double* v = vectors + model.gather_offset[at(k)];
        for (int axis = 0; axis < 3; ++axis) sum[axis] += v[axis * stride];
      }
      for (int axis = 0; axis < 3; ++axis) out[3 * i + axis] = sum[axis];
    }
  });
}

/// Calls f(group, material) with the types of a model.
template <typename F>
decltype(auto) with_types(const SoftModel& model, F&& f) {
  return with_material(model.material, [&](auto material) -> decltype(auto) {
    return with_group(model.solid,
                      [&](auto group) -> decltype(auto) { return f(group, material); });
  });
}

}  // namespace diffsim::elements
