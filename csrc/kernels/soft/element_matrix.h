// Element matrices: K_ab = sum over samples of weight grad_a^T H grad_b, H = dP/dF.
#pragma once

#include <algorithm>

#include "kernels/soft/element_block.h"

namespace diffsim {

/// H[9 a + b] for a <= b of the samples of one group; the entries below the diagonal are not read.
struct GroupTangent {
  Native H[kParts][81];
};

/// Pairs of components i <= k, as a hexahedron's matrix is stored: six 8 x 8 matrices over nodes.
inline constexpr int kComponents[6][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}};
inline constexpr int kComponentPair[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

namespace detail {

// Rows [a0, a0 + kRows) of sum_r weighted[r][a] Y[r][b], for b from part kFirst on. One register
// holds kNativeLanes nodes b; kRows is such that the sums fit the registers there are.
constexpr int kMatrixRows = kNativeLanes;
template <int kFirst>
DIFFSIM_INLINE void node_products(const double (*weighted)[8], const Native (*Y)[kParts], int a0,
                                  double (*out)[8]) {
  Native total[kMatrixRows][kParts] = {};
  for (int r = 0; r < 24; ++r) {
#pragma GCC unroll 8
    for (int a = 0; a < kMatrixRows; ++a) {
      const Native w = broadcast<Native>(weighted[r][a0 + a]);
#pragma GCC unroll 8
      for (int part = kFirst; part < kParts; ++part) total[a][part] += w * Y[r][part];
    }
  }
#pragma GCC unroll 8
  for (int a = 0; a < kMatrixRows; ++a)
#pragma GCC unroll 8
    for (int part = kFirst; part < kParts; ++part)
      store(out[a0 + a] + part * kNativeLanes, total[a][part]);
}
template <int kFirst = 0>
DIFFSIM_INLINE void upper_products(const double (*weighted)[8], const Native (*Y)[kParts],
                                   double (*out)[8]) {
  node_products<kFirst>(weighted, Y, kFirst * kMatrixRows, out);
  if constexpr (kFirst + 1 < kParts) upper_products<kFirst + 1>(weighted, Y, out);
}

}  // namespace detail

constexpr std::int64_t kHexMatrixSize = 6 * 64;

/// Matrix of one hexahedron. Vectors run over nodes, not over samples, so that no sum over lanes is
/// left: with Y_b = H grad_b at each sample, K_ab is a product of two (24, 8) matrices for each
/// pair of components. Of pairs i = k only nodes a <= b are to be read.
/// @param[out] out (6, 8, 8): pair of components, nodes a and b
inline void element_matrix(const NodeShape& shape, const GroupTangent& tangent, double* out) {
  Native Y[24][kParts];
  for (int pair = 0; pair < 6; ++pair) {
    const int i = kComponents[pair][0], k = kComponents[pair][1];
    int entry[3][3];  // where d P_ij / d F_kl lies
    for (int j = 0; j < 3; ++j)
      for (int l = 0; l < 3; ++l) {
        const int row = 3 * i + j, col = 3 * k + l;
        entry[j][l] = (row <= col ? 9 * row + col : 9 * col + row) * kNativeLanes;
      }
    for (int q = 0; q < kLanes; ++q) {
      const double* H =
          reinterpret_cast<const double*>(tangent.H[q / kNativeLanes]) + q % kNativeLanes;
#pragma GCC unroll 8
      for (int part = 0; part < kParts; ++part) {
        Native grad[3];
        for (int l = 0; l < 3; ++l)
          grad[l] = load<Native>(shape.grad[3 * q + l] + part * kNativeLanes);
#pragma GCC unroll 3
        for (int j = 0; j < 3; ++j)
          Y[3 * q + j][part] = broadcast<Native>(H[entry[j][0]]) * grad[0] +
                               broadcast<Native>(H[entry[j][1]]) * grad[1] +
                               broadcast<Native>(H[entry[j][2]]) * grad[2];
      }
    }
    double (*K)[8] = reinterpret_cast<double (*)[8]>(out + 64 * pair);
    if (i == k)
      detail::upper_products(shape.weighted, Y, K);
    else
      for (int a = 0; a < 8; a += detail::kMatrixRows)
        detail::node_products<0>(shape.weighted, Y, a, K);
  }
}

/// Block (3, 3) of nodes a and b in a hexahedron's matrix; first and second are these two, least
/// first.
DIFFSIM_INLINE void element_block(const double* matrix, int a, int b, int first, int second,
                                  double block[9]) {
  // entries above, on and below the diagonal
  const double* from[3] = {matrix + 8 * a + b, matrix + 8 * first + second, matrix + 8 * b + a};
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      block[3 * i + k] = from[i < k ? 0 : i == k ? 1 : 2][64 * kComponentPair[i][k]];
}

/// Doubles of the matrices of eight elements side by side.
constexpr std::int64_t lane_matrix_size(int nodes) { return nodes * (nodes + 1) / 2 * 9 * kLanes; }

/// Matrices of eight elements side by side, one sample each.
/// @param[out] out (10, 36 or 55, 3, 3, 8): pair of nodes b (b + 1) / 2 + a for a <= b, block,
/// element
template <int kNodes>
void element_matrix(const GroupShape<kNodes>& shape, const GroupTangent& tangent, double* out) {
  for (int part = 0; part < kParts; ++part) {
    const Native* H = tangent.H[part];
    const Native weight = split(shape.weight, part);
    Native grad[kNodes][3];
    for (int a = 0; a < kNodes; ++a)
      for (int j = 0; j < 3; ++j) grad[a][j] = split(shape.grad[a][j], part);
    for (int b = 0; b < kNodes; ++b) {
      Native g[3], T[27];  // H grad_b, (i, j, k)
      for (int l = 0; l < 3; ++l) g[l] = weight * grad[b][l];
      for (int row = 0; row < 9; ++row)
        for (int k = 0; k < 3; ++k) {
          Native sum{};
          for (int l = 0; l < 3; ++l) {
            const int col = 3 * k + l;
            sum += H[row <= col ? 9 * row + col : 9 * col + row] * g[l];
          }
          T[3 * row + k] = sum;
        }
      for (int a = 0; a <= b; ++a) {
        double* block = out + 9 * (b * (b + 1) / 2 + a) * kLanes + part * kNativeLanes;
        for (int i = 0; i < 3; ++i)
          for (int k = 0; k < 3; ++k)
            store(block + (3 * i + k) * kLanes, grad[a][0] * T[9 * i + k] +
                                                    grad[a][1] * T[9 * i + 3 + k] +
                                                    grad[a][2] * T[9 * i + 6 + k]);
      }
    }
  }
}

}  // namespace diffsim
