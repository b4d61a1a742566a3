// What never changes about a soft body: elements, material law, muscle fibers, chambers, and the
// sparsity they imply.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/linalg/block3.h"
#include "kernels/soft/chambers.h"
#include "kernels/soft/element_block.h"

namespace diffsim {

/// Energy density of the solid: its place among the Materials of material.h.
enum class Material : int {};

/// Shape-function tables as Python computes them (diffsim/mesh/shape.py).
struct MeshTables {
  ElementKind kind = ElementKind::kHex;
  Material material{};
  std::int64_t num_nodes = 0, num_elements = 0, num_classes = 0;
  const std::int64_t* elements = nullptr;   // (num_elements, N)
  const double* grad = nullptr;             // (num_classes, Q, N, 3) [1/m]
  const double* weight = nullptr;           // (num_classes, Q) [m^3]
  const double* hourglass = nullptr;        // (num_classes, kHourglassTable) of kMeanHex
  const std::int64_t* class_idx = nullptr;  // (num_elements,)
  const double* coords = nullptr;           // (num_nodes, 3) rest positions [m], for ordering
  std::int64_t num_fibers = 0;
  const std::int64_t* fiber_elements = nullptr;  // (num_fibers,)
  const double* fiber_directions = nullptr;      // (num_fibers, 3), unit
  const double* fiber_pull_only = nullptr;       // (num_fibers,) 1 where slack below its target
  ChamberTables chambers;
};

/// Immutable. Matrix pattern: node graph in CSR, diagonal included, columns ascending. Values of a
/// matrix are its 3x3 blocks in that order (block3.h).
struct SoftModel {
  std::int64_t num_nodes = 0;
  Material material{};
  std::int64_t num_weights =
      0;  // of the material and, after them, of hourglass strains; per element
  ElementBlock solid, fiber;
  std::vector<std::int64_t> fiber_elements;           // (num_fibers,)
  std::vector<double> fiber_directions;               // (num_fibers, 3)
  std::vector<double> fiber_pull_only;                // (num_fibers,) 1 or 0
  std::vector<std::int64_t> fibers_start, fibers_of;  // element -> its fibers
  Chambers chambers;

  std::vector<std::int64_t> row_start;  // CSR node graph
  std::vector<std::int32_t> column;
  std::vector<std::int64_t> diagonal;  // position of (i, i) in `column`
  std::vector<std::int32_t> solid_slot,
      fiber_slot;  // (elements, N, N): place of node b in row of a

  // Node -> its vectors in the buffer [solid vectors | fiber vectors].
  std::vector<std::int64_t> gather_start, gather_offset;
  std::int64_t gather_stride = 1;
  std::int64_t fiber_vectors_start = 0, vectors_size = 0;

  std::int64_t weights_size() const { return num_weights * solid.num_elements; }
  /// What the rest shape decides: tables of all elements (TableLanes), then directions of fibers.
  std::int64_t tables_size() const { return fiber_tables_start() + 3 * fiber.num_elements; }
  std::int64_t fiber_tables_start() const { return solid.num_elements * solid.table_size(); }
  std::int64_t num_blocks() const { return static_cast<std::int64_t>(column.size()); }
  std::int64_t values_size() const { return kBlock3 * num_blocks() + kBehindBlocks3; }
};

SoftModel make_soft_model(const MeshTables& tables);

}  // namespace diffsim
