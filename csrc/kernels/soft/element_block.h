// Finite elements in SIMD order: the deformation gradient and its transpose, eight samples at once.
//
// A *sample* is one quadrature point of one element. Lanes hold eight samples: the 2x2x2 Gauss
// points of one hexahedron, or one point each of eight tetrahedra. Such eight samples are a
// *group*.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/lanes.h"

namespace diffsim {

/// Sums of eight vectors, as the lanes of one: out[i] = sum(v[i]), in the same order as sum().
inline Lane sum_each(const Lane v[kLanes]) {
  if constexpr (kParts == 1) {
    Lane row[kLanes];
    for (int i = 0; i < kLanes; ++i) row[i] = v[i];
    detail::transpose_square(row);
    return ((row[0] + row[4]) + (row[2] + row[6])) + ((row[1] + row[5]) + (row[3] + row[7]));
  } else {
    Lane out;
    for (int i = 0; i < kLanes; ++i) out[i] = sum(v[i]);
    return out;
  }
}

/// Shape-function gradients [1/m] and quadrature weights [m^3] of the eight samples of a group.
template <int kNodes>
struct GroupShape {
  Lane grad[kNodes][3];
  Lane weight;
};

/// Some elements of a mesh, all of one kind: the solid itself, or the elements a muscle runs
/// through.
struct ElementBlock {
  bool is_hex = true;
  std::int64_t num_elements = 0;
  std::int64_t num_groups = 0;
  std::vector<std::int64_t> nodes;       // (num_elements, 8 or 4)
  std::vector<GroupShape<8>> hex_shape;  // one per congruence class
  std::vector<std::int64_t> hex_class;   // (num_elements,)
  std::vector<GroupShape<4>> tet_shape;  // (num_groups,); padding lanes weigh nothing

  int nodes_per_element() const { return is_hex ? 8 : 4; }
  /// Doubles that one group needs to hold one 3-vector per node (and per lane, for tets).
  std::int64_t vectors_size() const { return is_hex ? 8 * 3 : 4 * 3 * kLanes; }
};

/// What differs between hexes and tets: how lanes meet nodes.
struct HexGroup {
  static constexpr int kNodes = 8;
  using NodeValue = double;  // all lanes see the same eight nodes

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
  static void add_element_value(const ElementBlock&, std::int64_t g, const Lane& v, double* out) {
    out[g] += sum(v);
  }
};

struct TetGroup {
  static constexpr int kNodes = 4;
  using NodeValue = Lane;

  static const GroupShape<4>& shape(const ElementBlock& block, std::int64_t g) {
    return block.tet_shape[static_cast<std::size_t>(g)];
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
  static void add_element_value(const ElementBlock& block, std::int64_t g, const Lane& v,
                                double* out) {
    const std::int64_t last = block.num_elements - g * kLanes;
    for (int lane = 0; lane < kLanes && lane < last; ++lane) out[g * kLanes + lane] += v[lane];
  }
};

/// F = sum_a x_a (grad N_a)^T, row-major (3, 3) [-].
template <typename Group>
inline void deformation_gradient(const ElementBlock& block, std::int64_t g, const double* x,
                                 Lane F[9]) {
  typename Group::NodeValue node[Group::kNodes][3];
  Group::gather(block, g, x, node);
  const auto& shape = Group::shape(block, g);
  for (int i = 0; i < 9; ++i) F[i] = node[0][i / 3] * shape.grad[0][i % 3];
  for (int a = 1; a < Group::kNodes; ++a)
    for (int i = 0; i < 9; ++i) F[i] += node[a][i / 3] * shape.grad[a][i % 3];
}

/// Nodal forces of a stress: f_a = sum over samples of weight P grad N_a [N], into the group's
/// slice of a vectors buffer (see ElementBlock::vectors_size).
inline void scatter_stress(const GroupShape<8>& shape, const Lane P[9], double* out) {
  Lane Pw[9];
  for (int i = 0; i < 9; ++i) Pw[i] = P[i] * shape.weight;
  Lane f[24];
  for (int a = 0; a < 8; ++a)
    for (int i = 0; i < 3; ++i)
      f[3 * a + i] = Pw[3 * i] * shape.grad[a][0] + Pw[3 * i + 1] * shape.grad[a][1] +
                     Pw[3 * i + 2] * shape.grad[a][2];
  for (int k = 0; k < 24; k += 8) store(out + k, sum_each(f + k));
}

inline void scatter_stress(const GroupShape<4>& shape, const Lane P[9], double* out) {
  Lane Pw[9];
  for (int i = 0; i < 9; ++i) Pw[i] = P[i] * shape.weight;
  for (int a = 0; a < 4; ++a)
    for (int i = 0; i < 3; ++i)
      store(out + (3 * a + i) * kLanes, Pw[3 * i] * shape.grad[a][0] +
                                            Pw[3 * i + 1] * shape.grad[a][1] +
                                            Pw[3 * i + 2] * shape.grad[a][2]);
}

/// Where the 3-vector of (element, local node) lies in a vectors buffer, and the step between its
/// components.
inline std::int64_t vector_offset(const ElementBlock& block, std::int64_t element, int node) {
  if (block.is_hex) return element * 24 + node * 3;
  return (element / kLanes) * block.vectors_size() + node * 3 * kLanes + element % kLanes;
}
inline std::int64_t vector_stride(const ElementBlock& block) { return block.is_hex ? 1 : kLanes; }

}  // namespace diffsim
