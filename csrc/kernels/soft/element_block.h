// Finite elements in SIMD order: the deformation gradient and its transpose, eight samples at once.
//
// A *sample* is one quadrature point of one element. Lanes hold eight samples: the 2x2x2 Gauss
// points of one hexahedron, or one point each of eight elements (tetrahedra, or hexahedra by their
// mean deformation gradient, see hourglass.h). Such eight samples are a *group*; arithmetic takes
// it register by register, in kParts *parts*.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/lanes.h"

namespace diffsim {

/// Shape-function gradients [1/m] and quadrature weights [m^3] of the eight samples of a group.
template <int kNodes>
struct GroupShape {
  Lane grad[kNodes][3];
  Lane weight;
};

/// The same for a hexahedron with its nodes side by side: row 3 q + j is the j-th component at
/// sample q.
struct NodeShape {
  alignas(64) double grad[24][8];      // [1/m]
  alignas(64) double weighted[24][8];  // times the quadrature weight [m^2]
};

/// Hexahedra at 2x2x2 Gauss points, tetrahedra, hexahedra by their mean deformation gradient with
/// hourglass strains, eighths of ten-node tetrahedra by the gradient of the whole.
enum class ElementKind { kHex, kTet, kMeanHex, kEighthTet };

constexpr int kHourglassModes = 4, kHourglassRows = 21, kHourglassWeights = 2;
/// Doubles of one class of elements in a table of hourglass shapes.
constexpr int kHourglassTable = 8 * kHourglassModes + 3 * kHourglassRows;

/// What the hourglass strains of a group are made of, see hourglass.h.
struct HourglassShape {
  Lane gamma[kHourglassModes][8];  // amplitude of a mode is sum_a gamma_a x_a [-]
  Lane row[kHourglassRows][3];     // zero in padding lanes [m^(1/2)]
};

/// Some elements of a mesh, all of one kind: the solid itself, or the elements a muscle runs
/// through.
struct ElementBlock {
  ElementKind kind = ElementKind::kHex;
  std::int64_t num_elements = 0;
  std::int64_t num_groups = 0;
  std::vector<std::int64_t> nodes;           // (num_elements, 8 or 4)
  std::vector<GroupShape<8>> hex_shape;      // one per congruence class
  std::vector<NodeShape> hex_nodes;          // one per congruence class
  std::vector<std::int64_t> hex_class;       // (num_elements,)
  std::vector<GroupShape<4>> tet_shape;      // (num_groups,); padding lanes weigh nothing
  std::vector<GroupShape<10>> eighth_shape;  // the same, of kEighthTet
  std::vector<GroupShape<8>> mean_shape;     // of kMeanHex, those that differ; padding as above
  std::vector<HourglassShape> hourglass;     // the same
  std::vector<std::int64_t> mean_class;      // (num_groups,)

  int nodes_per_element() const {
    return kind == ElementKind::kTet ? 4 : kind == ElementKind::kEighthTet ? 10 : 8;
  }
  /// Whether the samples of a group are of one element each.
  bool in_lanes() const { return kind != ElementKind::kHex; }
  /// Doubles of an element's tables, see TableLanes.
  std::int64_t table_size() const {
    return (in_lanes() ? 1 : kLanes) * (3 * nodes_per_element() + 1) +
           (kind == ElementKind::kMeanHex ? kHourglassTable : 0);
  }
  /// Doubles that one group needs to hold one 3-vector per node, and per lane where in lanes.
  std::int64_t vectors_size() const { return nodes_per_element() * 3 * (in_lanes() ? kLanes : 1); }
};

/// What differs between the kinds: how lanes meet nodes.
struct HexGroup {
  static constexpr int kNodes = 8;
  static constexpr bool kInLanes = false;
  using NodeValue = double;  // all lanes see the same eight nodes
  static Native part_of(NodeValue v, int) { return broadcast<Native>(v); }

  static const GroupShape<8>& shape(const ElementBlock& block, std::int64_t g) {
    return block.hex_shape[static_cast<std::size_t>(block.hex_class[static_cast<std::size_t>(g)])];
  }
  static void gather(const ElementBlock& block, std::int64_t g, const double* x,
                     NodeValue out[kNodes][3]) {
    const std::int64_t* node = block.nodes.data() + g * kNodes;
    for (int a = 0; a < kNodes; ++a)
      for (int i = 0; i < 3; ++i) out[a][i] = x[3 * node[a] + i];
  }
  /// Entry `i` of a record of `size` values per element, as lanes.
  static Lane element_value(const ElementBlock&, std::int64_t g, const double* value, int size = 1,
                            int i = 0) {
    return broadcast(value[size * g + i]);
  }
  /// The same of one part of the group.
  static Native part_value(const ElementBlock&, std::int64_t g, int, const double* value,
                           int size = 1, int i = 0) {
    return broadcast<Native>(value[size * g + i]);
  }
  static void add_element_value(const ElementBlock&, std::int64_t g, const Native v[kParts],
                                double* out, int size = 1, int i = 0) {
    out[size * g + i] += sum(fold(v));
  }
};

/// Eight elements side by side, one sample each.
template <int kNodesPerElement>
struct LaneGroup {
  static constexpr int kNodes = kNodesPerElement;
  static constexpr bool kInLanes = true;
  using NodeValue = Lane;
  static Native part_of(const NodeValue& v, int part) { return split(v, part); }

  static const GroupShape<kNodes>& shape(const ElementBlock& block, std::int64_t g) {
    if constexpr (kNodes == 4)
      return block.tet_shape[static_cast<std::size_t>(g)];
    else if constexpr (kNodes == 10)
      return block.eighth_shape[static_cast<std::size_t>(g)];
    else
      return block
          .mean_shape[static_cast<std::size_t>(block.mean_class[static_cast<std::size_t>(g)])];
  }
  /// Element behind a lane; padding lanes repeat the last element (their weight is zero).
  static std::int64_t element(const ElementBlock& block, std::int64_t g, int lane) {
    const std::int64_t e = g * kLanes + lane;
    return e < block.num_elements ? e : block.num_elements - 1;
  }
  static void gather(const ElementBlock& block, std::int64_t g, const double* x,
                     NodeValue out[kNodes][3]) {
    alignas(64) double v[3 * kNodes][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const std::int64_t* node = block.nodes.data() + element(block, g, lane) * kNodes;
      for (int a = 0; a < kNodes; ++a)
        for (int i = 0; i < 3; ++i) v[3 * a + i][lane] = x[3 * node[a] + i];
    }
    for (int a = 0; a < kNodes; ++a)
      for (int i = 0; i < 3; ++i) out[a][i] = load(v[3 * a + i]);
  }
  /// Entry `i` of a record of `size` values per element, as lanes.
  static Lane element_value(const ElementBlock& block, std::int64_t g, const double* value,
                            int size = 1, int i = 0) {
    alignas(64) double v[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) v[lane] = value[size * element(block, g, lane) + i];
    return load(v);
  }
  /// The same of one part of the group.
  static Native part_value(const ElementBlock& block, std::int64_t g, int part, const double* value,
                           int size = 1, int i = 0) {
    alignas(kNativeBytes) double v[kNativeLanes];
    for (int lane = 0; lane < kNativeLanes; ++lane)
      v[lane] = value[size * element(block, g, part * kNativeLanes + lane) + i];
    return load<Native>(v);
  }
  static void add_element_value(const ElementBlock& block, std::int64_t g, const Native v[kParts],
                                double* out, int size = 1, int i = 0) {
    const std::int64_t last = block.num_elements - g * kLanes;
    for (int lane = 0; lane < kLanes && lane < last; ++lane)
      out[size * (g * kLanes + lane) + i] += v[lane / kNativeLanes][lane % kNativeLanes];
  }
};
using TetGroup = LaneGroup<4>;
using MeanHexGroup = LaneGroup<8>;
using EighthTetGroup = LaneGroup<10>;

/// Calls f(group) with the type of a block's groups.
template <typename F>
decltype(auto) with_group(const ElementBlock& block, F&& f) {
  switch (block.kind) {
    case ElementKind::kTet:
      return f(TetGroup{});
    case ElementKind::kMeanHex:
      return f(MeanHexGroup{});
    case ElementKind::kEighthTet:
      return f(EighthTetGroup{});
    default:
      return f(HexGroup{});
  }
}

/// The tables of a group's samples among the records of all elements, (num_elements, table_size()):
/// shape gradients (samples, nodes, 3), weights (samples,), then hourglass shapes. An *entry* is
/// the place in the record of an element with one sample.
template <typename Group>
class TableLanes {
 public:
  static constexpr int kWeight = 3 * Group::kNodes, kHourglass = kWeight + 1;

  /// @param owner  (num_elements,) element of the solid that has the record; null: the same
  explicit TableLanes(const ElementBlock& block, const std::int64_t* owner = nullptr)
      : block_(block), owner_(owner), size_(block.table_size()) {}

  /// An entry of every sample of a part; zero in padding lanes.
  Native read(const double* tables, std::int64_t g, int part, int entry) const {
    alignas(kNativeBytes) double v[kNativeLanes];
    for (int n = 0; n < kNativeLanes; ++n) {
      const int lane = part * kNativeLanes + n;
      v[n] = exists(g, lane) ? tables[place(g, lane, entry)] : 0.0;
    }
    return load<Native>(v);
  }
  void add(double* tables, std::int64_t g, int part, int entry, const Native& v) const {
    for (int n = 0; n < kNativeLanes; ++n) {
      const int lane = part * kNativeLanes + n;
      if (exists(g, lane)) tables[place(g, lane, entry)] += v[n];
    }
  }

 private:
  bool exists(std::int64_t g, int lane) const {
    return !Group::kInLanes || g * kLanes + lane < block_.num_elements;
  }
  std::int64_t place(std::int64_t g, int lane, int entry) const {
    const std::int64_t element = Group::kInLanes ? g * kLanes + lane : g;
    const std::int64_t record = (owner_ ? owner_[element] : element) * size_;
    if (Group::kInLanes) return record + entry;
    return record + (entry < kWeight ? lane * kWeight + entry : kLanes * kWeight + lane);
  }

  const ElementBlock& block_;
  const std::int64_t* owner_;
  std::int64_t size_;
};

/// F = sum_a x_a (grad N_a)^T, row-major (3, 3) [-], of every part of a group.
template <typename Group>
inline void deformation_gradient(const ElementBlock& block, std::int64_t g,
                                 const GroupShape<Group::kNodes>& shape, const double* x,
                                 Native F[kParts][9]) {
  typename Group::NodeValue node[Group::kNodes][3];
  Group::gather(block, g, x, node);
  for (int part = 0; part < kParts; ++part) {
    Native sum[9];
    for (int i = 0; i < 9; ++i)
      sum[i] = Group::part_of(node[0][i / 3], part) * split(shape.grad[0][i % 3], part);
    for (int a = 1; a < Group::kNodes; ++a) {
      Native v[3], grad[3];
      for (int i = 0; i < 3; ++i) v[i] = Group::part_of(node[a][i], part);
      for (int i = 0; i < 3; ++i) grad[i] = split(shape.grad[a][i], part);
      for (int i = 0; i < 9; ++i) sum[i] += v[i / 3] * grad[i % 3];
    }
    for (int i = 0; i < 9; ++i) F[part][i] = sum[i];
  }
}
template <typename Group>
inline void deformation_gradient(const ElementBlock& block, std::int64_t g, const double* x,
                                 Native F[kParts][9]) {
  deformation_gradient<Group>(block, g, Group::shape(block, g), x, F);
}

/// Nodal forces of a stress: f_a = sum over samples of weight P grad N_a [N], into the group's
/// slice of a vectors buffer (see ElementBlock::vectors_size).
inline void scatter_stress(HexGroup, const GroupShape<8>& shape, const Native (*P)[9],
                           double* out) {
  alignas(64) Native f[24];
  for (int part = 0; part < kParts; ++part) {
    const Native weight = split(shape.weight, part);
    Native Pw[9];
    for (int i = 0; i < 9; ++i) Pw[i] = P[part][i] * weight;
    for (int a = 0; a < 8; ++a) {
      Native grad[3];
      for (int j = 0; j < 3; ++j) grad[j] = split(shape.grad[a][j], part);
      for (int i = 0; i < 3; ++i) {
        const Native force =
            Pw[3 * i] * grad[0] + Pw[3 * i + 1] * grad[1] + Pw[3 * i + 2] * grad[2];
        f[3 * a + i] = part == 0 ? force : f[3 * a + i] + force;
      }
    }
  }
  for (int k = 0; k < 24; k += kNativeLanes) store(out + k, sum_each(f + k));
}

template <int kNodes>
inline void scatter_stress(LaneGroup<kNodes>, const GroupShape<kNodes>& shape, const Native (*P)[9],
                           double* out) {
  for (int part = 0; part < kParts; ++part) {
    const Native weight = split(shape.weight, part);
    Native Pw[9];
    for (int i = 0; i < 9; ++i) Pw[i] = P[part][i] * weight;
    for (int a = 0; a < kNodes; ++a) {
      Native grad[3];
      for (int j = 0; j < 3; ++j) grad[j] = split(shape.grad[a][j], part);
      for (int i = 0; i < 3; ++i)
        store(out + (3 * a + i) * kLanes + part * kNativeLanes,
              Pw[3 * i] * grad[0] + Pw[3 * i + 1] * grad[1] + Pw[3 * i + 2] * grad[2]);
    }
  }
}

/// Where the 3-vector of (element, local node) lies in a vectors buffer, and the step between its
/// components.
inline std::int64_t vector_offset(const ElementBlock& block, std::int64_t element, int node) {
  if (!block.in_lanes()) return element * 24 + node * 3;
  return (element / kLanes) * block.vectors_size() + node * 3 * kLanes + element % kLanes;
}
inline std::int64_t vector_stride(const ElementBlock& block) {
  return block.in_lanes() ? kLanes : 1;
}

}  // namespace diffsim
