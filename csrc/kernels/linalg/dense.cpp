#include "kernels/linalg/dense.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace diffsim::dense {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// y += a x, n entries.
inline void add(double a, const double* x, double* y, int n) {
  for (int i = 0; i < n; ++i) y[i] += a * x[i];
}

/// y += sum_k b[k stride] A_k over columns of m entries; four at a time, in one pass over y.
void add_columns(const double* A, int m, int count, const double* b, int stride, double* y) {
  int k = 0;
  for (; k + 4 <= count; k += 4, A += 4 * m, b += 4 * stride) {
    const double b0 = b[0], b1 = b[stride], b2 = b[2 * stride], b3 = b[3 * stride];
    for (int i = 0; i < m; ++i)
      y[i] += (b0 * A[i] + b1 * A[i + m]) + (b2 * A[i + 2 * m] + b3 * A[i + 3 * m]);
  }
  for (; k < count; ++k, A += m, b += stride) add(*b, A, y, m);
}

inline double dot(const double* x, const double* y, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; ++i) sum += x[i] * y[i];
  return sum;
}

double one_norm(const MatrixXd& A) {
  double largest = 0.0;
  for (int j = 0; j < A.cols(); ++j) {
    double sum = 0.0;
    for (int i = 0; i < A.rows(); ++i) sum += std::abs(A(i, j));
    if (!(sum <= largest)) largest = sum;  // NaN stays
  }
  return largest;
}

/// Householder's QR: R on and above the diagonal, reflectors (1, v) below it.
class Qr {
 public:
  Qr(MatrixXd A, bool pivoted)
      : qr_(std::move(A)), m_(static_cast<int>(qr_.rows())), n_(static_cast<int>(qr_.cols())) {
    order_.resize(n_);
    std::iota(order_.begin(), order_.end(), 0);
    tau_.assign(std::min(m_, n_), 0.0);
    for (int k = 0; k < std::min(m_, n_); ++k) {
      if (pivoted) bring_longest(k);
      reflect(k);
    }
  }

  int rank(double drop) const {
    const int count = static_cast<int>(tau_.size());
    double largest = 0.0;
    for (int k = 0; k < count; ++k) largest = std::max(largest, std::abs(qr_(k, k)));
    int found = 0;
    for (int k = 0; k < count; ++k) found += std::abs(qr_(k, k)) > drop * largest;
    return found;
  }

  /// Q' b, in place.
  void into(VectorXd& b) const {
    for (int k = 0; k < static_cast<int>(tau_.size()); ++k) apply(k, b.data());
  }

  /// Q b, in place.
  void out_of(VectorXd& b) const {
    for (int k = static_cast<int>(tau_.size()) - 1; k >= 0; --k) apply(k, b.data());
  }

  double at(int i, int j) const { return qr_(i, j); }
  int column(int k) const { return order_[k]; }

 private:
  double length(int k, int j) const {
    const double* c = qr_.col(j).data() + k;
    return dot(c, c, m_ - k);
  }

  void bring_longest(int k) {
    int best = k;
    double most = length(k, k);
    for (int j = k + 1; j < n_; ++j) {
      const double here = length(k, j);
      if (here > most) {
        most = here;
        best = j;
      }
    }
    if (best == k) return;
    std::swap_ranges(qr_.col(k).data(), qr_.col(k).data() + m_, qr_.col(best).data());
    std::swap(order_[k], order_[best]);
  }

  void reflect(int k) {
    double* c = qr_.col(k).data() + k;
    const double tail = dot(c + 1, c + 1, m_ - k - 1);
    if (tail == 0.0) return;  // R's entry stands there already
    const double alpha = c[0];
    const double beta = -std::copysign(std::sqrt(alpha * alpha + tail), alpha);
    tau_[k] = (beta - alpha) / beta;
    for (int i = 1; i < m_ - k; ++i) c[i] /= alpha - beta;
    c[0] = beta;
    for (int j = k + 1; j < n_; ++j) apply(k, qr_.col(j).data());
  }

  /// Reflection k of a column of m entries.
  void apply(int k, double* column) const {
    if (tau_[k] == 0.0) return;
    const double* v = qr_.col(k).data() + k + 1;
    double* c = column + k;
    const double along = tau_[k] * (c[0] + dot(v, c + 1, m_ - k - 1));
    c[0] -= along;
    add(-along, v, c + 1, m_ - k - 1);
  }

  MatrixXd qr_;
  int m_, n_;
  std::vector<double> tau_;
  std::vector<int> order_;
};

}  // namespace

MatrixXd product(const MatrixXd& A, const MatrixXd& B) {
  MatrixXd C = MatrixXd::Zero(A.rows(), B.cols());
  const int m = static_cast<int>(A.rows()), inner = static_cast<int>(A.cols());
  for (int j = 0; j < B.cols(); ++j)
    add_columns(A.data(), m, inner, B.col(j).data(), 1, C.col(j).data());
  return C;
}

MatrixXd transposed_product(const MatrixXd& A, const MatrixXd& B) {
  return product(MatrixXd(A.transpose()), B);  // sums run over columns, which is quicker
}

VectorXd apply(const MatrixXd& A, const VectorXd& x) {
  VectorXd y = VectorXd::Zero(A.rows());
  for (int k = 0; k < A.cols(); ++k)
    add(x[k], A.col(k).data(), y.data(), static_cast<int>(A.rows()));
  return y;
}

VectorXd apply_transposed(const MatrixXd& A, const VectorXd& x) {
  VectorXd y(A.cols());
  for (int k = 0; k < A.cols(); ++k)
    y[k] = dot(A.col(k).data(), x.data(), static_cast<int>(A.rows()));
  return y;
}

VectorXd solve_positive(const MatrixXd& A, const VectorXd& b) {
  const int n = static_cast<int>(A.rows());
  MatrixXd L = A;
  VectorXd x = b;
  for (int k = 0; k < n; ++k) {
    if (!(L(k, k) > 0.0)) return VectorXd::Constant(n, kNan);
    const double pivot = std::sqrt(L(k, k));
    double* column = L.col(k).data();
    column[k] = pivot;
    for (int i = k + 1; i < n; ++i) column[i] /= pivot;
    for (int j = k + 1; j < n; ++j) add(-column[j], column + j, L.col(j).data() + j, n - j);
    x[k] /= pivot;
    add(-x[k], column + k + 1, x.data() + k + 1, n - k - 1);
  }
  for (int k = n - 1; k >= 0; --k) {
    const double* column = L.col(k).data();
    x[k] = (x[k] - dot(column + k + 1, x.data() + k + 1, n - k - 1)) / column[k];
  }
  return x;
}

Lu::Lu(const MatrixXd& A) : lu_(A), order_(A.rows()), norm_(one_norm(A)) {
  const int n = static_cast<int>(A.rows());
  std::iota(order_.begin(), order_.end(), 0);
  for (int k = 0; k < n; ++k) {
    double* column = lu_.col(k).data();
    int best = k;
    for (int i = k + 1; i < n; ++i)
      if (std::abs(column[i]) > std::abs(column[best])) best = i;
    if (best != k) {
      for (int j = 0; j < n; ++j) std::swap(lu_(k, j), lu_(best, j));
      std::swap(order_[k], order_[best]);
    }
    if (column[k] == 0.0) continue;
    for (int i = k + 1; i < n; ++i) column[i] /= column[k];
    for (int j = k + 1; j < n; ++j)
      add(-lu_(k, j), column + k + 1, lu_.col(j).data() + k + 1, n - k - 1);
  }
}

// Rows of the unknowns lie together, so that loops run over right-hand sides.
MatrixXd Lu::solve(const MatrixXd& B) const {
  const int n = static_cast<int>(lu_.rows()), width = static_cast<int>(B.cols());
  MatrixXd X(width, n);
  const MatrixXd negative = -lu_;
  for (int i = 0; i < n; ++i) {
    double* x = X.col(i).data();
    for (int j = 0; j < width; ++j) x[j] = B(order_[i], j);
    add_columns(X.data(), width, i, negative.data() + i, n, x);
  }
  for (int i = n - 1; i >= 0; --i) {
    double* x = X.col(i).data();
    add_columns(x + width, width, n - 1 - i, negative.data() + i + (i + 1) * n, n, x);
    for (int j = 0; j < width; ++j) x[j] /= lu_(i, i);
  }
  return X.transpose();
}

VectorXd Lu::solve_one(const double* b) const {
  const int n = static_cast<int>(lu_.rows());
  VectorXd x(n);
  for (int k = 0; k < n; ++k) x(k) = b[order_[k]];
  for (int k = 0; k < n; ++k) add(-x(k), lu_.col(k).data() + k + 1, x.data() + k + 1, n - k - 1);
  for (int k = n - 1; k >= 0; --k) {
    x(k) /= lu_(k, k);
    add(-x(k), lu_.col(k).data(), x.data(), k);
  }
  return x;
}

MatrixXd Lu::inverse() const { return solve(MatrixXd::Identity(lu_.rows(), lu_.rows())); }

double Lu::rcond(const MatrixXd& inverse) const { return 1.0 / (norm_ * one_norm(inverse)); }

double Lu::mean_log_pivot() const {
  double sum = 0.0;
  for (int k = 0; k < lu_.rows(); ++k) sum += std::log(std::abs(lu_(k, k)));
  return sum / static_cast<double>(lu_.rows());
}

int rank(const MatrixXd& A, double drop) { return A.cols() == 0 ? 0 : Qr(A, true).rank(drop); }

// With A P = Q (R; 0) of r rows and R' = S (T; 0):  P' x = S (T'^-1 (Q' b)_r; 0), least in norm.
VectorXd solve_least_norm(const MatrixXd& A, const VectorXd& b, double drop) {
  const int n = static_cast<int>(A.cols());
  const Qr rows(A, true);
  const int r = rows.rank(drop);
  VectorXd right = b;
  rows.into(right);
  MatrixXd flipped = MatrixXd::Zero(n, r);
  for (int i = 0; i < r; ++i)
    for (int j = i; j < n; ++j) flipped(j, i) = rows.at(i, j);
  const Qr columns(flipped, false);
  VectorXd z = VectorXd::Zero(n);
  for (int i = 0; i < r; ++i) {
    double left = right[i];
    for (int k = 0; k < i; ++k) left -= columns.at(k, i) * z[k];
    z[i] = left / columns.at(i, i);
  }
  columns.out_of(z);
  VectorXd x(n);
  for (int j = 0; j < n; ++j) x[rows.column(j)] = z[j];
  return x;
}

}  // namespace diffsim::dense
