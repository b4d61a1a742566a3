#include "kernels/soft/damping.h"
#include "kernels/soft/element_matrix.h"
#include "kernels/soft/element_stage.h"
#include "kernels/soft/hourglass.h"
#include "kernels/soft/small_tangent.h"

namespace diffsim {
namespace {

using namespace elements;

// Tasks whose element matrices are held at once while the tangent is assembled: on few threads
// kLeastTasks of the kind, less than a core's own cache (hexahedra: 384 KiB), on many some for
// each, so that their elements have rows for all.
constexpr Index kTasksPerThread = 4;
// How many elements ahead of its use the place of an element's matrix is asked for: in the order of
// elements it comes from memory in pieces that no stream of the hardware's follows.
constexpr Index kElementsAhead = 2;
// Entries of the matrix that a task sets to zero.
constexpr Index kZeros = 1 << 16;

/// How the matrices of a group are made and read.
struct HexMatrices {
  static constexpr Index kSize = kHexMatrixSize, kElements = 1, kLeastTasks = 8;
  static void read(const double* matrix, int, int a, int b, double out[9]) {
    element_block(matrix, a, b, a, b, out);
  }
  static void read(const double* matrix, int, const SmallPlace& p, double out[9]) {
    element_block(matrix, p.row, p.column, p.first, p.second, out);
  }
};
template <int kNodes>
struct LaneMatrices {
  static constexpr Index kSize = lane_matrix_size(kNodes), kElements = kLanes;
  static constexpr Index kLeastTasks = kNodes == 4 ? 8 : 1;

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
using MatricesOf = std::conditional_t<Group::kInLanes, LaneMatrices<Group::kNodes>, HexMatrices>;

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

/// Assembles one block by a SolidFill or a FiberFill.
template <typename Group, typename Fill>
void assemble(const Fill& fill, const ElementBlock& block, const std::vector<std::int32_t>& slots,
              double* values, ElasticityScratch& scratch, ThreadPool& pool) {
  using Matrices = MatricesOf<Group>;
  const Index chunk = kTask * std::max(Matrices::kLeastTasks, kTasksPerThread * pool.size());
  scratch.blocks.resize(at(std::min(chunk, block.num_groups) * Matrices::kSize));
  for (Index first = 0; first < block.num_groups; first += chunk) {
    const Index last = std::min(block.num_groups, first + chunk);
    pool.run(num_tasks(last - first, kTask), [&](Index task) {
      const Index begin = first + task * kTask;
      for_stages(begin, std::min(last, begin + kTask), [&](Index g, int count) {
        fill.matrices(g, count, scratch.blocks.data() + (g - first) * Matrices::kSize);
      });
    });
    scatter_matrices<Group>(fill.model, block, slots, scratch.blocks.data(), first, last, values,
                            pool);
  }
}

/// Whether a group of fibers lies in one group of the solid, to whose tangent its own is added.
template <typename Group>
constexpr bool kFibersInSolid = !Group::kInLanes;

/// Element matrices of groups of fibers, by their tangents dP/dF.
template <typename Group>
struct FiberFill {
  const SoftModel& model;
  const SoftParameters& p;
  const double* x;
  bool clamp;

  void matrices(Index first, int count, double* out) const {
    for (int n = 0; n < count; ++n, out += MatricesOf<Group>::kSize) {
      GroupTangent tangent{};
      add(first + n, tangent);
      element_matrix(Group::shape(model.fiber, first + n), tangent, out);
    }
  }

  /// Adds the tangent of a group of fibers.
  void add(Index g, GroupTangent& tangent) const {
    Native F[kParts][9];
    deformation_gradient<Group>(model.fiber, g, x, F);
    for (int part = 0; part < kParts; ++part) {
      const FiberPart f = fiber_part<Group>(model, p, g, part, F[part]);
      add_fiber_tangent(f.state, f.pull, clamp, tangent.H[part]);
    }
  }
};

/// The same of the solid, with the fibers that lie in it.
template <typename Group, typename M>
struct SolidFill {
  const SoftModel& model;
  const SoftParameters& p;
  const DampingFrames& frames;
  const double* x;
  bool clamp;
  KeptSamples<M> kept;
  FiberFill<Group> fibers;

  void matrices(Index first, int count, double* out) const {
    GroupTangent tangents[kStage];
    fill(first, count, tangents);
    for (int n = 0; n < count; ++n, out += MatricesOf<Group>::kSize) {
      if constexpr (!Group::kInLanes)
        element_matrix(model.solid.hex_nodes[at(model.solid.hex_class[at(first + n)])], tangents[n],
                       out);
      else if constexpr (Group::kNodes == 8)
        hourglass::element_matrix(model, p, frames, x, clamp, first + n, tangents[n], out);
      else
        element_matrix(Group::shape(model.solid, first + n), tangents[n], out);
    }
  }

  void fill(Index first, int count, GroupTangent* tangents) const {
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
      split_matrix(frames.solid[at(g)].Fn, part, Fn);
      add_viscous_tangent(Fn, Group::part_value(block, g, part, p.damp_mu),
                          Group::part_value(block, g, part, p.damp_lambda), H);
    }
    if constexpr (kFibersInSolid<Group>)
      for (int n = 0; n < count; ++n)
        for (Index k = model.fibers_start[at(first + n)]; k < model.fibers_start[at(first + n + 1)];
             ++k)
          fibers.add(model.fibers_of[at(k)], tangents[n]);
  }
};

/// Nodal forces of a group along z, by the tangents of its parts.
template <typename Group>
void scatter_product(const ElementBlock& block, Index g, const GroupTangent& tangent,
                     const double* z, double* vectors) {
  Native Z[kParts][9], P[kParts][9];
  deformation_gradient<Group>(block, g, z, Z);
  for (int part = 0; part < kParts; ++part) multiply_upper(tangent.H[part], Z[part], P[part]);
  scatter_stress(Group{}, Group::shape(block, g), P, vectors + g * block.vectors_size());
}

template <typename Group, typename M>
void solid_product(const SolidFill<Group, M>& fill, const double* z, double* vectors,
                   ThreadPool& pool) {
  for_stages(fill.model.solid, pool, [&](Index first, int count) {
    GroupTangent tangents[kStage];
    fill.fill(first, count, tangents);
    for (int n = 0; n < count; ++n)
      scatter_product<Group>(fill.model.solid, first + n, tangents[n], z, vectors);
  });
}

template <typename Group>
void fiber_product(const FiberFill<Group>& fill, const double* z, double* vectors,
                   ThreadPool& pool) {
  for_groups(fill.model.fiber, pool, [&](Index g) {
    GroupTangent tangent{};
    fill.add(g, tangent);
    scatter_product<Group>(fill.model.fiber, g, tangent, z, vectors);
  });
}

/// Adds the matrices of one block to that of a small body.
template <typename Group, typename Fill>
void add_to_small(const Fill& fill, const ElementBlock& block,
                  const std::vector<SmallPlace>& places, SmallCholesky& to) {
  using Matrices = MatricesOf<Group>;
  constexpr int kPairs = Group::kNodes * (Group::kNodes + 1) / 2;
  alignas(64) double all[kStage * Matrices::kSize];
  for_stages(0, block.num_groups, [&](Index first, int count) {
    fill.matrices(first, count, all);
    for (int k = 0; k < count; ++k) {
      const double* matrix = all + k * Matrices::kSize;
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

void add_small_tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                       const double* x, const SmallPlaces& places, ElasticityScratch& scratch,
                       SmallCholesky& to) {
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    using M = decltype(material);
    const FiberFill<Group> fibers{model, p, x, false};
    const KeptSamples<M> kept = kept_samples<M>(scratch, model, x);
    const SolidFill<Group, M> solid{model, p, frames, x, false, kept, fibers};
    add_to_small<Group>(solid, model.solid, places.solid, to);
    if constexpr (!kFibersInSolid<Group>)
      add_to_small<Group>(fibers, model.fiber, places.fiber, to);
  });
}

void tangent_product(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
                     const double* x, const double* z, double* out, ElasticityScratch& scratch,
                     ThreadPool& pool) {
  scratch.vectors.resize(at(model.vectors_size));
  double* solid_vectors = scratch.vectors.data();
  double* fiber_vectors = solid_vectors + model.fiber_vectors_start;
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    using M = decltype(material);
    const FiberFill<Group> fibers{model, p, x, false};
    const KeptSamples<M> kept = kept_samples<M>(scratch, model, x);
    const SolidFill<Group, M> solid{model, p, frames, x, false, kept, fibers};
    solid_product(solid, z, solid_vectors, pool);
    if constexpr (kFibersInSolid<Group>)
      std::fill(fiber_vectors, solid_vectors + model.vectors_size, 0.0);
    else
      fiber_product(fibers, z, fiber_vectors, pool);
  });
  hourglass::add_product(model, p, frames, x, z, solid_vectors, pool);
  gather_vectors(model, solid_vectors, out, pool);
}

void tangent(const SoftModel& model, const SoftParameters& p, const DampingFrames& frames,
             const double* x, bool clamp, double* values, ElasticityScratch& scratch,
             ThreadPool& pool) {
  pool.run_ranges(model.values_size(), kZeros,
                  [&](Index begin, Index end) { std::fill(values + begin, values + end, 0.0); });
  with_types(model, [&](auto group, auto material) {
    using Group = decltype(group);
    using M = decltype(material);
    const FiberFill<Group> fibers{model, p, x, clamp};
    const KeptSamples<M> kept = kept_samples<M>(scratch, model, x);
    const SolidFill<Group, M> solid{model, p, frames, x, clamp, kept, fibers};
    assemble<Group>(solid, model.solid, model.solid_slot, values, scratch, pool);
    if constexpr (!kFibersInSolid<Group>)
      assemble<Group>(fibers, model.fiber, model.fiber_slot, values, scratch, pool);
  });
}

}  // namespace diffsim
