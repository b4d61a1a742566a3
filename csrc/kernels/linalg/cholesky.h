// Sparse supernodal Cholesky factorization A = L L' of a symmetric positive definite matrix.
//
// Three steps: analyze_cholesky (pattern only; ordering and storage), CholeskyFactor::refactor
// (values) and CholeskyFactor::solve. Results are bitwise the same for every number of threads.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <vector>

#include "kernels/linalg/aligned_buffer.h"
#include "kernels/parallel.h"

namespace diffsim {

/// Immutable symbolic analysis: ordering, supernodes, and the map from input entries to factor
/// positions. Contents in cholesky_symbolic.h.
class CholeskySymbolic;

/// @param num_nodes  nodes of the graph; the matrix has num_nodes * block unknowns
/// @param indptr     (num_nodes + 1) CSR row starts of the full symmetric pattern
/// @param indices    (nnz) CSR columns, the diagonal included, no column twice in a row
/// @param coords     (num_nodes, 3) node positions in any unit, or nullptr: the graph alone, with
///                   0-100 % more work on irregular meshes
/// @param block      unknowns per node, 1 to 6
/// @param absent     (num_nodes * block) nonzero where an unknown takes no part: its row and column
///                   are never read and a solve gives zero there; or nullptr
/// @param lattice    the nodes are points of a regular grid: a third of the time
/// @throws std::invalid_argument where the pattern lacks a diagonal entry, is not symmetric, or
///         has indices out of range
std::shared_ptr<const CholeskySymbolic> analyze_cholesky(
    std::int64_t num_nodes, const std::int64_t* indptr, const std::int64_t* indices,
    const double* coords, int block, const std::uint8_t* absent = nullptr, bool lattice = false);

/// The matrix is not positive definite to working precision.
struct NotPositiveDefinite : std::runtime_error {
  NotPositiveDefinite(std::int64_t unknown_index, double pivot_value);
  std::int64_t unknown;  // index in the caller's numbering: node * block + component
  double pivot;          // what was found where a positive number was needed; may be NaN
};

/// Scratch of one solve at a time; grows when needed and is reused.
class CholeskyWorkspace {
 public:
  /// 64-byte aligned memory for `count` doubles, contents undefined.
  double* reserve(std::size_t count) { return buffer_.resize(count); }

 private:
  AlignedBuffer<double> buffer_;
};

/// How a factor is computed and stored: kRounded computes in float64 and stores float32, kFloat32
/// does both in float32, and goes over to kRounded where that breaks down.
enum class FactorPrecision { kFloat64, kRounded, kFloat32 };

/// Memory of a factor. Fresh pages are cleared by the system when they are first written, which for
/// a large factor takes a fifth of the factorization: hand them from one factor to the next.
struct CholeskyMemory {
  AlignedBuffer<double> factor;
  AlignedBuffer<float> factor32;
  AlignedBuffer<std::byte> fronts;            // of what the factor is computed in
  std::vector<AlignedBuffer<double>> panels;  // of supernodes that wait to be rounded
};

class CholeskyFactor {
 public:
  /// @param precision float32 halves the memory that a solve streams, computed so the time of a
  ///        factorization, too, for more of an error: for use as a preconditioner
  /// @param memory what another factor left, or nothing; grows where it is too small
  explicit CholeskyFactor(std::shared_ptr<const CholeskySymbolic> symbolic,
                          FactorPrecision precision = FactorPrecision::kFloat64,
                          CholeskyMemory memory = {});

  /// Factors new values on the analyzed pattern.
  /// @param values (nnz, block, block) row-major blocks in the CSR's order; one triangle is read
  /// @throws NotPositiveDefinite where a pivot is not positive, NaN, or negligible beside its
  ///         diagonal entry; the factor is then unusable until the next refactor
  void refactor(const double* values, ThreadPool& pool);

  /// x = A^-1 b.
  /// @param b, x (num_unknowns, num_rhs) row-major; may be the same memory
  /// @throws std::logic_error before a successful refactor
  void solve(const double* b, double* x, int num_rhs, CholeskyWorkspace& ws,
             ThreadPool& pool) const;

  /// Rows and columns of A^-1 at some unknowns. With B the columns of the identity there it is
  /// (L^-1 B)' (L^-1 B): half a solve, which reads of L only what lies between an unknown and the
  /// root of the elimination tree.
  /// @param among    (count,) the unknowns, none twice, in any order
  /// @param inverse  (count, count)
  void inverse_among(const std::int64_t* among, std::int64_t count, double* inverse,
                     CholeskyWorkspace& ws, ThreadPool& pool) const;

  /// Frees the memory kept for the next refactor.
  void release_refactor_memory();
  /// Its memory for another factor; unusable until the next refactor.
  CholeskyMemory take_memory();

  bool usable() const { return usable_; }
  std::int64_t num_unknowns() const;
  std::int64_t nnz() const;    // entries of L, relaxed supernodes' zeros included, padding not
  std::int64_t bytes() const;  // memory of L as stored, which a solve streams twice
  double flops() const;        // of one refactor
  const CholeskySymbolic& symbolic() const { return *symbolic_; }

 private:
  template <typename T>
  struct Solver;
  template <typename T>
  struct Refactor;
  template <typename T>
  void refactor_in(const double* values, ThreadPool& pool);
  template <typename T>
  void inverse_among_in(const T* factor, const std::int64_t* among, std::int64_t count,
                        double* inverse, CholeskyWorkspace& ws, ThreadPool& pool) const;

  std::shared_ptr<const CholeskySymbolic> symbolic_;
  FactorPrecision precision_;
  CholeskyMemory memory_;  // L, and what is kept for the next refactor
  bool usable_ = false;
};

}  // namespace diffsim
