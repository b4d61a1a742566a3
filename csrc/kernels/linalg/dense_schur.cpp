#include <algorithm>
#include <cmath>
#include <limits>

#include "kernels/linalg/dense.h"

namespace diffsim::dense {
namespace {

using Complex = std::complex<double>;

/// a b by the formula: std's looks for infinities as well.
inline Complex mul(Complex a, Complex b) {
  return {a.real() * b.real() - a.imag() * b.imag(), a.real() * b.imag() + a.imag() * b.real()};
}

inline double size(Complex a) { return std::abs(a.real()) + std::abs(a.imag()); }

/// The unitary (conj p, conj q; -q, p) / r, which takes (p, q) to (r, 0).
struct Givens {
  Complex p{1.0, 0.0}, q{0.0, 0.0};
  double r;

  Givens(Complex a, Complex b) : r(std::hypot(std::abs(a), std::abs(b))) {
    if (!(r > 0.0)) return;
    p = a / r;
    q = b / r;
  }

  void on_rows(Complex& above, Complex& below) const {
    const Complex a = above, b = below;
    above = mul(std::conj(p), a) + mul(std::conj(q), b);
    below = mul(p, b) - mul(q, a);
  }

  void on_columns(Complex* left, Complex* right, int n) const {
    for (int i = 0; i < n; ++i) {
      const Complex a = left[i], b = right[i];
      left[i] = mul(p, a) + mul(q, b);
      right[i] = mul(std::conj(p), b) - mul(std::conj(q), a);
    }
  }
};

class Iteration {
 public:
  Iteration(const MatrixXd& A, bool with_vectors) {
    out_.n = static_cast<int>(A.rows());
    MatrixXd H = A;
    MatrixXd Q = MatrixXd::Identity(out_.n, out_.n);
    for (int k = 0; k + 2 < out_.n; ++k) to_hessenberg(k, H, Q, with_vectors);
    out_.T.assign(H.data(), H.data() + H.size());
    if (with_vectors) out_.U.assign(Q.data(), Q.data() + Q.size());
  }

  ComplexSchur run() {
    constexpr int kMaxSweeps = 40;  // of one eigenvalue
    int last = out_.n - 1, sweeps = 0;
    while (last > 0) {
      int first = last;
      while (first > 0 && !splits(first)) --first;
      if (first == last) {
        --last;
        sweeps = 0;
        continue;
      }
      if (++sweeps > kMaxSweeps) return std::move(out_);
      sweep(first, last, shift(last, sweeps));
    }
    out_.converged = true;
    return std::move(out_);
  }

 private:
  Complex& t(int i, int j) { return out_.T[i + static_cast<std::size_t>(j) * out_.n]; }

  /// Householder reflection that clears column k below the subdiagonal, from both sides.
  static void to_hessenberg(int k, MatrixXd& H, MatrixXd& Q, bool with_vectors) {
    const int n = static_cast<int>(H.rows()), m = n - k - 1;
    VectorXd v = H.col(k).tail(m);
    double tail = 0.0;
    for (int i = 1; i < m; ++i) tail += v[i] * v[i];
    if (tail == 0.0) return;
    const double beta = -std::copysign(std::sqrt(v[0] * v[0] + tail), v[0]);
    const double tau = (beta - v[0]) / beta, head = v[0] - beta;
    v[0] = 1.0;
    for (int i = 1; i < m; ++i) v[i] /= head;
    for (int j = k; j < n; ++j) {
      double along = 0.0;
      for (int i = 0; i < m; ++i) along += v[i] * H(k + 1 + i, j);
      for (int i = 0; i < m; ++i) H(k + 1 + i, j) -= tau * along * v[i];
    }
    from_the_right(v, tau, k, H);
    if (with_vectors) from_the_right(v, tau, k, Q);
    for (int i = k + 2; i < n; ++i) H(i, k) = 0.0;
  }

  static void from_the_right(const VectorXd& v, double tau, int k, MatrixXd& X) {
    const int n = static_cast<int>(X.rows()), m = static_cast<int>(v.size());
    VectorXd along = VectorXd::Zero(n);
    for (int j = 0; j < m; ++j)
      for (int i = 0; i < n; ++i) along[i] += v[j] * X(i, k + 1 + j);
    for (int j = 0; j < m; ++j)
      for (int i = 0; i < n; ++i) X(i, k + 1 + j) -= tau * v[j] * along[i];
  }

  /// Whether the subdiagonal entry before i is nothing beside its neighbors; it becomes 0.
  bool splits(int i) {
    const double beside = size(t(i - 1, i - 1)) + size(t(i, i));
    if (!(size(t(i, i - 1)) <= std::numeric_limits<double>::epsilon() * beside)) return false;
    t(i, i - 1) = 0.0;
    return true;
  }

  /// Wilkinson's: the eigenvalue of the last two rows next to the last entry; now and then another.
  Complex shift(int last, int sweeps) {
    if (sweeps % 10 == 0)
      return std::abs(t(last, last - 1).real()) + std::abs(t(last - 1, last - 1).real());
    const Complex a = t(last - 1, last - 1), d = t(last, last);
    const Complex bc = mul(t(last - 1, last), t(last, last - 1));
    const Complex half = 0.5 * (a - d), root = std::sqrt(mul(half, half) + bc);
    // d - bc / (half +- root), with the sign that does not cancel
    const Complex far = size(half + root) > size(half - root) ? half + root : half - root;
    return size(far) > 0.0 ? d - bc / far : d;
  }

  void sweep(int first, int last, Complex shift) {
    const int n = out_.n;
    const bool with_vectors = !out_.U.empty();
    // without vectors the active block alone; what is beside it does not move its eigenvalues
    const int top = with_vectors ? 0 : first, right = with_vectors ? n : last + 1;
    for (int i = first; i < last; ++i) {
      const bool begins = i == first;
      const Givens turn(begins ? t(i, i) - shift : t(i, i - 1),
                        begins ? t(i + 1, i) : t(i + 1, i - 1));
      if (!begins) {
        t(i, i - 1) = turn.r;
        t(i + 1, i - 1) = 0.0;
      }
      for (int j = i; j < right; ++j) turn.on_rows(t(i, j), t(i + 1, j));
      turn.on_columns(&t(top, i), &t(top, i + 1), std::min(i + 2, last) + 1 - top);
      if (with_vectors) {
        Complex* column = out_.U.data() + static_cast<std::size_t>(i) * n;
        turn.on_columns(column, column + n, n);
      }
    }
  }

  ComplexSchur out_;
};

}  // namespace

ComplexSchur complex_schur(const MatrixXd& A, bool with_vectors) {
  return Iteration(A, with_vectors).run();
}

}  // namespace diffsim::dense
