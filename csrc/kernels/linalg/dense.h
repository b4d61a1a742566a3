// Dense linear algebra of a handful of unknowns, without templates: hover and Riccati equations
// have at most a few dozen rows, where blocked algorithms gain nothing and Eigen's take a minute to
// compile.
#pragma once

#include <Eigen/Core>
#include <complex>
#include <vector>

namespace diffsim::dense {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// A B.
MatrixXd product(const MatrixXd& A, const MatrixXd& B);

/// A' B.
MatrixXd transposed_product(const MatrixXd& A, const MatrixXd& B);

/// A x.
VectorXd apply(const MatrixXd& A, const VectorXd& x);

/// A' x.
VectorXd apply_transposed(const MatrixXd& A, const VectorXd& x);

/// A^-1 b of a symmetric positive definite A (Cholesky); NaN where it is not.
VectorXd solve_positive(const MatrixXd& A, const VectorXd& b);

/// P A = L U with row pivots.
class Lu {
 public:
  explicit Lu(const MatrixXd& A);
  /// A^-1 B.
  MatrixXd solve(const MatrixXd& B) const;
  /// A^-1 b of one b, by columns; it rounds otherwise than `solve`.
  VectorXd solve_one(const double* b) const;
  MatrixXd inverse() const;
  /// 1 / (|A| |A^-1|) in the 1-norm, given the inverse; 0 or NaN where A is singular.
  double rcond(const MatrixXd& inverse) const;
  /// Mean of log |u_kk|: log |det A| / n.
  double mean_log_pivot() const;

 private:
  MatrixXd lu_;
  std::vector<int> order_;  // row of A that stands in each row
  double norm_ = 0.0;       // of A, largest column sum
};

/// Number of pivots of A's QR decomposition with column pivots above `drop` times the largest.
int rank(const MatrixXd& A, double drop);

/// Least-norm least-squares solution of A x = b; pivots up to `drop` of the largest count as zero.
VectorXd solve_least_norm(const MatrixXd& A, const VectorXd& b, double drop);

/// A = U T U* with T upper triangular (column-major, n x n each). Without vectors only the diagonal
/// of T counts, the eigenvalues.
struct ComplexSchur {
  int n = 0;
  bool converged = false;
  std::vector<std::complex<double>> T, U;  ///< U is empty where it is not asked for
};

/// Shifted QR on the Hessenberg form (Golub, Van Loan, Matrix Computations, 7.5).
ComplexSchur complex_schur(const MatrixXd& A, bool with_vectors);

}  // namespace diffsim::dense
