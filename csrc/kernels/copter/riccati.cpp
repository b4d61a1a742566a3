#include "kernels/copter/riccati.h"

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <cmath>
#include <limits>

namespace diffsim {
namespace {

using Eigen::MatrixXd;

MatrixXd symmetric(const MatrixXd& X) { return 0.5 * (X + X.transpose()); }

double abscissa(const MatrixXd& A) {
  return A.rows() == 0 ? -std::numeric_limits<double>::infinity()
                       : A.eigenvalues().real().maxCoeff();
}

/// |A'P + PA - PGP + Q| relative to the terms that cancel in it.
double relative_residual(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q,
                         const MatrixXd& P) {
  const MatrixXd AP = A.transpose() * P, PGP = P * G * P;
  const double scale = 2.0 * AP.norm() + PGP.norm() + Q.norm();
  const double residual = (AP + AP.transpose() - PGP + Q).norm();
  return scale > 0.0 ? residual / scale : residual;
}

/// Geometric mean of the magnitudes of the closed loop's eigenvalues: those of the Hamiltonian are
/// the same and their mirror images.
double closed_loop_rate(const MatrixXd& A, const MatrixXd& G, const MatrixXd& Q) {
  const Eigen::Index n = A.rows();
  MatrixXd hamiltonian(2 * n, 2 * n);
  hamiltonian << A, -G, -Q, -A.transpose();
  const Eigen::PartialPivLU<MatrixXd> lu(hamiltonian);
  const double logs = lu.matrixLU().diagonal().array().abs().log().mean();
  const double rate = std::exp(logs);
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
  const Eigen::PartialPivLU<MatrixXd> shifted(A - gamma * identity);
  if (n > 0 && !(shifted.rcond() > 1e-10)) return false;
  const MatrixXd inv_G = shifted.solve(G);
  const MatrixXd W = (A - gamma * identity).transpose() + Q * inv_G;
  const Eigen::PartialPivLU<MatrixXd> lu(W);
  if (n > 0 && !(lu.rcond() > 1e-14)) return false;
  const MatrixXd W_inv = lu.inverse();
  Ak = identity + 2.0 * gamma * W_inv.transpose();
  Gk = symmetric(2.0 * gamma * inv_G * W_inv);
  P = symmetric(2.0 * gamma * W_inv * Q * shifted.inverse());
  return true;
}

/// Doubles until P settles; returns the number of doublings.
int doubling(MatrixXd Ak, MatrixXd Gk, MatrixXd& P) {
  constexpr int kMaxDoublings = 60;
  const MatrixXd identity = MatrixXd::Identity(P.rows(), P.rows());
  for (int iter = 1; iter <= kMaxDoublings; ++iter) {
    const Eigen::PartialPivLU<MatrixXd> lu(identity + Gk * P);
    const MatrixXd inv_A = lu.solve(Ak);
    const MatrixXd inv_G = lu.solve(Gk);  // (I + G P)^-1 G = G (I + P G)^-1
    const MatrixXd step = symmetric(Ak.transpose() * P * inv_A);
    Gk = symmetric(Gk + Ak * inv_G * Ak.transpose());
    Ak = Ak * inv_A;
    P += step;
    if (!P.allFinite()) return iter;
    if (step.norm() <= 1e-16 * P.norm()) return iter;
  }
  return kMaxDoublings;
}

}  // namespace

bool solve_lyapunov(const MatrixXd& A, const MatrixXd& Q, MatrixXd& X) {
  const Eigen::Index n = A.rows();
  if (n == 0) {
    X.resize(0, 0);
    return true;
  }
  const Eigen::ComplexSchur<MatrixXd> schur(A);
  if (schur.info() != Eigen::Success) return false;
  const Eigen::MatrixXcd& T = schur.matrixT();
  const Eigen::MatrixXcd& U = schur.matrixU();
  const double smallest = 1e-15 * T.norm();
  // T Y + Y T* = -U* Q U, column by column from the last.
  Eigen::MatrixXcd Y = -(U.adjoint() * Q * U);
  for (Eigen::Index j = n - 1; j >= 0; --j) {
    for (Eigen::Index k = j + 1; k < n; ++k) Y.col(j) -= std::conj(T(j, k)) * Y.col(k);
    Eigen::MatrixXcd shifted = T;
    shifted.diagonal().array() += std::conj(T(j, j));
    if (!(shifted.diagonal().cwiseAbs().minCoeff() > smallest)) return false;
    Y.col(j) = shifted.triangularView<Eigen::Upper>().solve(Y.col(j));
  }
  X = (U * Y * U.adjoint()).real();
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
  for (int step = 0; step < 4; ++step) {  // Newton-Kleinman
    const MatrixXd closed = A - G * P;
    MatrixXd next;
    if (!solve_lyapunov(closed.transpose(), Q + P * G * P, next)) break;
    next = symmetric(next);
    const double residual = relative_residual(A, G, Q, next);
    if (!(residual < report.residual)) break;
    P = next;
    report.residual = residual;
  }
  report.abscissa = abscissa(A - G * P);
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
