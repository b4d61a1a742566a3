// A preconditioner for elasticity by smoothed aggregation with rigid-body modes.
//
// The finest matrix, which most of a cycle's time goes to reading, is smoothed with in 16 bits a
// number, each node in a scale of its own. What that adds to the forces of a smooth motion is
// rough, so that the smoother takes it away again; of a translation it adds none. Coarse matrices
// are made of the exact one, as turning a stiff part of a soft body must cost nothing.
//
// One V-cycle in float32: Chebyshev smoothing on the blocks' diagonal, coarse spaces that hold the
// translations and rotations of aggregates, Cholesky on the coarsest level (Vanek, Mandel and
// Brezina 1996; Adams, Brezina, Hu and Tuminaro 2003 for the smoother). Symmetric and positive
// definite, also where the matrix is not quite. The numbers of a hierarchy are cheap to make anew:
// the patterns are known, and a coarse unknown has a meaning (a displacement or a rotation of its
// aggregate), so no orthogonalization is needed.
#pragma once

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/linalg/rigid_hierarchy.h"
#include "kernels/vector_ops.h"

namespace diffsim {

/// What keeps a node from some motions, such as contact.
struct HeldNode {
  std::int64_t node;
  double free[9];       // (3, 3) symmetric projection on the motions that are left
  double stiffness[9];  // (3, 3) symmetric, within these: added to the node's block
};

/// A matrix of 3x3 blocks (block3.h), in the order of the hierarchy's finest pattern.
struct BlockMatrix {
  std::int64_t num_nodes = 0;
  const double* values = nullptr;
  const double* diagonal = nullptr;     // (num_nodes,) added to the diagonal, all three axes
  const std::uint8_t* fixed = nullptr;  // (num_nodes, 3), 1 where an unknown takes no part
  const std::vector<HeldNode>* held = nullptr;  // none of them fixed; null: no node
};

class RigidMultigrid {
 public:
  explicit RigidMultigrid(std::shared_ptr<const RigidHierarchy> hierarchy);

  /// Takes over new numbers.
  /// @param[in] x  (num_nodes, 3) positions, whose rigid motions cost no energy [m]
  void prepare(const BlockMatrix& matrix, const double* x, ThreadPool& pool);
  /// Leaves its memory alone and forgets all numbers.
  void forget();

  /// z = approximate inverse times r; both (num_nodes, 3), r within what held nodes may do, and z
  /// up to float32's rounding.
  void apply(const Vector& r, Vector& z, ThreadPool& pool);

  std::int64_t bytes() const;

 private:
  /// S^-1 A S^-1 of level 0, S being a number per node; its unknowns are S times those of A.
  struct Finest {
    AlignedBuffer<std::int16_t> blocks;  // off the diagonal, where they are zero
    AlignedBuffer<float> diagonal;       // (nodes, 3, 3)
    AlignedBuffer<float> lost;           // (nodes, 3, 3), of a translation's forces by rounding
    AlignedBuffer<float> scale;          // (nodes,)
  };
  struct Level {
    AlignedBuffer<float> matrix;        // (6, 8) column-major; none of level 0
    AlignedBuffer<float> inverse;       // inverse diagonal blocks (nodes, K, K)
    AlignedBuffer<float> prolongation;  // blocks (K, 8)
    AlignedBuffer<float> product;       // the same, of matrix times prolongation
    AlignedBuffer<float> tentative;     // (nodes, K, 8) before smoothing
    std::vector<double> position;       // (nodes, 3)
    double length = 1.0;                // of which a rotation of one moves by one [m]
    float largest = 0.0F;               // eigenvalue of inverse times matrix
    std::vector<float> mode;            // its eigenvector, as far as known
    std::vector<float> x, b, residual, step, next, image;
  };
  const Pattern& pattern(int l) const { return hierarchy_->matrix(l); }
  int stride(int l) const { return l == 0 ? 3 : 8; }
  /// Rows that a task takes: some microseconds of work, and tasks for all threads on small bodies.
  static std::int64_t task_rows(int l) { return l == 0 ? 128 : 16; }

  void hold(const std::vector<HeldNode>& held, std::int64_t num_nodes);
  /// Projection (3, 3) on what a node may do, or null where that is every motion.
  const float* projection(std::int64_t node) const;
  void copy_matrix(const BlockMatrix& matrix, ThreadPool& pool);
  void round_row(const BlockMatrix& matrix, std::int64_t i);
  void restore_translations(ThreadPool& pool);
  void invert_diagonal(int l, ThreadPool& pool);
  void estimate_largest(int l, ThreadPool& pool);
  void place_aggregates(int l);
  void make_tentative(int l, ThreadPool& pool);
  template <int K>
  void make_prolongation(const BlockMatrix& matrix, int l, ThreadPool& pool);
  template <int K>
  void make_product(const BlockMatrix& matrix, int l, ThreadPool& pool);
  template <int K>
  void make_coarse(int l, ThreadPool& pool);
  void mirror_coarse(int l, ThreadPool& pool);
  void factorize_coarsest(ThreadPool& pool);

  void multiply_rows(int l, const float* x, float* y, std::int64_t begin, std::int64_t end) const;
  void scale_rows(int l, const float* r, float* z, std::int64_t begin, std::int64_t end) const;
  void smooth(int l, bool from_zero, bool keep_residual, ThreadPool& pool);
  void restrict_residual(int l, ThreadPool& pool);
  void prolong(int l, ThreadPool& pool);
  void cycle(int l, ThreadPool& pool);

  std::shared_ptr<const RigidHierarchy> hierarchy_;
  Finest finest_;
  std::vector<Level> levels_;
  std::vector<std::uint8_t> fixed_;
  std::vector<std::int32_t> held_;  // (num_nodes,) into projections_ / 9, -1; empty: none is held
  std::vector<float> projections_;
  CholeskyFactor coarsest_;
  CholeskyWorkspace cholesky_;
  std::vector<double> coarse_rhs_, coarse_blocks_;
  std::vector<double> largest_of_;  // of every task's rows
};

}  // namespace diffsim
