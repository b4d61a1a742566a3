// Continuous-time Lyapunov and algebraic Riccati equations of small dense systems.
#pragma once

#include <Eigen/Core>

namespace diffsim {

/// X of A X + X A' + Q = 0 (Bartels-Stewart on the complex Schur form).
/// @return false if two eigenvalues of A add up to zero: no unique solution
bool solve_lyapunov(const Eigen::MatrixXd& A, const Eigen::MatrixXd& Q, Eigen::MatrixXd& X);

/// What solve_care did.
struct CareReport {
  bool solved = false;    ///< finite, residual small, closed loop stable
  int num_iters = 0;      ///< doublings
  double residual = 0.0;  ///< |A'P + PA - PGP + Q| over the sum of the norms of its terms
  double abscissa = 0.0;  ///< largest real part of an eigenvalue of A - G P [1/s]
};

/// The stabilizing P of A'P + P A - P G P + Q = 0, G = B R^-1 B': structured doubling (Chu, Fan,
/// Lin 2005), which needs no eigenvectors and so bears the integrator chains of a hover, and
/// Newton-Kleinman steps while they lessen the residual.
/// @param[in]  A (n, n) [1/s];  G, Q (n, n) symmetric positive semidefinite
/// @param[out] P (n, n) symmetric
CareReport solve_care(const Eigen::MatrixXd& A, const Eigen::MatrixXd& G, const Eigen::MatrixXd& Q,
                      Eigen::MatrixXd& P);

}  // namespace diffsim
