#include "kernels/copter/riccati.h"

#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>
#include <vector>

#include "kernels/linalg/dense.h"

namespace diffsim {
namespace {

using dense::product;
using dense::transposed_product;
using Eigen::MatrixXd;

MatrixXd symmetric(const MatrixXd& X) { return 0.5 * (X + X.transpose()); }

double abscissa(const MatrixXd& A) {
  const dense::ComplexSchur schur = dense::complex_schur(A, false);
  if (!schur.converged) return std::numeric_limits<double>::quiet_NaN();
  double largest = -std::numeric_limits<double>::infinity();
  for (int i = 0; i < schur.n; ++i) largest = std::max(largest, schur.T[i * (schur.n + 1)].real());
  return largest;
}

/// |A'P + PA - PGP + Q| relative to the terms that cancel in it.
double relative_residual(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q,
                         const MatrixXd& P) {
  const MatrixXd AP = transposed_product(A, P), PGP = product(product(P, G), P);
  const double scale = 2.0 * AP.norm() + PGP.norm() + Q.norm();
  const double residual = (AP + AP.transpose() - PGP + Q).norm();
  return scale > 0.0 ? residual / scale : residual;
}

/// Geometric mean of the magnitudes of the closed loop's eigenvalues: those of the Hamiltonian are
/// the same and their mirror images.
double closed_loop_rate(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q) {
  const Eigen::Index n = A.rows();
  MatrixXd hamiltonian(2 * n, 2 * n);
  hamiltonian.topLeftCorner(n, n) = A;
  hamiltonian.topRightCorner(n, n) = -G;
  hamiltonian.bottomLeftCorner(n, n) = -Q;
  hamiltonian.bottomRightCorner(n, n) = -A.transpose();
  const double rate = std::exp(dense::Lu(hamiltonian).mean_log_pivot());
  return std::isfinite(rate) && rate > 0.0 ? rate : 1.0 + hamiltonian.norm();
}

/// Units d of the states, powers of two, that even out rows and columns of the Hamiltonian
/// (Osborne's balancing, with the costates in the inverse units).
Eigen::VectorXd balance(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q) {
  const Eigen::Index n = A.rows();
  Eigen::VectorXd d = Eigen::VectorXd::Ones(n);
  for (int sweep = 0; sweep < 20; ++sweep) {
    bool moved = false;
    for (Eigen::Index i = 0; i < n; ++i) {
      double rising = 0.0, falling = 0.0;
      for (Eigen::Index j = 0; j < n; ++j) {
        rising += std::abs(Q(i, j)) * d[i] * d[j];
        falling += std::abs(G(i, j)) / (d[i] * d[j]);
        if (j == i) continue;
        rising += std::abs(A(j, i)) * d[i] / d[j];
        falling += std::abs(A(i, j)) * d[j] / d[i];
      }
      if (!(rising > 0.0) || !(falling > 0.0)) continue;
      const int shift = static_cast<int>(std::lround(0.5 * std::log2(falling / rising)));
      if (shift == 0) continue;
      d[i] = std::ldexp(d[i], shift);
      moved = true;
    }
    if (!moved) break;
  }
  return d;
}

/// The Cayley transform with shift gamma, that starts the doubling; false where it is singular.
bool start_doubling(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q, double gamma,
                    MatrixXd& Ak, MatrixXd& Gk, MatrixXd& P) {
  const Eigen::Index n = A.rows();
  const MatrixXd identity = MatrixXd::Identity(n, n);
  const MatrixXd moved = A - gamma * identity;
  const dense::Lu shifted(moved);
  const MatrixXd shifted_inv = shifted.inverse();
  if (n > 0 && !(shifted.rcond(shifted_inv) > 1e-10)) return false;
  const MatrixXd inv_G = shifted.solve(G);
  const dense::Lu lu(moved.transpose() + product(Q, inv_G));
  const MatrixXd W_inv = lu.inverse();
  if (n > 0 && !(lu.rcond(W_inv) > 1e-14)) return false;
  Ak = identity + 2.0 * gamma * W_inv.transpose();
  Gk = symmetric(2.0 * gamma * product(inv_G, W_inv));
  P = symmetric(2.0 * gamma * product(product(W_inv, Q), shifted_inv));
  return true;
}

/// Doubles until P settles; returns the number of doublings.
int doubling(MatrixXd Ak, MatrixXd Gk, MatrixXd& P) {
  constexpr int kMaxDoublings = 60;
  const MatrixXd identity = MatrixXd::Identity(P.rows(), P.rows());
  for (int iter = 1; iter <= kMaxDoublings; ++iter) {
    const dense::Lu lu(identity + product(Gk, P));
    const MatrixXd inv_A = lu.solve(Ak);
    const MatrixXd inv_G = lu.solve(Gk);  // (I + G P)^-1 G = G (I + P G)^-1
    const MatrixXd step = symmetric(product(transposed_product(Ak, P), inv_A));
    Gk = symmetric(Gk + product(product(Ak, inv_G), MatrixXd(Ak.transpose())));
    Ak = product(Ak, inv_A);
    P += step;
    if (!P.allFinite()) return iter;
    if (step.norm() <= 1e-16 * P.norm()) return iter;
  }
  return kMaxDoublings;
}

using Complex = std::complex<double>;
using Columns = std::vector<Complex>;  // n x n, column-major

/// a b by the formula: std's looks for infinities as well.
Complex mul(Complex a, Complex b) {
  return {a.real() * b.real() - a.imag() * b.imag(), a.real() * b.imag() + a.imag() * b.real()};
}

/// Real and imaginary part, whose products are real ones.
struct Parts {
  MatrixXd real, imag;

  Parts(const Columns& X, int n) : real(n, n), imag(n, n) {
    for (std::size_t k = 0; k < X.size(); ++k) {
      real.data()[k] = X[k].real();
      imag.data()[k] = X[k].imag();
    }
  }
};

/// U* X U of a real X.
Columns turned(const Parts& U, const MatrixXd& X) {
  const MatrixXd a = product(X, U.real), b = product(X, U.imag);
  const MatrixXd left = U.real.transpose(), below = U.imag.transpose();
  const MatrixXd real = product(left, a) + product(below, b);
  const MatrixXd imag = product(left, b) - product(below, a);
  Columns out(static_cast<std::size_t>(X.size()));
  for (std::size_t k = 0; k < out.size(); ++k) out[k] = {real.data()[k], imag.data()[k]};
  return out;
}

/// Real part of U Y U*.
MatrixXd turned_back(const Parts& U, const Parts& Y) {
  const MatrixXd a = product(U.real, Y.real) - product(U.imag, Y.imag);
  const MatrixXd b = product(U.real, Y.imag) + product(U.imag, Y.real);
  return product(a, MatrixXd(U.real.transpose())) + product(b, MatrixXd(U.imag.transpose()));
}

}  // namespace

// T Y + Y T* = -U* Q U, column by column from the last.
bool solve_lyapunov(const MatrixXd& A, const MatrixXd& Q, MatrixXd& X) {
  const int n = static_cast<int>(A.rows());
  const dense::ComplexSchur schur = dense::complex_schur(A, true);
  if (!schur.converged) return false;
  const Columns& T = schur.T;
  double squares = 0.0;
  for (int j = 0; j < n; ++j)
    for (int i = 0; i <= j; ++i) squares += std::norm(T[i + j * n]);
  const double smallest = 1e-15 * std::sqrt(squares);
  const Parts U(schur.U, n);
  Columns Y = turned(U, -Q);
  for (int j = n - 1; j >= 0; --j) {
    Complex* y = Y.data() + j * n;
    for (int k = j + 1; k < n; ++k)
      for (int i = 0; i < n; ++i) y[i] -= mul(std::conj(T[j + k * n]), Y[i + k * n]);
    const Complex shift = std::conj(T[j + j * n]);
    for (int i = n - 1; i >= 0; --i) {
      const Complex pivot = T[i + i * n] + shift;
      if (!(std::abs(pivot) > smallest)) return false;
      y[i] /= pivot;
      for (int k = 0; k < i; ++k) y[k] -= mul(T[k + i * n], y[i]);
    }
  }
  X = turned_back(U, Parts(Y, n));
  return X.allFinite();
}

namespace {

CareReport solve_balanced(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q, MatrixXd& P) {
  CareReport report;
  MatrixXd Ak, Gk;
  double gamma = closed_loop_rate(A, G, Q);
  bool started = false;
  for (int attempt = 0; attempt < 8 && !started; ++attempt, gamma *= 1.37)  // not an eigenvalue
    started = start_doubling(A, G, Q, gamma, Ak, Gk, P);
  if (!started) {
    P = MatrixXd::Constant(A.rows(), A.rows(), std::numeric_limits<double>::quiet_NaN());
    report.residual = std::numeric_limits<double>::infinity();
    return report;
  }
  report.num_iters = doubling(Ak, Gk, P);
  if (!P.allFinite()) {
    report.residual = std::numeric_limits<double>::infinity();
    return report;
  }
  report.residual = relative_residual(A, G, Q, P);
  // Newton-Kleinman, down to rounding: what is left there lessens only by chance
  const double rounding = std::numeric_limits<double>::epsilon() * static_cast<double>(A.rows());
  for (int step = 0; step < 4 && report.residual > rounding; ++step) {
    const MatrixXd closed = A - product(G, P);
    MatrixXd next;
    if (!solve_lyapunov(closed.transpose(), Q + product(product(P, G), P), next)) break;
    next = symmetric(next);
    const double residual = relative_residual(A, G, Q, next);
    if (!(residual < report.residual)) break;
    P = next;
    report.residual = residual;
  }
  report.abscissa = abscissa(A - product(G, P));
  report.solved = report.residual < 1e-8 && report.abscissa < 0.0;
  return report;
}

}  // namespace

// With x = D z:  A -> D^-1 A D,  G -> D^-1 G D^-1,  Q -> D Q D,  P -> D P D, all exact.
CareReport solve_care(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q, MatrixXd& P) {
  const Eigen::VectorXd d = balance(A, G, Q), inv = d.cwiseInverse();
  const CareReport report =
      solve_balanced(inv.asDiagonal() * A * d.asDiagonal(), inv.asDiagonal() * G * inv.asDiagonal(),
                     d.asDiagonal() * Q * d.asDiagonal(), P);
  P = (inv.asDiagonal() * P * inv.asDiagonal()).eval();
  return report;
}

}  // namespace diffsim
