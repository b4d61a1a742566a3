// The multigrid of csrc/kernels/linalg/rigid_multigrid.h on the device: patterns from the host,
// numbers made here, float32. Sums of products go over lists made once, in a fixed order.
#pragma once

#include <memory>

#include "device.cuh"
#include "scene.h"

namespace study {

constexpr int kRowLanes = 30;  // of a warp's 32: a multiple of 3 and of 6 rows of a block
constexpr float kSmoothedRange = 0.1F, kEigenvalueMargin = 1.1F, kLeastDiagonal = 1e-5F;
constexpr float kProlongationDamping = 4.0F / 3.0F;
constexpr int kFirstPowers = 8, kDegree = 2;

/// Row `row` of a matrix of blocks (K, K), column-major, times x: lane r < K of a warp has entry r.
template <int K, typename T>
__device__ T warp_row(const int* __restrict__ start, const int* __restrict__ column,
                      const T* __restrict__ values, const T* x, int row) {
  const int lane = threadIdx.x % 32;
  const std::size_t begin = std::size_t(start[row]) * K * K;
  const int count = (start[row + 1] - start[row]) * K * K;
  T total = 0;
  if (lane < kRowLanes)
#pragma unroll 4
    for (int k = lane; k < count; k += kRowLanes) {
      const int entry = start[row] + k / (K * K), c = k % (K * K) / K;
      total += values[begin + k] * x[K * column[entry] + c];
    }
  T sum = 0;
  for (int k = 0; k < kRowLanes / K; ++k)
    sum += __shfl_sync(0xffffffffU, total, (lane % K) + K * k);
  return sum;
}
/// A block (K, K) row-major times what lanes r < K of a warp have.
template <int K>
__device__ float warp_scale(const float* block, float r) {
  const int lane = threadIdx.x % 32, k = lane % K;
  float total = 0.0F;
  for (int m = 0; m < K; ++m) total += block[K * k + m] * __shfl_sync(0xffffffffU, r, m);
  return total;
}

struct LevelView {
  int rows;
  const int *start, *column;
  const float *matrix, *inverse;
  const float* largest;
  float *x, *b, *residual, *step, *next;
};

struct Chebyshev {
  float center, radius, sigma;
  __device__ explicit Chebyshev(float largest)
      : center(0.5F * (1.0F + kSmoothedRange) * largest),
        radius(0.5F * (1.0F - kSmoothedRange) * largest),
        sigma(center / radius) {}
};

/// The three passes of the smoother (rigid_multigrid.cpp, smooth()).
template <int K>
__global__ void smooth_first(LevelView v, bool from_zero) {
  const int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
  if (row >= v.rows) return;
  const int i = K * row + lane % K;
  float r = v.b[i];
  if (!from_zero) r -= warp_row<K>(v.start, v.column, v.matrix, v.x, row);
  const float z = warp_scale<K>(v.inverse + K * K * row, r);
  if (lane < K) v.residual[i] = r, v.step[i] = z / Chebyshev(*v.largest).center;
}
template <int K>
__global__ void smooth_next(LevelView v, bool at_zero) {
  const int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
  if (row >= v.rows) return;
  const int i = K * row + lane % K;
  const Chebyshev c(*v.largest);
  const float rho = 1.0F / c.sigma, factor = 1.0F / (2.0F * c.sigma - rho);
  const float r = v.residual[i] - warp_row<K>(v.start, v.column, v.matrix, v.step, row);
  const float z = warp_scale<K>(v.inverse + K * K * row, r);
  if (lane >= K) return;
  v.residual[i] = r;
  v.x[i] = (at_zero ? 0.0F : v.x[i]) + v.step[i];
  v.next[i] = factor * rho * v.step[i] + 2.0F * factor / c.radius * z;
}
/// With `keep_residual`, of x after the step.
template <int K>
__global__ void smooth_last(LevelView v, bool keep_residual) {
  const int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
  if (row >= v.rows) return;
  const int i = K * row + lane % K;
  float r = 0.0F;
  if (keep_residual) r = v.residual[i] - warp_row<K>(v.start, v.column, v.matrix, v.next, row);
  if (lane >= K) return;
  v.x[i] += v.next[i];
  if (keep_residual) v.residual[i] = r;
}

struct TransferView {
  int coarse_rows, fine_rows;
  const int *p_start, *p_column, *r_start, *r_node, *r_entry;
  const float* prolongation;
};

template <int K>
__global__ void restrict_residual(TransferView t, const float* residual, float* b) {
  const int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
  if (row >= t.coarse_rows) return;
  const int begin = t.r_start[row], count = (t.r_start[row + 1] - begin) * K * 6;
  float total = 0.0F;
  if (lane < kRowLanes)
    for (int k = lane; k < count; k += kRowLanes) {
      const int entry = begin + k / (6 * K), at = k % (6 * K);
      total += t.prolongation[std::size_t(t.r_entry[entry]) * 6 * K + at] *
               residual[K * t.r_node[entry] + at / 6];
    }
  float sum = 0.0F;
  for (int k = 0; k < kRowLanes / 6; ++k) sum += __shfl_sync(0xffffffffU, total, lane % 6 + 6 * k);
  if (lane < 6) b[6 * row + lane] = sum;
}

template <int K>
__global__ void prolong(TransferView t, const float* coarse, float* x) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x, row = i / K, k = i % K;
  if (row >= t.fine_rows) return;
  float total = 0.0F;
  for (int e = t.p_start[row]; e < t.p_start[row + 1]; ++e)
    for (int c = 0; c < 6; ++c)
      total += t.prolongation[(std::size_t(e) * K + k) * 6 + c] * coarse[6 * t.p_column[e] + c];
  x[i] += total;
}

/// z = (dense inverse, (n, n)) b by one block.
__global__ void coarsest_solve(int n, const double* inverse, const float* b, float* x) {
  for (int i = threadIdx.x / 32; i < n; i += blockDim.x / 32) {
    double total = 0.0;
    for (int k = threadIdx.x % 32; k < n; k += 32) total += inverse[std::size_t(i) * n + k] * b[k];
    total = warp_sum(total);
    if (threadIdx.x % 32 == 0) x[i] = float(total);
  }
}

// --- making the numbers ---

__global__ void to_float(std::size_t count, const double* from, float* to) {
  const std::size_t k = blockIdx.x * std::size_t(blockDim.x) + threadIdx.x;
  if (k < count) to[k] = float(from[k]);
}

template <int K>
__global__ void invert_diagonal(int rows, const int* diagonal, const float* matrix,
                                const std::uint8_t* fixed, float* inverse) {
  const int row = blockIdx.x * blockDim.x + threadIdx.x;
  if (row >= rows) return;
  double A[K][K], B[K][K];
  const float* block = matrix + std::size_t(diagonal[row]) * K * K;
  for (int i = 0; i < K; ++i)
    for (int k = 0; k < K; ++k) {
      const bool held = fixed && (fixed[K * row + i] || fixed[K * row + k]);
      A[i][k] = held ? (i == k) : double(block[K * k + i]);
      B[i][k] = i == k;
    }
  for (int p = 0; p < K; ++p) {
    const double over = 1.0 / A[p][p];
    for (int k = 0; k < K; ++k) A[p][k] *= over, B[p][k] *= over;
    for (int i = 0; i < K; ++i) {
      if (i == p) continue;
      const double f = A[i][p];
      for (int k = 0; k < K; ++k) A[i][k] -= f * A[p][k], B[i][k] -= f * B[p][k];
    }
  }
  for (int i = 0; i < K; ++i)
    for (int k = 0; k < K; ++k) {
      const bool held = fixed && (fixed[K * row + i] || fixed[K * row + k]);
      inverse[(std::size_t(row) * K + i) * K + k] = held ? 0.0F : float(B[i][k]);
    }
}

/// image = inverse A mode, and sums of squares (before, after) of blocks.
template <int K>
__global__ void power(LevelView v, const float* mode, float* image, double* squares) {
  const int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
  double before = 0.0, after = 0.0;
  if (row < v.rows) {
    const int i = K * row + lane % K;
    const float y = warp_row<K>(v.start, v.column, v.matrix, mode, row);
    const float z = warp_scale<K>(v.inverse + K * K * row, y);
    if (lane < K) {
      image[i] = z;
      before = double(mode[i]) * mode[i], after = double(z) * z;
    }
  }
  before = block_sum(before), after = block_sum(after);
  if (threadIdx.x == 0) squares[2 * blockIdx.x] = before, squares[2 * blockIdx.x + 1] = after;
}
/// One block: the eigenvalue, and the factor that makes the image a unit vector.
__global__ void power_norm(int blocks, const double* squares, float* largest, float* norm) {
  double before = 0.0, after = 0.0;
  for (int k = threadIdx.x; k < blocks; k += blockDim.x)
    before += squares[2 * k], after += squares[2 * k + 1];
  before = block_sum(before), after = block_sum(after);
  if (threadIdx.x == 0)
    *largest = kEigenvalueMargin * float(sqrt(after / before)), *norm = float(1.0 / sqrt(after));
}
/// Numbers in (-0.5, 0.5) by a hash of their places.
__global__ void start_mode(int count, float* mode) {
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k >= count) return;
  std::uint64_t random = 6364136223846793005ULL * (k + 1ULL) + 1442695040888963407ULL;
  random = 6364136223846793005ULL * (random ^ random >> 29) + 1442695040888963407ULL;
  mode[k] = float(double(random >> 11) * 0x1p-53 - 0.5);
}
__global__ void scale_mode(int count, const float* image, const float* norm, float* mode) {
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k < count) mode[k] = *norm * image[k];
}

__global__ void place_aggregates(int count, const int* start, const int* node, const double* fine,
                                 double* coarse) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  for (int k = 0; k < 3; ++k) {
    double total = 0.0;
    for (int e = start[i]; e < start[i + 1]; ++e) total += fine[3 * node[e] + k];
    coarse[3 * i + k] = total / (start[i + 1] - start[i]);
  }
}
constexpr int kLengthBlocks = 128;
__global__ void aggregate_squares(int nodes, const int* aggregate, const double* fine,
                                  const double* coarse, double* partial) {
  double square = 0.0;
  for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < nodes; i += gridDim.x * blockDim.x)
    for (int k = 0; k < 3; ++k) {
      const double d = fine[3 * i + k] - coarse[3 * aggregate[i] + k];
      square += d * d;
    }
  square = block_sum(square);
  if (threadIdx.x == 0) partial[blockIdx.x] = square;
}
/// One block of kLengthBlocks threads.
__global__ void aggregate_length(int nodes, const double* partial, double* length) {
  const double square = block_sum(partial[threadIdx.x]);
  if (threadIdx.x == 0) *length = square > 0.0 ? sqrt(square / nodes) : 1.0;
}

template <int K>
__global__ void make_tentative(int nodes, const int* aggregate, const double* fine,
                               const double* coarse, const double* fine_length,
                               const double* coarse_length, const std::uint8_t* fixed,
                               float* tentative) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= nodes) return;
  float T[K][6] = {};
  float d[3];
  for (int k = 0; k < 3; ++k)
    d[k] = float((fine[3 * i + k] - coarse[3 * aggregate[i] + k]) / *coarse_length);
  for (int k = 0; k < 3; ++k) {
    if (fixed && fixed[3 * i + k]) continue;
    const int p = (k + 1) % 3, q = (k + 2) % 3;
    T[k][k] = 1.0F, T[k][3 + p] = d[q], T[k][3 + q] = -d[p];
  }
  for (int k = 3; k < K; ++k) T[k][k] = float(*fine_length / *coarse_length);
  for (int k = 0; k < K; ++k)
    for (int c = 0; c < 6; ++c) tentative[(std::size_t(i) * K + k) * 6 + c] = T[k][c];
}

/// Products by lists: out(entry)[k][c] = sum over items of A(a)[k][m] P(p)[m][c].
template <int K>
__global__ void sum_products(int entries, const int* start, const int2* item, const float* A,
                             const float* P, float* out) {
  const std::size_t id = blockIdx.x * std::size_t(blockDim.x) + threadIdx.x;
  const int entry = int(id / (6 * K)), k = int(id % (6 * K)) / 6, c = int(id % 6);
  if (entry >= entries) return;
  float total = 0.0F;
  for (int n = start[entry]; n < start[entry + 1]; ++n) {
    const int2 at = item[n];
    const float* a = A + std::size_t(at.x) * K * K + k;
    const float* p = P + std::size_t(at.y) * 6 * K + c;
    for (int m = 0; m < K; ++m) total += a[K * m] * p[6 * m];
  }
  out[id] = total;
}
/// P = (T where it is the node's own) - omega inverse raw.
template <int K>
__global__ void finish_prolongation(int entries, const int* row_of, const int* column,
                                    const int* aggregate, const float* inverse,
                                    const float* largest, const float* raw, const float* tentative,
                                    float* out) {
  const std::size_t id = blockIdx.x * std::size_t(blockDim.x) + threadIdx.x;
  const int entry = int(id / (6 * K)), k = int(id % (6 * K)) / 6, c = int(id % 6);
  if (entry >= entries) return;
  const int i = row_of[entry];
  float total = 0.0F;
  for (int m = 0; m < K; ++m)
    total += inverse[(std::size_t(i) * K + k) * K + m] * raw[(std::size_t(entry) * K + m) * 6 + c];
  total *= -kProlongationDamping / *largest;
  if (aggregate[i] == column[entry]) total += tentative[(std::size_t(i) * K + k) * 6 + c];
  out[id] = total;
}
/// Blocks (I, J), J >= I, of P^T (A P), and their mirror images.
template <int K>
__global__ void make_coarse(int entries, const int* start, const int2* item, const int* mirror,
                            const float* P, const float* AP, float* out) {
  const std::size_t id = blockIdx.x * std::size_t(blockDim.x) + threadIdx.x;
  const int entry = int(id / 36), c = int(id % 36) / 6, r = int(id % 6);
  if (entry >= entries || mirror[entry] < 0) return;
  float total = 0.0F;
  for (int n = start[entry]; n < start[entry + 1]; ++n) {
    const int2 at = item[n];
    const float* p = P + std::size_t(at.x) * 6 * K + r;
    const float* a = AP + std::size_t(at.y) * 6 * K + c;
    for (int m = 0; m < K; ++m) total += p[6 * m] * a[6 * m];
  }
  out[std::size_t(entry) * 36 + 6 * c + r] = total;
  if (mirror[entry] != entry) out[std::size_t(mirror[entry]) * 36 + 6 * r + c] = total;
}
__global__ void lift_diagonal(int rows, const int* diagonal, float* matrix) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= rows) return;
  float* block = matrix + std::size_t(diagonal[i]) * 36;
  float largest = 0.0F;
  for (int k = 0; k < 6; ++k) largest = fmaxf(largest, fabsf(block[7 * k]));
  if (!(largest > 0.0F)) largest = 1.0F / kLeastDiagonal;
  for (int k = 0; k < 6; ++k) block[7 * k] += kLeastDiagonal * largest;
}

/// One block: the dense matrix of a small level, and its inverse (Gauss-Jordan; it is definite).
__global__ void coarsest_inverse(int rows, const int* start, const int* column, const float* matrix,
                                 bool is_small, double* out) {
  extern __shared__ double shared[];
  const int n = 6 * rows;
  double* A = is_small ? shared : out;
  for (int k = threadIdx.x; k < n * n; k += blockDim.x) A[k] = 0.0;
  __syncthreads();
  for (int i = threadIdx.x / 32; i < rows; i += blockDim.x / 32)
    for (int e = start[i]; e < start[i + 1]; ++e)
      for (int k = threadIdx.x % 32; k < 36; k += 32)
        A[std::size_t(6 * i + k % 6) * n + 6 * column[e] + k / 6] = matrix[std::size_t(e) * 36 + k];
  __syncthreads();
  for (int p = 0; p < n; ++p) {
    const double over = 1.0 / A[std::size_t(p) * n + p];
    __syncthreads();
    for (int k = threadIdx.x; k < n; k += blockDim.x)
      if (k != p) A[std::size_t(p) * n + k] *= over;
    __syncthreads();
    for (int i = threadIdx.x / 32; i < n; i += blockDim.x / 32) {
      if (i == p) continue;
      const double f = A[std::size_t(i) * n + p];
      __syncwarp();
      for (int k = threadIdx.x % 32; k < n; k += 32)
        if (k != p) A[std::size_t(i) * n + k] -= f * A[std::size_t(p) * n + k];
      __syncwarp();
      if (threadIdx.x % 32 == 0) A[std::size_t(i) * n + p] = -f * over;
    }
    if (threadIdx.x == 0) A[std::size_t(p) * n + p] = over;
    __syncthreads();
  }
  if (!is_small) return;
  for (int k = threadIdx.x; k < n * n; k += blockDim.x) out[k] = A[k];
}
constexpr std::size_t kMostShared = 200 << 10;

/// Lists of products, by entry of what they are added to.
struct Lists {
  Buffer<int> start;
  Buffer<int2> item;

  explicit Lists(const std::vector<std::vector<int2>>& of) {
    std::vector<int> begin(1, 0);
    std::vector<int2> all;
    for (const auto& items : of) {
      all.insert(all.end(), items.begin(), items.end());
      begin.push_back(int(all.size()));
    }
    start = Buffer<int>(begin);
    item = Buffer<int2>(all);
  }
};

class Multigrid {
  struct Level {
    int rows = 0, K = 3;
    Buffer<int> start, column, diagonal;
    Buffer<float> matrix, inverse, tentative, prolongation, product, raw;
    Buffer<float> x, b, residual, step, next, mode, largest, norm;
    Buffer<double> position, length, squares;
    // to the next level
    Buffer<int> aggregate, aggregate_start, aggregate_node, p_start, p_column, p_row, r_start,
        r_node, r_entry, mirror;
    int p_entries = 0, ap_entries = 0, coarse_entries = 0;
    std::unique_ptr<Lists> smoothed, products, coarse;
    LevelView view() const {
      return {rows,    start.get(), column.get(),   matrix.get(), inverse.get(), largest.get(),
              x.get(), b.get(),     residual.get(), step.get(),   next.get()};
    }
    TransferView transfer() const {
      return {int(aggregate_start.size()) - 1,
              rows,
              p_start.get(),
              p_column.get(),
              r_start.get(),
              r_node.get(),
              r_entry.get(),
              prolongation.get()};
    }
  };

 public:
  Multigrid(const Scene& scene, const std::uint8_t* fixed) : fixed_(fixed) {
    for (std::size_t l = 0; l < scene.levels.size(); ++l) {
      auto level = std::make_unique<Level>();
      const Pattern& p = scene.levels[l];
      level->rows = p.rows(), level->K = l == 0 ? 3 : 6;
      level->start = Buffer<int>(p.start), level->column = Buffer<int>(p.column);
      std::vector<int> diagonal;
      for (int i = 0; i < p.rows(); ++i) diagonal.push_back(place(p, i, i));
      level->diagonal = Buffer<int>(diagonal);
      const std::size_t n = std::size_t(level->rows) * level->K;
      level->matrix = Buffer<float>(std::size_t(p.entries()) * level->K * level->K);
      level->inverse = Buffer<float>(n * level->K);
      for (Buffer<float>* v :
           {&level->x, &level->b, &level->residual, &level->step, &level->next, &level->mode})
        *v = Buffer<float>(n);
      level->largest = Buffer<float>(1), level->norm = Buffer<float>(1);
      level->position = Buffer<double>(3 * std::size_t(level->rows));
      level->length = Buffer<double>(std::vector<double>{1.0});
      level->squares = Buffer<double>(2 * std::size_t(blocks_for(32 * std::size_t(level->rows))));
      if (l < scene.transfers.size())
        add_transfer(*level, p, scene.levels[l + 1], scene.transfers[l]);
      levels_.push_back(std::move(level));
    }
    const std::size_t n = 6 * std::size_t(levels_.back()->rows);
    coarsest_ = Buffer<double>(n * n);
    CHECK(cudaFuncSetAttribute(coarsest_inverse, cudaFuncAttributeMaxDynamicSharedMemorySize,
                               int(kMostShared)));
  }

  float* rhs() const { return levels_[0]->b.get(); }
  const float* answer() const { return levels_[0]->x.get(); }
  int coarsest_unknowns() const { return 6 * levels_.back()->rows; }

  /// Takes over the tangent (blocks in float64, inertia included) at positions x.
  void prepare(const double* values, const double* x, cudaStream_t stream) {
    Level& fine = *levels_[0];
    to_float<<<blocks_for(fine.matrix.size()), kThreads, 0, stream>>>(fine.matrix.size(), values,
                                                                      fine.matrix.get());
    CHECK(cudaMemcpyAsync(fine.position.get(), x, fine.position.size() * sizeof(double),
                          cudaMemcpyDeviceToDevice, stream));
    for (std::size_t l = 0; l + 1 < levels_.size(); ++l)
      l == 0 ? prepare_level<3>(*levels_[l], *levels_[l + 1], fixed_, stream)
             : prepare_level<6>(*levels_[l], *levels_[l + 1], nullptr, stream);
    invert_coarsest(stream);
  }
  void invert_coarsest(cudaStream_t stream) {
    const Level& last = *levels_.back();
    const std::size_t bytes = coarsest_.size() * sizeof(double);
    const bool is_small = bytes <= kMostShared;
    coarsest_inverse<<<1, 1024, is_small ? bytes : 0, stream>>>(
        last.rows, last.start.get(), last.column.get(), last.matrix.get(), is_small,
        coarsest_.get());
  }
  /// The powers of the finest level alone, for its price.
  void estimate_finest(cudaStream_t stream) { estimate_largest<3>(*levels_[0], stream); }

  /// One V-cycle from rhs() to answer().
  void cycle(cudaStream_t stream) { cycle(0, stream); }

 private:
  static int place(const Pattern& p, int i, int j) {
    return int(
        std::lower_bound(p.column.begin() + p.start[i], p.column.begin() + p.start[i + 1], j) -
        p.column.begin());
  }

  static void add_transfer(Level& level, const Pattern& matrix, const Pattern& coarse,
                           const Transfer& t) {
    const Pattern &P = t.prolongation, &AP = t.product;
    level.aggregate = Buffer<int>(t.aggregate);
    std::vector<std::vector<int>> nodes(std::size_t(t.num_aggregates));
    for (std::size_t i = 0; i < t.aggregate.size(); ++i) nodes[t.aggregate[i]].push_back(int(i));
    std::vector<int> start(1, 0), node, row;
    for (const auto& some : nodes) {
      node.insert(node.end(), some.begin(), some.end());
      start.push_back(int(node.size()));
    }
    level.aggregate_start = Buffer<int>(start), level.aggregate_node = Buffer<int>(node);
    for (int i = 0; i < P.rows(); ++i) row.insert(row.end(), P.start[i + 1] - P.start[i], i);
    level.p_start = Buffer<int>(P.start), level.p_column = Buffer<int>(P.column);
    level.p_row = Buffer<int>(row);
    level.r_start = Buffer<int>(t.restriction.start);
    level.r_node = Buffer<int>(t.restriction.column);
    level.r_entry = Buffer<int>(t.restriction_entry);
    level.p_entries = P.entries(), level.ap_entries = AP.entries();
    level.coarse_entries = coarse.entries();
    std::vector<std::vector<int2>> smoothed(P.column.size()), products(AP.column.size()),
        blocks(coarse.column.size());
    std::vector<int> mirror(coarse.column.size(), -1);
    for (int i = 0; i < matrix.rows(); ++i) {
      for (int e = matrix.start[i]; e < matrix.start[i + 1]; ++e) {
        const int j = matrix.column[e];
        smoothed[place(P, i, t.aggregate[j])].push_back({e, j});
        for (int p = P.start[j]; p < P.start[j + 1]; ++p)
          products[place(AP, i, P.column[p])].push_back({e, p});
      }
      for (int p = P.start[i]; p < P.start[i + 1]; ++p)
        for (int a = AP.start[i]; a < AP.start[i + 1]; ++a)
          if (AP.column[a] >= P.column[p])
            blocks[place(coarse, P.column[p], AP.column[a])].push_back({p, a});
    }
    for (int i = 0; i < coarse.rows(); ++i)
      for (int e = coarse.start[i]; e < coarse.start[i + 1]; ++e)
        if (coarse.column[e] >= i) mirror[e] = place(coarse, coarse.column[e], i);
    level.mirror = Buffer<int>(mirror);
    level.smoothed = std::make_unique<Lists>(smoothed);
    level.products = std::make_unique<Lists>(products);
    level.coarse = std::make_unique<Lists>(blocks);
    level.tentative = Buffer<float>(std::size_t(level.rows) * level.K * 6);
    for (Buffer<float>* v : {&level.prolongation, &level.raw})
      *v = Buffer<float>(P.column.size() * level.K * 6);
    level.product = Buffer<float>(AP.column.size() * level.K * 6);
  }

  template <int K>
  void estimate_largest(Level& v, cudaStream_t stream) {
    const int by_warp = blocks_for(32 * std::size_t(v.rows)), count = K * v.rows;
    start_mode<<<blocks_for(std::size_t(count)), kThreads, 0, stream>>>(count, v.mode.get());
    for (int k = 0; k < kFirstPowers; ++k) {
      power<K>
          <<<by_warp, kThreads, 0, stream>>>(v.view(), v.mode.get(), v.step.get(), v.squares.get());
      power_norm<<<1, 1024, 0, stream>>>(by_warp, v.squares.get(), v.largest.get(), v.norm.get());
      scale_mode<<<blocks_for(std::size_t(count)), kThreads, 0, stream>>>(
          count, v.step.get(), v.norm.get(), v.mode.get());
    }
  }

  template <int K>
  void prepare_level(Level& v, Level& coarse, const std::uint8_t* fixed, cudaStream_t stream) {
    const int rows = v.rows, by_row = blocks_for(std::size_t(rows));
    invert_diagonal<K><<<by_row, kThreads, 0, stream>>>(rows, v.diagonal.get(), v.matrix.get(),
                                                        fixed, v.inverse.get());
    estimate_largest<K>(v, stream);
    const int num = coarse.rows;
    place_aggregates<<<blocks_for(std::size_t(num)), kThreads, 0, stream>>>(
        num, v.aggregate_start.get(), v.aggregate_node.get(), v.position.get(),
        coarse.position.get());
    aggregate_squares<<<kLengthBlocks, kThreads, 0, stream>>>(
        rows, v.aggregate.get(), v.position.get(), coarse.position.get(), lengths_.get());
    aggregate_length<<<1, kLengthBlocks, 0, stream>>>(rows, lengths_.get(), coarse.length.get());
    make_tentative<K><<<by_row, kThreads, 0, stream>>>(
        rows, v.aggregate.get(), v.position.get(), coarse.position.get(), v.length.get(),
        coarse.length.get(), fixed, v.tentative.get());
    const int by_p = blocks_for(std::size_t(v.p_entries) * 6 * K);
    sum_products<K><<<by_p, kThreads, 0, stream>>>(v.p_entries, v.smoothed->start.get(),
                                                   v.smoothed->item.get(), v.matrix.get(),
                                                   v.tentative.get(), v.raw.get());
    finish_prolongation<K><<<by_p, kThreads, 0, stream>>>(
        v.p_entries, v.p_row.get(), v.p_column.get(), v.aggregate.get(), v.inverse.get(),
        v.largest.get(), v.raw.get(), v.tentative.get(), v.prolongation.get());
    sum_products<K><<<blocks_for(std::size_t(v.ap_entries) * 6 * K), kThreads, 0, stream>>>(
        v.ap_entries, v.products->start.get(), v.products->item.get(), v.matrix.get(),
        v.prolongation.get(), v.product.get());
    make_coarse<K><<<blocks_for(std::size_t(v.coarse_entries) * 36), kThreads, 0, stream>>>(
        v.coarse_entries, v.coarse->start.get(), v.coarse->item.get(), v.mirror.get(),
        v.prolongation.get(), v.product.get(), coarse.matrix.get());
    lift_diagonal<<<blocks_for(std::size_t(num)), kThreads, 0, stream>>>(num, coarse.diagonal.get(),
                                                                         coarse.matrix.get());
  }

  template <int K>
  void smooth(Level& v, bool from_zero, bool keep_residual, cudaStream_t stream) {
    static_assert(kDegree == 2);
    const int by_warp = blocks_for(32 * std::size_t(v.rows));
    smooth_first<K><<<by_warp, kThreads, 0, stream>>>(v.view(), from_zero);
    smooth_next<K><<<by_warp, kThreads, 0, stream>>>(v.view(), from_zero);
    smooth_last<K><<<by_warp, kThreads, 0, stream>>>(v.view(), keep_residual);
  }

  template <int K>
  void visit(std::size_t l, cudaStream_t stream) {
    Level &v = *levels_[l], &coarse = *levels_[l + 1];
    smooth<K>(v, true, true, stream);
    restrict_residual<K><<<blocks_for(32 * std::size_t(coarse.rows)), kThreads, 0, stream>>>(
        v.transfer(), v.residual.get(), coarse.b.get());
    cycle(l + 1, stream);
    prolong<K><<<blocks_for(std::size_t(v.rows) * K), kThreads, 0, stream>>>(
        v.transfer(), coarse.x.get(), v.x.get());
    smooth<K>(v, false, false, stream);
  }

  void cycle(std::size_t l, cudaStream_t stream) {
    if (l + 1 == levels_.size()) {
      coarsest_solve<<<1, 1024, 0, stream>>>(coarsest_unknowns(), coarsest_.get(),
                                             levels_[l]->b.get(), levels_[l]->x.get());
      return;
    }
    l == 0 ? visit<3>(l, stream) : visit<6>(l, stream);
  }

  const std::uint8_t* fixed_;
  std::vector<std::unique_ptr<Level>> levels_;
  Buffer<double> coarsest_, lengths_{kLengthBlocks};
};

}  // namespace study
