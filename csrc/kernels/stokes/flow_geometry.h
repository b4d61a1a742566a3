// The fluid on a grid: which cells are fluid, cut or empty, which nodes carry unknowns, and the
// faces that a ghost penalty holds together.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/parallel.h"
#include "kernels/stokes/cut_cell.h"
#include "kernels/stokes/stokes_grid.h"

namespace diffsim {

/// A penalty on faces: weight * eta / h * int_face (S v).(S z), S a stencil across the face.
struct FaceTerm {
  double weight = 0.0;
  double by_fraction[2] = {0.0, 0.0};  // of the cell on the lower and on the higher side
  double by_aperture = 0.0;            // fluid share of the face, seen from either side
  double stencil[3] = {0.0, 0.0, 0.0};
};

/// Where a face lies: between two cells with fluid, or on a cell's low or high side with nothing
/// behind it, the end of the box or a cell whose plane leaves it empty.
enum class FaceKind { kInner, kLow, kHigh };

/// Ghost penalty on the jump of the normal derivative between cells A and B:
///   weight gamma (a_A + a_B) / 2  (1 - x) (1 + delta) / (x + delta),   x = f_A f_B,
/// f fluid fraction of a cell, a fluid share of the face. It vanishes where both cells are full,
/// and with the face's fluid share, so that cells become full, cut and empty continuously. The area
/// of the wall in a cell is at most that of the cell's faces that are fluid: the penalty holds
/// every wall term down. It grows where a cell is nearly empty: such a cell takes its neighbor's
/// velocity, extrapolated, and a wall that passes from one cell to the next changes next to
/// nothing.
inline FaceTerm ghost_term(double f_a, double f_b, double aperture, double gamma, double delta) {
  FaceTerm term;
  const double x = f_a * f_b, s = (1.0 - x) * (1.0 + delta) / (x + delta);
  const double slope = -(1.0 + delta) * (1.0 + delta) / ((x + delta) * (x + delta));
  term.weight = gamma * aperture * s;
  term.by_fraction[0] = gamma * aperture * slope * f_b;
  term.by_fraction[1] = gamma * aperture * slope * f_a;
  term.by_aperture = gamma * s;
  term.stencil[0] = term.stencil[2] = 1.0;
  term.stencil[1] = -2.0;
  return term;
}

/// Penalty on the normal derivative itself where fluid is much thinner than a cell, t = f_A + f_B
/// (one f with nothing behind): a film between two walls, or between a wall and the box, has no
/// neighbor that could hold it, nor has a sliver whose neighbors' planes leave them empty.
/// weight theta a / (1 + (t / t_0)^4): nothing where there is fluid behind.
inline FaceTerm film_term(double t, double aperture, double theta, FaceKind kind) {
  constexpr double kThin = 0.08;  // t_0
  FaceTerm term;
  const double r = t / kThin, s = 1.0 / (1.0 + r * r * r * r);
  term.weight = theta * aperture * s;
  term.by_fraction[0] = term.by_fraction[1] = -theta * aperture * s * s * 4.0 * r * r * r / kThin;
  term.by_aperture = theta * s;
  term.stencil[0] = kind == FaceKind::kInner ? -0.5 : -1.0;
  term.stencil[kind == FaceKind::kInner ? 2 : 1] = kind == FaceKind::kInner ? 0.5 : 1.0;
  return term;
}

/// Work lists whose items share no node within a list, so that threads add to nodes without locks
/// and in a fixed order.
using Colors = std::vector<std::vector<std::int64_t>>;

template <typename F>
void run_colors(const Colors& colors, ThreadPool& pool, F&& f) {
  constexpr std::int64_t kChunk = 32;
  for (const std::vector<std::int64_t>& list : colors) {
    const std::int64_t size = static_cast<std::int64_t>(list.size());
    pool.run((size + kChunk - 1) / kChunk, [&](std::int64_t task) {
      for (std::int64_t i = task * kChunk; i < std::min(size, (task + 1) * kChunk); ++i)
        f(list[static_cast<std::size_t>(i)]);
    });
  }
}

template <int D>
class FlowGeometry {
 public:
  /// @param phi    (num_nodes,) level set, > 0 in the fluid [any unit], finite
  /// @param curved whether walls have the normals of wall_normal.h, or those of their planes
  FlowGeometry(const StokesGrid<D>& grid, const double* phi, bool curved, ThreadPool& pool);

  const StokesGrid<D>& grid() const { return grid_; }
  bool active(std::int64_t cell) const { return fraction_[u(cell)] > kOnFace; }
  double fraction(std::int64_t cell) const { return fraction_[u(cell)]; }
  const std::vector<double>& fractions() const { return fraction_; }
  /// The cut of an active or inactive cell, nullptr where it is full or empty.
  const CutCell<D>* cut(std::int64_t cell) const {
    const std::int32_t index = cut_index_[u(cell)];
    return index < 0 ? nullptr : &cuts_[u(index)];
  }
  /// Normal of the wall in a cut cell, out of the fluid, (D,).
  const double* wall_normal(std::int64_t cell) const {
    return curved_ ? wall_normals_.data() + cut_index_[u(cell)] * D : cut(cell)->normal();
  }
  /// Normal of what stands for it, by which the fluid of a cell is counted, (D,): in 2D that of the
  /// plane, for the fluid of neighbors ends at the same places and none may pass between them.
  const double* facet_normal(std::int64_t cell) const {
    return D == 2 ? cut(cell)->normal() : wall_normal(cell);
  }
  /// Adds `sign` times dL/dphi, given dL/d(weights, wall's normal, apertures) of a cut cell.
  /// @param by_value (CutCell::kSize,), used up
  void cut_vjp(std::int64_t cell, const double* phi, double sign, double* by_value,
               double* grad_phi) const;
  /// The same, given dL/dc and dL/dg of the cell's plane.
  void plane_vjp(std::int64_t cell, const double* phi, const double* by_plane, double sign,
                 double* grad_phi) const;
  /// Weights, wall's normal and apertures of a cut cell, with their rates along d_phi.
  /// @param d_phi (num_nodes,)
  /// @param[out] value (CutCell::kSize,)
  void cut_tangent(std::int64_t cell, const double* phi, const double* d_phi, Dual<1>* value) const;
  /// Rates of c and g of the cell's plane, (D + 1,).
  void plane_tangent(std::int64_t cell, const double* phi, const double* d_phi,
                     double* d_plane) const;
  double aperture(std::int64_t cell, int axis, int side) const {
    const CutCell<D>* c = cut(cell);
    return c ? c->aperture(axis, side) : (active(cell) ? 1.0 : 0.0);
  }

  std::int64_t num_active_cells() const { return num_active_cells_; }
  const std::vector<std::int64_t>& cut_cells() const { return cut_cells_; }  // active or not
  const Colors& cell_colors() const { return cell_colors_; }                 // active cells
  /// Faces with a penalty, by the cell on their lower side, or the only one with fluid.
  const Colors& penalty_faces(int axis, FaceKind kind) const {
    return penalty_faces_[axis][static_cast<int>(kind)];
  }
  /// Share of one cell in the aperture of a face: half, unless the face is the box's.
  double face_share(std::int64_t cell, int axis, FaceKind kind) const {
    if (kind == FaceKind::kInner) return 0.5;
    std::int64_t at[D];
    grid_.cell_position(cell, at);
    return at[axis] == (kind == FaceKind::kHigh ? grid_.cells[axis] - 1 : 0) ? 1.0 : 0.5;
  }
  double face_aperture(std::int64_t cell, int axis, FaceKind kind) const {
    double sum = aperture(cell, axis, kind != FaceKind::kLow);
    if (kind == FaceKind::kInner) sum += aperture(cell + grid_.cell_stride[axis], axis, 0);
    return face_share(cell, axis, kind) * sum;
  }

  const std::vector<std::int64_t>& active_nodes() const { return active_nodes_; }
  std::int64_t unknown_node(std::int64_t node) const { return unknown_node_[u(node)]; }

  /// Fluid moments of a cell's face, (3^(D-1),) [m^(D-1)], with derivatives by the cell's plane.
  void face_moments(std::int64_t cell, int axis, int side, const double* phi,
                    Dual<D + 1>* moments) const;
  /// @param phi phi(node, index): level set, index below kPlaneNodes
  template <typename T, typename Field>
  CellPlane<D, T> plane(std::int64_t cell, Field&& phi, CellKind& kind) const;
  CellPlane<D> plane(std::int64_t cell, const double* phi) const {
    CellKind kind;
    return plane<double>(cell, [&](std::int64_t node, int) { return phi[node]; }, kind);
  }
  std::int64_t first_node(std::int64_t cell) const {
    std::int64_t at[D];
    grid_.cell_position(cell, at);
    return grid_.first_node(at);
  }

 private:
  /// Nodes that a cell's plane depends on.
  static constexpr int kPlaneNodes = D == 2 ? ChordPatch::kNodes : 1 << D;

  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }

  /// Steps of the constructor, in this order.
  void classify_cells(const double* phi);               // full, cut or empty
  void make_cuts(const double* phi, ThreadPool& pool);  // and the fluid fractions of cut cells
  void make_wall_normals(const double* phi);
  void color_cells();
  void color_penalty_faces();
  void number_nodes();
  /// f(cell, position), cells ascending.
  template <typename F>
  void for_active_cells(F&& f) const {
    for (std::int64_t cell = 0; cell < grid_.num_cells; ++cell) {
      if (!active(cell)) continue;
      std::int64_t at[D];
      grid_.cell_position(cell, at);
      f(cell, at);
    }
  }

  StokesGrid<D> grid_;
  bool curved_;
  std::vector<double> wall_normals_;     // (cut cells, D) where curved
  std::vector<double> fraction_;         // (num_cells,)
  std::vector<std::int32_t> cut_index_;  // (num_cells,), -1: not cut
  std::vector<CutCell<D>> cuts_;
  std::vector<std::int64_t> cut_cells_;
  Colors cell_colors_, penalty_faces_[D][3];
  std::vector<std::int64_t> active_nodes_, unknown_node_;
  std::int64_t num_active_cells_ = 0;
};

}  // namespace diffsim
