// svd3, polar3 and their derivatives over arrays of 3x3 matrices.
//
// Matrices are (n, 3, 3) row-major; every output is overwritten. Results do not depend on
// num_threads, nor those of one matrix on its neighbors.
#pragma once

#include <cstdint>

namespace diffsim {

/// F = U diag(s) V^T, see svd3.h.
/// @param[in]  F (n, 3, 3)
/// @param[out] U (n, 3, 3)  rotations
/// @param[out] s (n, 3)     s0 >= s1 >= |s2|, sign(s2) = sign(det F)
/// @param[out] V (n, 3, 3)  rotations
void batched_svd3(const double* F, std::int64_t n, double* U, double* s, double* V,
                  int num_threads);

/// dL/dF (n, 3, 3) from dL/dU, dL/ds, dL/dV, see svd3_vjp.h.
void batched_svd3_vjp(const double* U, const double* s, const double* V, const double* grad_U,
                      const double* grad_s, const double* grad_V, std::int64_t n, double* grad_F,
                      int num_threads);

/// The rotations R (n, 3, 3) nearest to F (n, 3, 3).
void batched_polar3(const double* F, std::int64_t n, double* R, int num_threads);

/// dL/dF (n, 3, 3) from dL/dR (n, 3, 3), see svd3_vjp.h.
void batched_polar3_vjp(const double* F, const double* R, const double* grad_R, std::int64_t n,
                        double* grad_F, int num_threads);

}  // namespace diffsim
