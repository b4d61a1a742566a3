// A beam of hexahedra, twisted, and one step of it on the CPU, as plain arrays that CUDA can take.
#pragma once

#include <cstdint>
#include <vector>

namespace study {

/// Rows and columns of a sparse matrix of blocks, columns ascending.
struct Pattern {
  std::vector<int> start, column;
  int rows() const { return static_cast<int>(start.size()) - 1; }
  int entries() const { return static_cast<int>(column.size()); }
};

/// From the nodes of one level of multigrid to those of the next.
struct Transfer {
  std::vector<int> aggregate;  // (nodes,)
  int num_aggregates = 0;
  Pattern prolongation, product, restriction;
  std::vector<int> restriction_entry;  // where an entry lies in `prolongation`
};

struct Scene {
  int num_nodes = 0, num_elements = 0;
  std::vector<int> elements;                 // (num_elements, 8)
  double grad[8][8][3];                      // sample, node, axis [1/m]; one shape of element
  double weight[8];                          // [m^3]
  double w_mu = 0.0, w_vol = 0.0;            // [Pa]
  std::vector<double> rest, start, inertia;  // (n, 3), (n, 3), (n,)
  std::vector<std::uint8_t> fixed;           // (n, 3)
  double rtol = 1e-4;
  std::vector<Pattern> levels;  // the tangent's first
  std::vector<Transfer> transfers;
};

/// What a run on the CPU gave.
struct Answer {
  std::vector<double> x, z;  // of the step, and of its adjoint
  double step_s = 0.0, adjoint_s = 0.0;
  double residual = 0.0, tolerance = 0.0, newton = 0.0, cycles = 0.0, adjoint_cycles = 0.0;
};

/// @param cells    along x, y, z of a beam of 0.32 x 0.08 x 0.08 m, held at x = 0
/// @param degrees  by which the start is twisted
Scene make_scene(const int cells[3], double degrees);
/// One implicit step of 10 ms from the start at rest, and the adjoint of a fixed loss.
Answer step_on_cpu(const Scene& scene, int threads, int repeats);
/// Linearly implicit steps of a batch of starts (members, n, 3), whose times are of all of them.
Answer batch_on_cpu(const Scene& scene, const std::vector<double>& starts, int threads,
                    int repeats);
/// The loss's gradient with respect to positions after the step, (n, 3).
std::vector<double> loss_gradient(const Scene& scene);

}  // namespace study
