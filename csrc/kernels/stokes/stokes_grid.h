// A Cartesian grid of cells; nodes and cells are numbered with the last axis fastest.
#pragma once

#include <cstdint>

namespace diffsim {

constexpr int kStokesMaxDim = 3;

/// As Python hands it over.
struct GridShape {
  int dim = 2;
  std::int64_t cells[kStokesMaxDim] = {1, 1, 1};
  double spacing[kStokesMaxDim] = {1.0, 1.0, 1.0};  // [m]
};

template <int D>
struct StokesGrid {
  static constexpr int kCorners = 1 << D;
  std::int64_t cells[D];
  std::int64_t cell_stride[D], node_stride[D];
  std::int64_t num_cells = 1, num_nodes = 1;
  std::int64_t corner_offset[kCorners];  // of a cell's corners from its first; bit D-1-a is axis a
  double h[D], cell_volume = 1.0, h_min = 0.0;

  explicit StokesGrid(const GridShape& shape) {
    for (int a = D - 1; a >= 0; --a) {
      cells[a] = shape.cells[a];
      h[a] = shape.spacing[a];
      cell_stride[a] = num_cells;
      node_stride[a] = num_nodes;
      num_cells *= cells[a];
      num_nodes *= cells[a] + 1;
      cell_volume *= h[a];
      h_min = a == D - 1 || h[a] < h_min ? h[a] : h_min;
    }
    for (int i = 0; i < kCorners; ++i) {
      corner_offset[i] = 0;
      for (int a = 0; a < D; ++a)
        if (corner_bit(i, a)) corner_offset[i] += node_stride[a];
    }
  }

  static int corner_bit(int corner, int axis) { return (corner >> (D - 1 - axis)) & 1; }
  void cell_position(std::int64_t cell, std::int64_t* at) const {
    for (int a = 0; a < D; ++a) {
      at[a] = cell / cell_stride[a];
      cell %= cell_stride[a];
    }
  }
  void node_position(std::int64_t node, std::int64_t* at) const {
    for (int a = 0; a < D; ++a) {
      at[a] = node / node_stride[a];
      node %= node_stride[a];
    }
  }
  std::int64_t first_node(const std::int64_t* at) const {
    std::int64_t node = 0;
    for (int a = 0; a < D; ++a) node += at[a] * node_stride[a];
    return node;
  }
  double face_area(int axis) const { return cell_volume / h[axis]; }
};

}  // namespace diffsim
