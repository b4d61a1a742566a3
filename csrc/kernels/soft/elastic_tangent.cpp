#include "kernels/soft/damping.h"
#include "kernels/soft/element_matrix.h"
#include "kernels/soft/element_stage.h"
#include "kernels/soft/lane_tangent.h"

namespace diffsim {
namespace {

using namespace elements;

// Groups whose element matrices are held at once while the tangent is assembled: less than a core's
// own cache (hexahedra: 384 KiB), and a task for each of eight threads.
constexpr Index kChunk = 8 * kTask;

/// How the matrices of a group are made and read.
struct HexMatrices {
  static constexpr Index kSize = kHexMatrixSize, kElements = 1;

  static void make(const ElementBlock& block, Index g, const GroupTangent& tangent, double* out) {
    element_matrix(block.hex_nodes[at(block.hex_class[at(g)])], tangent, out);
  }
  static void read(const double* matrix, int, int a, int b, double out[9]) {
    element_block(matrix, a, b, out);
  }
  /// Where entry (i, k) of the block of nodes a <= b lies.
  static Index place(int, int a, int b, int i, int k) {
    return 64 * kComponentPair[i][k] + (i <= k ? 8 * a + b : 8 * b + a);
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
  static Index place(int lane, int a, int b, int i, int k) {
    return (9 * (b * (b + 1) / 2 + a) + 3 * i + k) * kLanes + lane;
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

/// Adds the element matrices of groups [first, last) to rows, a fixed row range per thread: every
/// entry receives its contributions in element order.
template <typename Group>
void scatter_matrices(const SoftModel& model, const ElementBlock& block,
                      const std::vector<std::int32_t>& slots, const double* matrices, Index first,
                      Index last, double* values, ThreadPool& pool) {
  using Matrices = MatricesOf<Group>;
  constexpr int n = Group::kNodes;
  const Index element_end = std::min(block.num_elements, last * Matrices::kElements);
  const int parts = pool.size();
  pool.run(parts, [&](Index part) {
    const Index row_begin = model.num_nodes * part / parts;
    const Index row_end = model.num_nodes * (part + 1) / parts;
    for (Index e = first * Matrices::kElements; e < element_end; ++e) {
      const double* matrix = matrices + (e / Matrices::kElements - first) * Matrices::kSize;
      const int lane = static_cast<int>(e % Matrices::kElements);
      const Index* node = block.nodes.data() + e * n;
      const std::int32_t* slot = slots.data() + e * n * n;
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
  scratch.blocks.resize(at(std::min(kChunk, block.num_groups) * Matrices::kSize));
  for (Index first = 0; first < block.num_groups; first += kChunk) {
    const Index last = std::min(block.num_groups, first + kChunk);
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

/// Fills in the tangents dP/dF of a stage's groups, of the solid and of the fibers.
template <typename Group, typename M>
struct TangentFill {
  const SoftModel& model;
  const SoftParameters& p;
  const std::vector<DampingFrame>& frames;
  const double* x;
  bool clamp;
  KeptFrames kept;

  void solid(Index first, int count, GroupTangent* tangents) const {
    const ElementBlock& block = model.solid;
    const Stage<Group> stage(block, first, count, x, kept, false);
    for (int r = 0; r < count * kParts; ++r) {
      const Index g = first + r / kParts;
      const int part = r % kParts;
      Native* H = tangents[r / kParts].H[part];
      const typename M::template Sample<Native> sample(stage.frame(r));
      const auto w = weights_at<Group, M>(block, g, part, p.weights);
      PrincipalTangent<Native> core = M::tangent(sample, w.data());
      if (clamp) clamp_tangent(core);
      expand_tangent(stage.frame(r), core, H);
      if (!p.damp_mu) continue;
      Native Fn[9];
      split_matrix(frames[at(g)].Fn, part, Fn);
      add_viscous_tangent(Fn, Group::part_value(block, g, part, p.damp_mu),
                          Group::part_value(block, g, part, p.damp_lambda), H);
    }
  }

  void fiber(Index first, int count, GroupTangent* tangents) const {
    for (int n = 0; n < count; ++n) {
      Native F[kParts][9];
      deformation_gradient<Group>(model.fiber, first + n, x, F);
      for (int part = 0; part < kParts; ++part) {
        const FiberPart f = fiber_part<Group>(model, p, first + n, part, F[part]);
        fiber_tangent(f.state, f.pull, clamp, tangents[n].H[part]);
      }
    }
  }
};

template <typename Group, typename M>
void tangent_of(const SoftModel& model, const SoftParameters& p,
                const std::vector<DampingFrame>& frames, const double* x, bool clamp,
                double* values, ElasticityScratch& scratch, ThreadPool& pool) {
  const TangentFill<Group, M> fill{model, p, frames, x, clamp, kept_frames(scratch, model, x)};
  const auto solid = [&](Index g, int count, GroupTangent* out) { fill.solid(g, count, out); };
  const auto fiber = [&](Index g, int count, GroupTangent* out) { fill.fiber(g, count, out); };
  std::fill(values, values + model.values_size(), 0.0);
  assemble<Group>(model, model.solid, model.solid_slot, solid, values, scratch, pool);
  assemble<Group>(model, model.fiber, model.fiber_slot, fiber, values, scratch, pool);
}

/// Adds the matrices of one block to all lanes at once; fill(lane, first, count, tangents) as in
/// assemble(), for lanes whose bit is set.
template <typename Group, typename Fill>
void add_to_lanes(const ElementBlock& block, const std::vector<std::int32_t>& places,
                  unsigned active, Fill&& fill, LaneCholesky& to) {
  using Matrices = MatricesOf<Group>;
  constexpr int n = Group::kNodes, kPairs = n * (n + 1) / 2, kStep = LaneCholesky::kCount;
  static_assert(kStep == kNativeLanes && Matrices::kSize % kStep == 0);
  // Members that have nothing to add stay zero: sums that begin at +0 never become -0, so that
  // adding zero changes no bit of theirs.
  alignas(64) double matrix[kStage][kStep][Matrices::kSize] = {};
  alignas(64) double sides[Matrices::kSize * kStep];  // the same entry of all members in a row
  for_stages(0, block.num_groups, [&](Index first, int count) {
    for (int lane = 0; lane < kStep; ++lane) {
      if (!(active >> lane & 1u)) continue;
      GroupTangent tangents[kStage];
      fill(lane, first, count, tangents);
      for (int k = 0; k < count; ++k)
        Matrices::make(block, first + k, tangents[k], matrix[k][lane]);
    }
    for (int k = 0; k < count; ++k) {
      for (Index i = 0; i < Matrices::kSize; i += kStep) {
        Native square[kStep];
        for (int lane = 0; lane < kStep; ++lane) square[lane] = load<Native>(matrix[k][lane] + i);
        detail::transpose_square(square);
        for (int j = 0; j < kStep; ++j) store(sides + (i + j) * kStep, square[j]);
      }
      const Index begin = (first + k) * Matrices::kElements;
      const Index end = std::min(block.num_elements, begin + Matrices::kElements);
      for (Index e = begin; e < end; ++e) {
        const std::int32_t* place = places.data() + e * kPairs;
        for (int b = 0; b < n; ++b)
          for (int a = 0; a <= b; ++a, ++place) {
            const bool transposed = *place < 0;
            double* out = to.block(transposed ? ~*place : *place, 0);
            const int row = transposed ? 1 : 3, column = transposed ? 3 : 1;
            for (int i = 0; i < 3; ++i)
              for (int j = 0; j < 3; ++j) {
                double* entry = out + (row * i + column * j) * kStep;
                const Index at_side = Matrices::place(static_cast<int>(e - begin), a, b, i, j);
                store(entry, load<Native>(entry) + load<Native>(sides + at_side * kStep));
              }
          }
      }
    }
  });
}

template <typename Group, typename M>
void add_lane_tangents_of(const SoftModel& model, const std::vector<LaneTangent>& members,
                          const LanePlaces& places, LaneCholesky& to) {
  std::vector<TangentFill<Group, M>> fills;
  unsigned active = 0;
  for (std::size_t l = 0; l < members.size(); ++l) {
    const LaneTangent& m = members[l];
    const KeptFrames kept = m.x ? kept_frames(*m.scratch, model, m.x) : KeptFrames{};
    fills.push_back({model, m.parameters, *m.frames, m.x, false, kept});
    if (m.x) active |= 1u << l;
  }
  add_to_lanes<Group>(
      model.solid, places.solid, active,
      [&](int lane, Index g, int count, GroupTangent* out) {
        fills[at(lane)].solid(g, count, out);
      },
      to);
  add_to_lanes<Group>(
      model.fiber, places.fiber, active,
      [&](int lane, Index g, int count, GroupTangent* out) {
        fills[at(lane)].fiber(g, count, out);
      },
      to);
}

std::vector<std::int32_t> places_of(const SoftModel& model, const ElementBlock& block,
                                    const std::vector<std::int32_t>& slots,
                                    const LanePattern& pattern) {
  const int n = block.nodes_per_element();
  std::vector<std::int32_t> places;
  for (Index e = 0; e < block.num_elements; ++e)
    for (int b = 0; b < n; ++b)
      for (int a = 0; a <= b; ++a) {
        const Index row = block.nodes[at(e * n + a)];
        const auto [index, transposed] =
            pattern.place(model.row_start[at(row)] + slots[at((e * n + a) * n + b)]);
        places.push_back(transposed ? ~index : index);
      }
  return places;
}

}  // namespace

LanePlaces lane_places(const SoftModel& model, const LanePattern& pattern) {
  return {places_of(model, model.solid, model.solid_slot, pattern),
          places_of(model, model.fiber, model.fiber_slot, pattern)};
}

void add_lane_tangents(const SoftModel& model, const std::vector<LaneTangent>& members,
                       const LanePlaces& places, LaneCholesky& to) {
  with_types(model, [&](auto group, auto material) {
    add_lane_tangents_of<decltype(group), decltype(material)>(model, members, places, to);
  });
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
