// The discrete Stokes operator on a grid without a matrix: residual, outflow of cells, and the
// derivatives of both by geometry, wall velocity, body force and traction.
//
// Nodal vectors are (num_nodes, D) over all grid nodes; nodes without fluid are ignored.
#pragma once

#include <cmath>

#include "kernels/stokes/cell_form.h"
#include "kernels/stokes/flow_geometry.h"

namespace diffsim {

enum class FlowSolver { kAuto, kDirect, kIterative };

/// Active nodes up to which "auto" is direct, in three dimensions, about where both take the same
/// time; no incompressible flow is.
constexpr std::int64_t kMaxDirectNodes = 20000;

struct FlowOptions {
  bool slip = false;           // slip wall instead of no-slip
  double beta = 20.0;          // Nitsche penalty [-]
  double gamma = 0.04;         // ghost penalty [-]
  double theta = 0.3;          // penalty on films thinner than a cell [-]
  double ghost_delta = 0.05;   // fraction below which the ghost penalty grows no more [-]
  double volume_delta = 2e-3;  // delta of PressureVolume [-]
  double open_epsilon = 0.2;   // epsilon of PressureVolume [-]
  double bulk = 1e5;           // lambda / eta [-]
  bool incompressible = false;
  double tolerance = 1e-9;  // of the relative divergence, where incompressible
  int max_iters = 100;
  FlowSolver solver = FlowSolver::kAuto;
  std::int64_t max_direct_nodes = kMaxDirectNodes;
  double rtol = 1e-9;  // of the iterative solver's residual
};

/// Given fields; nullptr where absent.
struct FlowData {
  const double* wall_velocity = nullptr;  // (num_nodes, D) [m/s]
  const double* body_force = nullptr;     // (num_nodes, D) [N/m^D]
  const double* traction = nullptr;       // (num_nodes, D) on open faces [N/m^(D-1)]
};
struct FlowDataGradient {
  double* wall_velocity = nullptr;
  double* body_force = nullptr;
  double* traction = nullptr;
};

/// A cell's face on the box that is open.
struct OpenFace {
  std::int64_t cell;
  int axis, side;
};

/// M with pressure = -bulk eta C / M [m^D]: about the fluid volume f h^D,
///   M = h^D (f + delta) (1 + (epsilon / a)^(3/2))^2,   a the fluid shares of the cell's faces,
///   summed.
/// Where a wall enters a cell through a corner, C ~ a and f ~ a^D: the last factor lets the
/// pressure of such a cell fade in, while a grows from 0 to about a hundredth. Where a wall
/// parallel to a face enters, a > 1, and the cell at once keeps its volume.
struct PressureVolume {
  double value, by_fluid_volume, by_open;
  PressureVolume(double f, double open, double cell_volume, const FlowOptions& options) {
    const double ratio = options.open_epsilon / open, part = ratio * std::sqrt(ratio);
    by_fluid_volume = (1.0 + part) * (1.0 + part);
    value = cell_volume * (f + options.volume_delta) * by_fluid_volume;
    by_open = -3.0 * value * part / (open * (1.0 + part));
  }
};

template <int D>
class FlowOperator {
 public:
  using Form = CellForm<D>;
  static constexpr int kCorners = 1 << D;

  /// @param open (2 D,) which faces of the box are open, axis by axis, low side first
  FlowOperator(const StokesGrid<D>& grid, const double* phi, const bool* open,
               const FlowOptions& options, ThreadPool& pool);

  const FlowGeometry<D>& geometry() const { return geometry_; }
  const Form& form() const { return form_; }
  const FlowOptions& options() const { return options_; }
  const std::vector<OpenFace>& open_faces() const { return open_faces_; }
  CellWeights weights(std::int64_t cell) const {
    const CutCell<D>* c = geometry_.cut(cell);
    if (c)
      return {c->volume(), c->area(), geometry_.wall_normal(cell), geometry_.facet_normal(cell)};
    return {form_.basis().weight, nullptr, nullptr, nullptr};
  }
  PressureVolume pressure_volume_terms(std::int64_t cell) const {
    double open = 0.0;
    for (int a = 0; a < D; ++a)
      for (int side = 0; side < 2; ++side) open += geometry_.aperture(cell, a, side);
    return {geometry_.fraction(cell), open, geometry_.grid().cell_volume, options_};
  }
  double pressure_volume(std::int64_t cell) const {
    return pressure_volume_[static_cast<std::size_t>(cell)];
  }
  /// Penalties on a face; returns how many, at most two.
  int face_terms(std::int64_t cell, int axis, FaceKind kind, FaceTerm* terms) const {
    const double aperture = geometry_.face_aperture(cell, axis, kind), f = geometry_.fraction(cell);
    if (kind != FaceKind::kInner) {
      terms[0] = film_term(f, aperture, options_.theta, kind);
      return 1;
    }
    const double g = geometry_.fraction(cell + geometry_.grid().cell_stride[axis]);
    terms[0] = ghost_term(f, g, aperture, options_.gamma, options_.ghost_delta);
    terms[1] = film_term(f + g, aperture, options_.theta, kind);
    return 2;
  }
  double fluid_volume(std::int64_t cell) const {
    return geometry_.fraction(cell) * geometry_.grid().cell_volume;
  }

  /// R(v) = e(v, .) - p C(., 0) - traction, overwritten; p (num_cells,) or nullptr.
  void residual(const double* v, const FlowData& data, const double* pressure, double eta,
                double* r, ThreadPool& pool) const;
  /// r -= p C(., 0).
  void add_pressure_force(const double* p, double* r, ThreadPool& pool) const;
  /// C(v, wall velocity) of every cell, (num_cells,) [m^D/s]; zero in empty cells.
  void outflow(const double* v, const double* wall_velocity, double* C, ThreadPool& pool) const;
  /// The penalties' part of the residual, added.
  /// @param weight (cell, axis, kind, term): of a term in place of its own
  template <typename Weight>
  void add_face_residual(const double* v, double eta, Weight&& weight, double* r,
                         ThreadPool& pool) const;

  /// Adds -d/d(phi, data) [e(v, z) - p C(z, 0) + pi C(v, g) + by_volume V + by_mass M], summed over
  /// cells; V fluid volume, M that of PressureVolume.
  /// @param by_volume, by_mass (num_cells,)
  void gradient(const double* v, const double* z, const FlowData& data, const double* p,
                const double* pi, const double* by_volume, const double* by_mass, double eta,
                double* grad_phi, const FlowDataGradient& grad, ThreadPool& pool) const;

  /// Added: the share of dL/dphi that comes through dL/d(fluid fraction), (num_cells,).
  void fraction_gradient(const double* grad_fraction, double* grad_phi) const;

  /// Values of a nodal field at a cell's corners.
  void gather(const double* field, std::int64_t node, typename Form::Corner out) const {
    for (int i = 0; i < kCorners; ++i)
      for (int a = 0; a < D; ++a)
        out[i][a] = field[(node + geometry_.grid().corner_offset[i]) * D + a];
  }
  const double* phi() const { return phi_.data(); }

 private:
  void add_traction(const double* traction, double* r) const;
  template <typename F>
  void on_face(const OpenFace& face, F&& f) const;

  FlowGeometry<D> geometry_;
  Form form_;
  FlowOptions options_;
  std::vector<double> phi_;
  std::vector<double> pressure_volume_;  // (num_cells,), zero without fluid
  std::vector<OpenFace> open_faces_;
  std::vector<double> full_matrix_;  // of a full cell for eta = 1
};

constexpr FaceKind kFaceKinds[3] = {FaceKind::kInner, FaceKind::kLow, FaceKind::kHigh};
/// Layers of nodes that the penalties of a face couple.
inline int face_layers(FaceKind kind) { return kind == FaceKind::kInner ? 3 : 2; }

/// f(q, face_nodes, N): at each Gauss point of a cell's face, its nodes and their shape functions.
template <int D, typename F>
void for_face_points(const StokesGrid<D>& grid, std::int64_t first_node, int axis, int side,
                     F&& f) {
  constexpr int kFaceNodes = 1 << (D - 1);
  std::int64_t nodes[kFaceNodes];
  int count = 0, corner_of[kFaceNodes];
  for (int i = 0; i < 1 << D; ++i)
    if (StokesGrid<D>::corner_bit(i, axis) == side && count < kFaceNodes) {
      corner_of[count] = i;
      nodes[count++] = first_node + grid.corner_offset[i];
    }
  for (int q = 0; q < pow3(D - 1); ++q) {
    double N[kFaceNodes];
    for (int i = 0; i < kFaceNodes; ++i) {
      N[i] = 1.0;
      int rest = q;
      for (int a = D - 1; a >= 0; --a) {
        if (a == axis) continue;
        const double x = kGauss3Point[rest % 3];
        rest /= 3;
        N[i] *= StokesGrid<D>::corner_bit(corner_of[i], a) ? x : 1.0 - x;
      }
    }
    f(q, nodes, N);
  }
}

/// The 2^(D-1) positions across a face: corners of the cell on the face's low side.
template <int D>
void face_corners(int axis, int* corners) {
  const int low = (1 << (D - 1 - axis)) - 1;  // bits behind the axis
  for (int i = 0; i < 1 << (D - 1); ++i) corners[i] = (i & low) | ((i & ~low) << 1);
}

/// A stencil across a face at its node positions.
template <int D>
void face_values(const StokesGrid<D>& grid, std::int64_t node, int axis, const int* corners,
                 const double* stencil, int layers, const double* v, double (*values)[D]) {
  for (int i = 0; i < 1 << (D - 1); ++i) {
    const double* at = v + (node + grid.corner_offset[corners[i]]) * D;
    for (int a = 0; a < D; ++a) {
      values[i][a] = 0.0;
      for (int l = 0; l < layers; ++l)
        values[i][a] += stencil[l] * at[l * grid.node_stride[axis] * D + a];
    }
  }
}

template <int D>
template <typename Weight>
void FlowOperator<D>::add_face_residual(const double* v, double eta, Weight&& weight, double* r,
                                        ThreadPool& pool) const {
  const StokesGrid<D>& grid = geometry_.grid();
  constexpr int kFace = kCorners / 2;
  for (int axis = 0; axis < D; ++axis) {
    int corners[kFace];
    face_corners<D>(axis, corners);
    for (FaceKind kind : kFaceKinds)
      run_colors(geometry_.penalty_faces(axis, kind), pool, [&](std::int64_t cell) {
        const std::int64_t node = geometry_.first_node(cell);
        FaceTerm terms[2];
        const int count = face_terms(cell, axis, kind, terms);
        for (int t = 0; t < count; ++t) {
          double values[kFace][D];
          face_values<D>(grid, node, axis, corners, terms[t].stencil, face_layers(kind), v, values);
          const double w = weight(cell, axis, kind, terms[t]) * eta / grid.h[axis];
          for (int i = 0; i < kFace; ++i)
            for (int a = 0; a < D; ++a) {
              double sum = 0.0;
              for (int j = 0; j < kFace; ++j)
                sum += form_.basis().face_mass[axis][i][j] * values[j][a];
              for (int l = 0; l < face_layers(kind); ++l)
                r[(node + grid.corner_offset[corners[i]] + l * grid.node_stride[axis]) * D + a] +=
                    w * terms[t].stencil[l] * sum;
            }
        }
      });
  }
}

}  // namespace diffsim
