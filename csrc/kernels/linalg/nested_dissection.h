// Fill-reducing ordering by nested dissection.
#pragma once

#include <vector>

#include "kernels/linalg/graph.h"

namespace diffsim {

/// Elimination order that puts vertex separators last, recursively.
///
/// Each part is bisected along the direction that gives the smallest separator (a minimum vertex
/// cover of the cut edges). Directions are an embedding by graph distances from far-apart nodes
/// and, where given, the coordinate axes. Small parts are ordered by minimum degree.
/// @param coords (num_nodes, 3) node positions, or nullptr
/// @return order[k] = node eliminated k-th, a permutation of [0, num_nodes)
/// @param lattice the coordinates are those of a regular grid: its planes are the separators
std::vector<int> nested_dissection(const Graph& graph, const double* coords, bool lattice = false);

}  // namespace diffsim
