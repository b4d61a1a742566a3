// Hexahedra of projective dynamics on the device: one thread a sample, 16 elements a block.
#pragma once

#include "device.cuh"

namespace study {

constexpr int kElementsOfBlock = 16, kSamples = 8, kSampleThreads = kElementsOfBlock * kSamples;
constexpr int kPairs = 36;   // of nodes a <= b
constexpr int kUnique = 45;  // entries of a symmetric 9 x 9 matrix
constexpr int kVector = 24;  // forces of an element

/// What elements of one shape share.
struct ElementTable {
  double grad[8][8][3], weight[8], w_mu, w_vol;
};

/// Where d P_a / d F_b lies, a <= b.
__host__ __device__ constexpr int packed(int a, int b) {
  const int low = a < b ? a : b, high = a < b ? b : a;
  return low * 9 - low * (low - 1) / 2 + high - low;
}
/// Place of a pair of nodes a <= b.
__host__ __device__ constexpr int pair_place(int a, int b) { return b * (b + 1) / 2 + a; }

__device__ inline void turn(double S[9], double V[9], int p, int q) {
  const double apq = S[3 * p + q];
  if (fabs(apq) < 1e-300) return;
  const double theta = 0.5 * (S[4 * q] - S[4 * p]) / apq;
  const double t = copysign(1.0, theta) / (fabs(theta) + sqrt(1.0 + theta * theta));
  const double c = rsqrt(1.0 + t * t), s = t * c;
  const int k = 3 - p - q;
  const double akp = S[3 * k + p], akq = S[3 * k + q];
  S[4 * p] -= t * apq, S[4 * q] += t * apq;
  S[3 * p + q] = S[3 * q + p] = 0.0;
  S[3 * k + p] = S[3 * p + k] = c * akp - s * akq;
  S[3 * k + q] = S[3 * q + k] = s * akp + c * akq;
  for (int i = 0; i < 3; ++i) {
    const double vp = V[3 * i + p], vq = V[3 * i + q];
    V[3 * i + p] = c * vp - s * vq, V[3 * i + q] = s * vp + c * vq;
  }
}
__device__ inline void order(double S[9], double V[9], int p, int q) {
  if (S[4 * p] >= S[4 * q]) return;
  const double s = S[4 * p];
  S[4 * p] = S[4 * q], S[4 * q] = s;
  for (int i = 0; i < 3; ++i) {  // a turn by 90 degrees
    const double v = V[3 * i + p];
    V[3 * i + p] = V[3 * i + q], V[3 * i + q] = -v;
  }
}

/// F = U diag(s) V^T with rotations U, V and s0 >= s1 >= |s2|.
__device__ inline void principal(const double F[9], double U[9], double s[3], double V[9]) {
  double S[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      S[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
  for (int i = 0; i < 9; ++i) V[i] = i % 4 == 0 ? 1.0 : 0.0;
  const double trace = S[0] + S[4] + S[8];
  for (int sweep = 0; sweep < 10; ++sweep) {
    const double off = fabs(S[1]) + fabs(S[2]) + fabs(S[5]);
    if (!(off > 1e-16 * trace)) break;
    turn(S, V, 0, 1);
    turn(S, V, 0, 2);
    turn(S, V, 1, 2);
  }
  order(S, V, 0, 1);
  order(S, V, 1, 2);
  order(S, V, 0, 1);
  double B[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      B[3 * i + j] = F[3 * i] * V[j] + F[3 * i + 1] * V[3 + j] + F[3 * i + 2] * V[6 + j];
  s[0] = sqrt(B[0] * B[0] + B[3] * B[3] + B[6] * B[6]);
  double u0[3], u1[3];
  for (int i = 0; i < 3; ++i) u0[i] = B[3 * i] / s[0];
  const double along = u0[0] * B[1] + u0[1] * B[4] + u0[2] * B[7];
  for (int i = 0; i < 3; ++i) u1[i] = B[3 * i + 1] - along * u0[i];
  s[1] = sqrt(u1[0] * u1[0] + u1[1] * u1[1] + u1[2] * u1[2]);
  for (int i = 0; i < 3; ++i) u1[i] /= s[1];
  s[2] = 0.0;
  for (int i = 0; i < 3; ++i) {
    const int p = (i + 1) % 3, q = (i + 2) % 3;
    const double u2 = u0[p] * u1[q] - u0[q] * u1[p];
    U[3 * i] = u0[i], U[3 * i + 1] = u1[i], U[3 * i + 2] = u2;
    s[2] += u2 * B[3 * i + 2];
  }
}

/// As project_volume of csrc/kernels/soft/pd_material.h, of one sample.
__device__ inline void project_volume(const double s[3], double t[3], double q[3]) {
  const double d0 = (s[0] - s[2]) * (s[0] + s[2]), d1 = (s[1] - s[2]) * (s[1] + s[2]);
  double low = 0.0, high = 1e300, u = fmax(s[2], 0.3);
  bool last = false;
  for (int iter = 0;; ++iter) {
    q[2] = 2.0 * u - s[2];
    q[0] = fmax(sqrt(fmax(d0 + q[2] * q[2], 0.0)), 1e-12);
    q[1] = fmax(sqrt(fmax(d1 + q[2] * q[2], 0.0)), 1e-12);
    t[0] = 0.5 * (s[0] + q[0]), t[1] = 0.5 * (s[1] + q[1]), t[2] = u;
    if (last || iter == 60) return;
    const double value = u * t[0] * t[1] - 1.0, q01 = q[0] * q[1];
    last = !(fabs(value) > 1e-8);
    if (value < 0.0)
      low = u;
    else
      high = u;
    const double newton =
        u - value * q01 / (t[0] * t[1] * q01 + u * q[2] * (t[1] * q[1] + t[0] * q[0]));
    const double bisect = high > 1e299 ? 2.0 * u : 0.5 * (low + high);
    u = last || (low < newton && newton < high) ? newton : bisect;
  }
}

struct Sample {
  double U[9], s[3], V[9], t[3], q[3];
};

__device__ inline Sample sample_of(const ElementTable& table, const int* node, int q,
                                   const double* x) {
  double F[9] = {};
  for (int a = 0; a < 8; ++a)
    for (int i = 0; i < 3; ++i) {
      const double v = x[3 * node[a] + i];
      for (int j = 0; j < 3; ++j) F[3 * i + j] += v * table.grad[q][a][j];
    }
  Sample sample;
  principal(F, sample.U, sample.s, sample.V);
  project_volume(sample.s, sample.t, sample.q);
  return sample;
}

/// P [Pa] and the energy density [J/m^3].
__device__ inline double stress(const ElementTable& table, const Sample& p, double P[9]) {
  double d[3], corotated = 0.0, volume = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double a = p.s[i] - 1.0, b = p.s[i] - p.t[i];
    d[i] = table.w_mu * a + table.w_vol * b;
    corotated += a * a, volume += b * b;
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      P[3 * i + j] = p.U[3 * i] * d[0] * p.V[3 * j] + p.U[3 * i + 1] * d[1] * p.V[3 * j + 1] +
                     p.U[3 * i + 2] * d[2] * p.V[3 * j + 2];
  return 0.5 * (table.w_mu * corotated + table.w_vol * volume);
}

/// As PdMaterial::tangent and expand_tangent: out[packed(a, b) * stride].
__device__ inline void tangent(const ElementTable& table, const Sample& p, double* out,
                               int stride) {
  const double r0 = 1.0 / (p.t[0] * p.q[0]), r1 = 1.0 / (p.t[1] * p.q[1]);
  const double iq[2] = {p.t[0] * r0, p.t[1] * r1}, it[2] = {p.q[0] * r0, p.q[1] * r1};
  const double q2t2 = p.q[2] * p.t[2], inverse = 1.0 / (1.0 + q2t2 * (r0 + r1));
  const double g[3] = {q2t2 * iq[0] * inverse, q2t2 * iq[1] * inverse, p.t[2] * inverse};
  double diagonal[9], sym_c[3], skw_c[3];
  for (int j = 0; j < 3; ++j) {
    double dt[3];
    for (int i = 0; i < 2; ++i) dt[i] = ((i == j ? p.t[i] : 0.0) - g[j]) * iq[i];
    dt[2] = -p.t[2] * (dt[0] * it[0] + dt[1] * it[1]);
    for (int i = 0; i < 3; ++i)
      diagonal[3 * i + j] = (i == j ? table.w_mu + table.w_vol : 0.0) - table.w_vol * dt[i];
  }
  constexpr int pair[3][2] = {{0, 1}, {0, 2}, {1, 2}};
  for (int k = 0; k < 3; ++k) {
    const int i = pair[k][0], j = pair[k][1];
    const double t = p.t[i] + p.t[j], over = 1.0 / fmax(p.s[i] + p.s[j], 1e-12);
    const double q = p.q[i] + p.q[j];
    sym_c[k] = table.w_mu + table.w_vol * (1.0 - t / (fabs(q) < 1e-12 ? 1e-12 : q));
    skw_c[k] = table.w_mu * (1.0 - 2.0 * over) + table.w_vol * (1.0 - t * over);
  }
#pragma unroll
  for (int a = 0; a < 9; ++a) {
    const int ia = a / 3, ja = a % 3;
    double e[3], sym[3], skw[3];
    for (int i = 0; i < 3; ++i) {
      e[i] = 0.0;
      for (int j = 0; j < 3; ++j) e[i] += diagonal[3 * j + i] * p.U[3 * ia + j] * p.V[3 * ja + j];
    }
    for (int k = 0; k < 3; ++k) {
      const int i = pair[k][0], j = pair[k][1];
      const double ij = p.U[3 * ia + i] * p.V[3 * ja + j], ji = p.U[3 * ia + j] * p.V[3 * ja + i];
      sym[k] = 0.5 * sym_c[k] * (ij + ji), skw[k] = 0.5 * skw_c[k] * (ij - ji);
    }
#pragma unroll
    for (int b = a; b < 9; ++b) {
      const int ib = b / 3, jb = b % 3;
      double total = 0.0;
      for (int i = 0; i < 3; ++i) total += e[i] * p.U[3 * ib + i] * p.V[3 * jb + i];
      for (int k = 0; k < 3; ++k) {
        const int i = pair[k][0], j = pair[k][1];
        const double ij = p.U[3 * ib + i] * p.V[3 * jb + j];
        const double ji = p.U[3 * ib + j] * p.V[3 * jb + i];
        total += sym[k] * (ij + ji) + skw[k] * (ij - ji);
      }
      out[packed(a, b) * stride] = total;
    }
  }
}

/// The table in memory that a block shares.
__device__ inline void take_table(const ElementTable* table, ElementTable& shared) {
  for (int k = threadIdx.x; k < int(sizeof(ElementTable) / 8); k += blockDim.x)
    reinterpret_cast<double*>(&shared)[k] = reinterpret_cast<const double*>(table)[k];
  __syncthreads();
}

/// Forces (elements, 8, 3) and energies (blocks,); blockIdx.y is the member of a batch.
__global__ void __launch_bounds__(kSampleThreads)
    element_forces(const ElementTable* table, const int* elements, int count, const double* x,
                   std::size_t x_stride, double* forces, double* energy) {
  __shared__ double P[9][kSampleThreads + 1];
  __shared__ ElementTable shared;
  take_table(table, shared);
  const std::size_t member = blockIdx.y;
  const int first = blockIdx.x * kElementsOfBlock;
  const int e = first + threadIdx.x / kSamples, q = threadIdx.x % kSamples;
  double psi = 0.0, own[9] = {};
  if (e < count) {
    const Sample sample = sample_of(shared, elements + 8 * e, q, x + member * x_stride);
    psi = shared.weight[q] * stress(shared, sample, own);
  }
  for (int k = 0; k < 9; ++k) P[k][threadIdx.x] = own[k] * shared.weight[q];
  psi = block_sum(psi);
  if (energy && threadIdx.x == 0) energy[member * gridDim.x + blockIdx.x] = psi;
  __syncthreads();
  for (int task = threadIdx.x; task < kElementsOfBlock * kVector; task += blockDim.x) {
    const int local = task / kVector, a = task % kVector / 3, i = task % 3;
    if (first + local >= count) break;
    double total = 0.0;
    for (int s = 0; s < kSamples; ++s)
      for (int j = 0; j < 3; ++j)
        total += P[3 * i + j][local * kSamples + s] * shared.grad[s][a][j];
    forces[(member * count + first + local) * kVector + 3 * a + i] = total;
  }
}

/// Matrices (elements, 36, 3, 3) of pairs of nodes.
__global__ void __launch_bounds__(kSampleThreads)
    element_matrices(const ElementTable* table, const int* elements, int count, const double* x,
                     std::size_t x_stride, double* matrices) {
  extern __shared__ double H[];  // (45, threads)
  __shared__ ElementTable shared;
  take_table(table, shared);
  const std::size_t member = blockIdx.y;
  const int first = blockIdx.x * kElementsOfBlock;
  const int e = first + threadIdx.x / kSamples, q = threadIdx.x % kSamples;
  if (e < count) {
    const Sample sample = sample_of(shared, elements + 8 * e, q, x + member * x_stride);
    tangent(shared, sample, H + threadIdx.x, kSampleThreads);
  }
  __syncthreads();
  for (int task = threadIdx.x; task < kElementsOfBlock * kPairs; task += blockDim.x) {
    const int local = task / kPairs, pair = task % kPairs;
    if (first + local >= count) break;
    int b = 0;
    while (pair_place(0, b + 1) <= pair) ++b;
    const int a = pair - pair_place(0, b);
    double K[9] = {};
    for (int s = 0; s < kSamples; ++s) {
      const double* h = H + local * kSamples + s;
      const double w = shared.weight[s];
      const double* ga = shared.grad[s][a];
      const double* gb = shared.grad[s][b];
#pragma unroll
      for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int k = 0; k < 3; ++k) {
          double total = 0.0;
#pragma unroll
          for (int j = 0; j < 3; ++j)
            total += ga[j] * (h[packed(3 * i + j, 3 * k) * kSampleThreads] * gb[0] +
                              h[packed(3 * i + j, 3 * k + 1) * kSampleThreads] * gb[1] +
                              h[packed(3 * i + j, 3 * k + 2) * kSampleThreads] * gb[2]);
          K[3 * i + k] += w * total;
        }
    }
    double* out = matrices + ((member * count + first + local) * kPairs + pair) * 9;
    for (int k = 0; k < 9; ++k) out[k] = K[k];
  }
}

/// Where what elements leave is added up, in their order: no atomic sums, the same bits each time.
struct Gather {
  std::vector<int> start, item;

  /// Of nodes: items are element * 8 + node.
  static Gather nodes(const std::vector<int>& elements, int num_nodes) {
    Gather g;
    std::vector<std::vector<int>> of(static_cast<std::size_t>(num_nodes));
    for (std::size_t k = 0; k < elements.size(); ++k) of[elements[k]].push_back(int(k));
    g.fill(of);
    return g;
  }
  /// Of blocks of a matrix: items are (element * 36 + pair) * 2 + whether transposed.
  static Gather blocks(const std::vector<int>& elements, const std::vector<int>& start,
                       const std::vector<int>& column) {
    Gather g;
    std::vector<std::vector<int>> of(column.size());
    const int count = int(elements.size() / 8);
    for (int e = 0; e < count; ++e)
      for (int b = 0; b < 8; ++b)
        for (int a = 0; a <= b; ++a) {
          const int i = elements[8 * e + a], j = elements[8 * e + b];
          const int item = (e * kPairs + pair_place(a, b)) * 2;
          of[place(start, column, i, j)].push_back(item);
          if (a != b) of[place(start, column, j, i)].push_back(item + 1);
        }
    g.fill(of);
    return g;
  }
  static int place(const std::vector<int>& start, const std::vector<int>& column, int i, int j) {
    return int(std::lower_bound(column.begin() + start[i], column.begin() + start[i + 1], j) -
               column.begin());
  }

 private:
  void fill(const std::vector<std::vector<int>>& of) {
    start.assign(1, 0);
    for (const auto& items : of) {
      item.insert(item.end(), items.begin(), items.end());
      start.push_back(int(item.size()));
    }
  }
};

}  // namespace study
