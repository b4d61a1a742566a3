#include "kernels/soft/damping.h"
#include "kernels/soft/element_matrix.h"
#include "kernels/soft/element_stage.h"
#include "kernels/soft/small_tangent.h"

namespace diffsim {
namespace {

using namespace elements;

// Tasks whose element matrices are held at once while the tangent is assembled: on few threads less
// than a core's own cache (hexahedra: 384 KiB), on many some for each, so that their elements have
// rows for all.
constexpr Index kLeastTasks = 8, kTasksPerThread = 4;
// How many elements ahead of its use the place of an element's matrix is asked for: in the order of
// elements it comes from memory in pieces that no stream of the hardware's follows.
constexpr Index kElementsAhead = 2;
// Entries of the matrix that a task sets to zero.
constexpr Index kZeros = 1 << 16;

/// How the matrices of a group are made and read.
struct HexMatrices {
  static constexpr Index kSize = kHexMatrixSize, kElements = 1;

  static void make(const ElementBlock& block, Index g, const GroupTangent& tangent, double* out) {
    element_matrix(block.hex_nodes[at(block.hex_class[at(g)])], tangent, out);
  }
  static void read(const double* matrix, int, int a, int b, double out[9]) {
    element_block(matrix, a, b, a, b, out);
  }
  static void read(const double* matrix, int, const SmallPlace& p, double out[9]) {
    element_block(matrix, p.row, p.column, p.first, p.second, out);
  }
};
struct TetMatrices {
  static constexpr Index kSize = kTetMatrixSize, kElements = kLanes;

  static void make(const ElementBlock& block, Index g, const GroupTangent& tangent, double* out) {
    element_matrix(TetGroup::shape(block, g), tangent, out);
  }
  static void read(const double* matrix, int lane, int a, int b, double out[9]) {
    const double* from = matrix + 9 * (b * (b + 1) / 2 + a) * kLanes + lane;
    for (int i = 0; i < 9; ++i) out[i] = from[i * kLanes];
  }
  static void read(const double* matrix, int lane, const SmallPlace& p, double out[9]) {
    double block[9];
    read(matrix, lane, p.first, p.second, block);
    const bool transposed = p.row != p.first;
    for (int i = 0; i < 9; ++i) out[i] = block[transposed ? 3 * (i % 3) + i / 3 : i];
  }
};
template <typename Group>
using MatricesOf = std::conditional_t<Group::kNodes == 8, HexMatrices, TetMatrices>;

DIFFSIM_INLINE void add_block(double* to, const double block[9]) {
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) to[block3_place(i, k)] += block[3 * i + k];
}
DIFFSIM_INLINE void add_transposed(double* to, const double block[9]) {
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) to[block3_place(i, k)] += block[3 * k + i];
}

/// Asks for the blocks of an element's nodes in some rows, not in those of another thread.
/// @param slot  (n, n) of the element
template <int n>
DIFFSIM_INLINE void prefetch_blocks(const SoftModel& model, const Index* node,
                                    const std::int32_t* slot, const double* values, Index row_begin,
                                    Index row_end) {
  for (int a = 0; a < n; ++a) {
    if (node[a] < row_begin || node[a] >= row_end) continue;
    for (int b = 0; b < n; ++b)
      __builtin_prefetch(values + kBlock3 * (model.row_start[at(node[a])] + slot[n * a + b]), 1);
  }
}

/// Adds the element matrices of groups [first, last) to rows. The rows that these have are dealt to
/// the threads: every entry receives its contributions in element order.
template <typename Group>
void scatter_matrices(const SoftModel& model, const ElementBlock& block,
                      const std::vector<std::int32_t>& slots, const double* matrices, Index first,
                      Index last, double* values, ThreadPool& pool) {
  using Matrices = MatricesOf<Group>;
  constexpr int n = Group::kNodes;
  const Index element_end = std::min(block.num_elements, last * Matrices::kElements);
  const Index element_begin = first * Matrices::kElements;
  const Index* nodes = block.nodes.data();
  Index lowest = nodes[n * element_begin], highest = lowest;
  for (Index k = n * element_begin; k < n * element_end; ++k) {
    lowest = std::min(lowest, nodes[k]);
    highest = std::max(highest, nodes[k]);
  }
  const Index num_rows = highest - lowest + 1;
  const int parts = pool.size();
  pool.run(parts, [&](Index part) {
    const Index row_begin = lowest + num_rows * part / parts;
    const Index row_end = lowest + num_rows * (part + 1) / parts;
    for (Index e = element_begin; e < element_end; ++e) {
      const double* matrix = matrices + (e / Matrices::kElements - first) * Matrices::kSize;
      const int lane = static_cast<int>(e % Matrices::kElements);
      const Index* node = nodes + e * n;
      const std::int32_t* slot = slots.data() + e * n * n;
      if (e + kElementsAhead < element_end)
        prefetch_blocks<n>(model, node + n * kElementsAhead, slot + n * n * kElementsAhead, values,
                           row_begin, row_end);
      double* row[n];  // null where another thread's
      for (int a = 0; a < n; ++a) {
        const bool mine = node[a] >= row_begin && node[a] < row_end;
        row[a] = mine ? values + kBlock3 * model.row_start[at(node[a])] : nullptr;
      }
      for (int b = 0; b < n; ++b)
        for (int a = 0; a <= b; ++a) {
          if (!row[a] && !row[b]) continue;
          double k[9];
          Matrices::read(matrix, lane, a, b, k);
          if (row[a]) add_block(row[a] + kBlock3 * slot[a * n + b], k);
          if (a != b && row[b]) add_transposed(row[b] + kBlock3 * slot[b * n + a], k);
        }
    }
  });
}

/// Assembles one block; fill(first, count, tangents) writes the tangents of a stage's groups.
template <typename Group, typename Fill>
void assemble(const SoftModel& model, const ElementBlock& block,
              const std::vector<std::int32_t>& slots, Fill&& fill, double* values,
              ElasticityScratch& scratch, ThreadPool& pool) {
  using Matrices = MatricesOf<Group>;
  const Index chunk = kTask * std::max(kLeastTasks, kTasksPerThread * pool.size());
  scratch.blocks.resize(at(std::min(chunk, block.num_groups) * Matrices::kSize));
  for (Index first = 0; first < block.num_groups; first += chunk) {
    const Index last = std::min(block.num_groups, first + chunk);
    pool.run(num_tasks(last - first, kTask), [&](Index task) {
      const Index begin = first + task * kTask;
      for_stages(begin, std::min(last, begin + kTask), [&](Index g, int count) {
        GroupTangent tangents[kStage];
        fill(g, count, tangents);
        for (int n = 0; n < count; ++n)
          Matrices::make(block, g + n, tangents[n],
                         scratch.blocks.data() + (g + n - first) * Matrices::kSize);
      });
    });
    scatter_matrices<Group>(model, block, slots, scratch.blocks.data(), first, last, values, pool);
  }
}

/// Whether a group of fibers lies in one group of the solid, to whose tangent its own is added.
template <typename Group>
constexpr bool kFibersInSolid = Group::kNodes == 8;

/// Fills in the tangents dP/dF of a stage's groups, of the solid and of the fibers.
template <typename Group, typename M>
struct TangentFill {
  const SoftModel& model;
  const SoftParameters& p;
  const std::vector<DampingFrame>& frames;
  const double* x;
  bool clamp;
  KeptSamples<M> kept;

  void solid(Index first, int count, GroupTangent* tangents) const {
    const ElementBlock& block = model.solid;
    const Stage<Group, M> stage(block, first, count, x, kept, false);
    for (int r = 0; r < count * kParts; ++r) {
      const Index g = first + r / kParts;
      const int part = r % kParts;
      Native* H = tangents[r / kParts].H[part];
      const auto& sample = stage.sample(r);
      const auto w = weights_at<Group, M>(block, g, part, p.weights);
      stiffness<M>(sample, w.data(), clamp, H);
      if (!p.damp_mu) continue;
      Native Fn[9];
      split_matrix(frames[at(g)].Fn, part, Fn);
      add_viscous_tangent(Fn, Group::part_value(block, g, part, p.damp_mu),
                          Group::part_value(block, g, part, p.damp_lambda), H);
    }
    if constexpr (kFibersInSolid<Group>)
      for (int n = 0; n < count; ++n)
        for (Index k = model.fibers_start[at(first + n)]; k < model.fibers_start[at(first + n + 1)];
             ++k)
          fiber(model.fibers_of[at(k)], tangents[n]);
  }

  /// Adds the tangent of a group of fibers.
  void fiber(Index g, GroupTangent& tangent) const {
    Native F[kParts][9];
    deformation_gradient<Group>(model.fiber, g, x, F);
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      add_fiber_tangent(f.state, f.pull, clamp, tangent.H[part]);
    }
  }

  void fibers(Index first, int count, GroupTangent* tangents) const {
    std::fill(tangents, tangents + count, GroupTangent{});
    for (int n = 0; n < count; ++n) fiber(first + n, tangents[n]);
  }
};

template <typename Group, typename M>
void tangent_of(const SoftModel& model, const SoftParameters& p,
                const std::vector<DampingFrame>& frames, const double* x, bool clamp,
                double* values, ElasticityScratch& scratch, ThreadPool& pool) {
  const TangentFill<Group, M> fill{model, p, frames, x, clamp, kept_samples<M>(scratch, model, x)};
  const auto solid = [&](Index g, int count, GroupTangent* out) { fill.solid(g, count, out); };
  pool.run_ranges(model.values_size(), kZeros,
                  [&](Index begin, Index end) { std::fill(values + begin, values + end, 0.0); });
  assemble<Group>(model, model.solid, model.solid_slot, solid, values, scratch, pool);
  if constexpr (kFibersInSolid<Group>) return;
  const auto fibers = [&](Index g, int count, GroupTangent* out) { fill.fibers(g, count, out); };
  assemble<Group>(model, model.fiber, model.fiber_slot, fibers, values, scratch, pool);
}

/// Nodal forces of a group along z, by the tangents of its parts.
template <typename Group>
void scatter_product(const ElementBlock& block, Index g, const GroupTangent& tangent,
                     const double* z, double* vectors) {
  Native Z[kParts][9], P[kParts][9];
  deformation_gradient<Group>(block, g, z, Z);
  for (int part = 0; part < kParts; ++part) {
    const Native* H = tangent.H[part];
    for (int a = 0; a < 9; ++a) {
      Native total{};
      for (int b = 0; b < 9; ++b) total += H[a <= b ? 9 * a + b : 9 * b + a] * Z[part][b];
      P[part][a] = total;
    }
  }
  scatter_stress(Group::shape(block, g), P, vectors + g * block.vectors_size());
}

template <typename Group, typename M>
void tangent_product_of(const SoftModel& model, const SoftParameters& p,
                        const std::vector<DampingFrame>& frames, const double* x, const double* z,
                        ElasticityScratch& scratch, ThreadPool& pool) {
  const TangentFill<Group, M> fill{model, p, frames, x, false, kept_samples<M>(scratch, model, x)};
  double* fibers = scratch.vectors.data() + model.fiber_vectors_start;
  for_stages(model.solid, pool, [&](Index first, int count) {
    GroupTangent tangents[kStage];
    fill.solid(first, count, tangents);
    for (int n = 0; n < count; ++n)
      scatter_product<Group>(model.solid, first + n, tangents[n], z, scratch.vectors.data());
  });
  if constexpr (kFibersInSolid<Group>) {
    std::fill(fibers, scratch.vectors.data() + model.vectors_size, 0.0);
  } else {
    for_groups(model.fiber, pool, [&](Index g) {
      GroupTangent tangent;
      fill.fibers(g, 1, &tangent);
      scatter_product<Group>(model.fiber, g, tangent, z, fibers);
    });
  }
}

/// Adds the matrices of one block to that of a small body; fill as in assemble().
template <typename Group, typename Fill>
void add_to_small(const ElementBlock& block, const std::vector<SmallPlace>& places, Fill&& fill,
                  SmallCholesky& to) {
  using Matrices = MatricesOf<Group>;
  constexpr int kPairs = Group::kNodes * (Group::kNodes + 1) / 2;
  alignas(64) double matrix[Matrices::kSize];
  for_stages(0, block.num_groups, [&](Index first, int count) {
    GroupTangent tangents[kStage];
    fill(first, count, tangents);
    for (int k = 0; k < count; ++k) {
      Matrices::make(block, first + k, tangents[k], matrix);
      const Index begin = (first + k) * Matrices::kElements;
      const Index end = std::min(block.num_elements, begin + Matrices::kElements);
      for (Index e = begin; e < end; ++e)
        for (Index n = e * kPairs; n < (e + 1) * kPairs; ++n) {
          const SmallPlace& place = places[at(n)];
          double entries[9];
          Matrices::read(matrix, static_cast<int>(e - begin), place, entries);
          to.add(place.block, entries);
        }
    }
  });
}

std::vector<SmallPlace> places_of(const SoftModel& model, const ElementBlock& block,
                                  const std::vector<std::int32_t>& slots,
                                  const SmallPattern& pattern) {
  const int n = block.nodes_per_element();
  std::vector<SmallPlace> places;
  for (Index e = 0; e < block.num_elements; ++e)
    for (int b = 0; b < n; ++b)
      for (int a = 0; a <= b; ++a) {
        const Index row = block.nodes[at(e * n + a)];
        const auto [index, transposed] =
            pattern.place(model.row_start[at(row)] + slots[at((e * n + a) * n + b)]);
        const auto first = static_cast<std::int8_t>(a), second = static_cast<std::int8_t>(b);
        places.push_back(
            {index, transposed ? second : first, transposed ? first : second, first, second});
      }
  return places;
}

}  // namespace

SmallPlaces small_places(const SoftModel& model, const SmallPattern& pattern) {
  return {places_of(model, model.solid, model.solid_slot, pattern),
          places_of(model, model.fiber, model.fiber_slot, pattern)};
}

void add_small_tangent(const SoftModel& model, const SoftParameters& p,
                       const std::vector<DampingFrame>& frames, const double* x,
                       const SmallPlaces& places, ElasticityScratch& scratch, SmallCholesky& to) {
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    using M = decltype(material);
    const TangentFill<Group, M> fill{model, p,     frames,
                                     x,     false, kept_samples<M>(scratch, model, x)};
    add_to_small<Group>(
        model.solid, places.solid,
        [&](Index g, int count, GroupTangent* out) { fill.solid(g, count, out); }, to);
    if constexpr (!kFibersInSolid<Group>)
      add_to_small<Group>(
          model.fiber, places.fiber,
          [&](Index g, int count, GroupTangent* out) { fill.fibers(g, count, out); }, to);
  });
}

void tangent_product(const SoftModel& model, const SoftParameters& p,
                     const std::vector<DampingFrame>& frames, const double* x, const double* z,
                     double* out, ElasticityScratch& scratch, ThreadPool& pool) {
  scratch.vectors.resize(at(model.vectors_size));
  with_types(model, [&](auto group, auto material) {
    tangent_product_of<decltype(group), decltype(material)>(model, p, frames, x, z, scratch, pool);
  });
  gather_vectors(model, scratch.vectors.data(), out, pool);
}

void tangent(const SoftModel& model, const SoftParameters& p,
             const std::vector<DampingFrame>& frames, const double* x, bool clamp, double* values,
             ElasticityScratch& scratch, ThreadPool& pool) {
  with_types(model, [&](auto group, auto material) {
    tangent_of<decltype(group), decltype(material)>(model, p, frames, x, clamp, values, scratch,
                                                    pool);
  });
}

}  // namespace diffsim
