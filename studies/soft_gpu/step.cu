// One implicit step of a large body, and its adjoint, on the device beside the CPU's.
//
// The CPU's mathematics (csrc/kernels/soft): Newton's directions by conjugate gradients on
// multigrid, residuals in float64, cycles in float32. The same tolerance; answers are compared.
#include <chrono>
#include <cmath>
#include <cstring>

#include "elements.cuh"
#include "multigrid.cuh"
#include "scene.h"

namespace study {
namespace {

constexpr int kSumBlocks = 264;  // whose sums are added in their order
constexpr int kSumThreads = 256;

/// Every thread of a block gets the sum over what kSumBlocks blocks left.
__device__ double sum_of(const double* partial) {
  __shared__ double shared;
  double v = 0.0;
  for (int k = threadIdx.x; k < kSumBlocks; k += blockDim.x) v += partial[k];
  v = block_sum(v);
  if (threadIdx.x == 0) shared = v;
  __syncthreads();
  v = shared;
  __syncthreads();
  return v;
}
__device__ void leave(double v, double* partial) {
  v = block_sum(v);
  if (threadIdx.x == 0) partial[blockIdx.x] = v;
}

struct Problem {
  int nodes;
  const std::uint8_t* fixed;
  const double *inertia, *y;
};

/// Gradient from elements' forces, with inertia; sums of kinetic energy and of its square.
__global__ void finish_gradient(Problem p, const int* start, const int* item, const double* forces,
                                const double* x, double* gradient, double* kinetic,
                                double* square) {
  double energy = 0.0, norm = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < 3 * p.nodes;
       k += gridDim.x * blockDim.x) {
    const int i = k / 3, axis = k % 3;
    double total = 0.0;
    for (int n = start[i]; n < start[i + 1]; ++n) total += forces[3 * std::size_t(item[n]) + axis];
    const double step = x[k] - p.y[k];
    total = p.fixed[k] ? 0.0 : total + p.inertia[i] * step;
    if (!p.fixed[k]) energy += 0.5 * p.inertia[i] * step * step;
    gradient[k] = total;
    norm += total * total;
  }
  leave(energy, kinetic);
  leave(norm, square);
}

__global__ void gather_matrix(int entries, const int* start, const int* item,
                              const double* matrices, double* values) {
  const std::size_t id = blockIdx.x * std::size_t(blockDim.x) + threadIdx.x;
  const int entry = int(id / 9), m = int(id % 9), i = m % 3, k = m / 3;
  if (entry >= entries) return;
  double total = 0.0;
  for (int n = start[entry]; n < start[entry + 1]; ++n) {
    const int at = item[n] % 2 ? 3 * k + i : 3 * i + k;
    total += matrices[std::size_t(item[n] / 2) * 9 + at];
  }
  values[id] = total;
}
__global__ void add_inertia(int nodes, const int* diagonal, const double* inertia, double* values) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= nodes) return;
  for (int k = 0; k < 3; ++k) values[std::size_t(diagonal[i]) * 9 + 4 * k] += inertia[i];
}

/// The device's part of conjugate gradients; sums of blocks in `partial`.
struct Krylov {
  double *r, *z, *p, *Ap, *x;
  double *rz, *rr, *pAp;  // (kSumBlocks,) each
  double* last_rz;        // zero at first
};

__global__ void to_cycle(int count, Krylov v, const std::uint8_t* fixed, float* b) {
  const double unit = rsqrt(sum_of(v.rr));
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x)
    b[k] = fixed[k] ? 0.0F : float(unit * v.r[k]);
}
__global__ void from_cycle(int count, Krylov v, const float* answer) {
  const double unit = sqrt(sum_of(v.rr));
  double rz = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x) {
    const double z = unit * answer[k];
    v.z[k] = z, rz += z * v.r[k];
  }
  leave(rz, v.rz);
}
__global__ void new_direction(int count, Krylov v) {
  const double rz = sum_of(v.rz), last = *v.last_rz;
  const double beta = last > 0.0 ? rz / last : 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x)
    v.p[k] = v.z[k] + beta * v.p[k];
}
__global__ void keep_rz(Krylov v) {
  const double rz = sum_of(v.rz);
  if (threadIdx.x == 0) *v.last_rz = rz;
}
/// Ap = H p; a warp a row.
__global__ void multiply(int rows, const int* start, const int* column, const double* values,
                         const std::uint8_t* fixed, Krylov v) {
  double total = 0.0;
  const int lane = threadIdx.x % 32;
  for (int row = (blockIdx.x * blockDim.x + threadIdx.x) / 32; row < rows;
       row += gridDim.x * blockDim.x / 32) {
    const double y = warp_row<3>(start, column, values, v.p, row);
    const int k = 3 * row + lane % 3;
    if (lane >= 3) continue;
    v.Ap[k] = fixed[k] ? 0.0 : y;
    if (!fixed[k]) total += y * v.p[k];
  }
  leave(total, v.pAp);
}
__global__ void advance(int count, Krylov v) {
  const double alpha = sum_of(v.rz) / sum_of(v.pAp);
  double rr = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x) {
    v.x[k] += alpha * v.p[k];
    const double r = v.r[k] - alpha * v.Ap[k];
    v.r[k] = r, rr += r * r;
  }
  leave(rr, v.rr);
}
/// r = scale b, x = p = 0.
__global__ void begin_solve(int count, double scale, const double* b, const std::uint8_t* fixed,
                            Krylov v) {
  double rr = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x) {
    const double r = fixed[k] ? 0.0 : scale * b[k];
    v.r[k] = r, v.x[k] = v.p[k] = 0.0, rr += r * r;
  }
  leave(rr, v.rr);
  if (blockIdx.x == 0 && threadIdx.x == 0) *v.last_rz = 0.0;
}
__global__ void dot(int count, const double* a, const double* b, double* partial) {
  double total = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x)
    total += a[k] * b[k];
  leave(total, partial);
}
__global__ void add(int count, double factor, const double* d, const double* from, double* to) {
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k < count) to[k] = from[k] + factor * d[k];
}
/// Three sums to where the host reads them.
__global__ void report(const double* a, const double* b, const double* c, double* out) {
  const double sa = sum_of(a), sb = b ? sum_of(b) : 0.0, sc = c ? sum_of(c) : 0.0;
  if (threadIdx.x == 0) out[0] = sa, out[1] = sb, out[2] = sc;
}
__global__ void sum_energies(int count, const double* energy, double* partial) {
  double total = 0.0;
  for (int k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += gridDim.x * blockDim.x)
    total += energy[k];
  leave(total, partial);
}

struct Counts {
  int newton = 0, cycles = 0, tangents = 0;
};

class Step {
 public:
  explicit Step(const Scene& s)
      : n_(3 * s.num_nodes),
        nodes_(s.num_nodes),
        count_(s.num_elements),
        rtol_(s.rtol),
        elements_(s.elements),
        fixed_(s.fixed),
        inertia_(s.inertia),
        y_(s.start),
        start_(s.levels[0].start),
        column_(s.levels[0].column),
        multigrid_(s, fixed_.get()) {
    CHECK(cudaStreamCreate(&stream_));
    ElementTable table;
    std::memcpy(table.grad, s.grad, sizeof(table.grad));
    std::memcpy(table.weight, s.weight, sizeof(table.weight));
    table.w_mu = s.w_mu, table.w_vol = s.w_vol;
    table_ = Buffer<ElementTable>(std::vector<ElementTable>{table});
    const Gather nodes = Gather::nodes(s.elements, s.num_nodes);
    const Gather blocks = Gather::blocks(s.elements, s.levels[0].start, s.levels[0].column);
    node_start_ = Buffer<int>(nodes.start), node_item_ = Buffer<int>(nodes.item);
    block_start_ = Buffer<int>(blocks.start), block_item_ = Buffer<int>(blocks.item);
    std::vector<int> diagonal;
    for (int i = 0; i < nodes_; ++i)
      diagonal.push_back(Gather::place(s.levels[0].start, s.levels[0].column, i, i));
    diagonal_ = Buffer<int>(diagonal);
    entries_ = s.levels[0].entries();
    values_ = Buffer<double>(9 * std::size_t(entries_));
    matrices_ = Buffer<double>(std::size_t(count_) * kPairs * 9);
    forces_ = Buffer<double>(std::size_t(count_) * kVector);
    energy_ = Buffer<double>(std::size_t(blocks_for(std::size_t(count_), kElementsOfBlock)));
    for (Buffer<double>* v : {&x_, &trial_, &gradient_, &d_, &r_, &z_, &p_, &Ap_})
      *v = Buffer<double>(std::size_t(n_));
    sums_ = Buffer<double>(8 * kSumBlocks), last_rz_ = Buffer<double>(1);
    CHECK(cudaMallocHost(&host_, 4 * sizeof(double)));
    CHECK(cudaFuncSetAttribute(element_matrices, cudaFuncAttributeMaxDynamicSharedMemorySize,
                               kHBytes));
    // A force scale as that of the CPU: |inertia (y - mean y)|.
    double mean[3] = {}, square = 0.0;
    for (int k = 0; k < n_; ++k) mean[k % 3] += s.start[k] / nodes_;
    for (int k = 0; k < n_; ++k)
      if (!s.fixed[k]) square += std::pow(s.inertia[k / 3] * (s.start[k] - mean[k % 3]), 2);
    scale_ = std::sqrt(square);
    capture();
  }

  const Buffer<double>& x() const { return x_; }
  const Buffer<double>& z() const { return d_; }

  /// The same course as implicit_step.cpp: inexact Newton, one multigrid while residuals fall, the
  /// last solve on an old tangent where that is expected to do.
  Counts step() {
    Counts counts;
    const std::size_t bytes = std::size_t(n_) * sizeof(double);
    CHECK(cudaMemcpyAsync(x_.get(), y_.get(), bytes, cudaMemcpyDeviceToDevice, stream_));
    double norm, value = evaluate(x_.get(), norm), last = 0.0;
    const double tolerance = rtol_ * scale_;
    bool is_prepared = false;
    for (; norm > tolerance && counts.newton < 50; ++counts.newton) {
      const bool old = last > 0.0 && 2.0 * norm / last * norm <= 10.0 * tolerance;
      if (!old) assemble(x_.get()), ++counts.tangents;
      if (!is_prepared || (!old && norm >= last))
        multigrid_.prepare(values_.get(), x_.get(), stream_), is_prepared = true;
      const double ratio = last > 0.0 ? norm / last : 1.0;
      const double forcing =
          std::max(std::min(0.1, 0.9 * ratio * ratio), std::min(0.5, 0.5 * tolerance / norm));
      last = norm;
      counts.cycles += solve(-1.0, gradient_.get(), forcing * norm);
      dot<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, gradient_.get(), d_.get(), sums(0));
      const double slope = read(sums(0), nullptr, nullptr)[0];
      double factor = 1.0;
      for (int trial = 0; trial < 30; ++trial, factor *= 0.5) {
        add<<<blocks_for(std::size_t(n_)), kThreads, 0, stream_>>>(n_, factor, d_.get(), x_.get(),
                                                                   trial_.get());
        const double found = evaluate(trial_.get(), norm);
        if (!(found <= value + 1e-4 * factor * slope + 1e-14 * std::fabs(value))) continue;
        value = found;
        break;
      }
      CHECK(cudaMemcpyAsync(x_.get(), trial_.get(), bytes, cudaMemcpyDeviceToDevice, stream_));
    }
    CHECK(cudaStreamSynchronize(stream_));
    residual_ = norm, tolerance_ = tolerance;
    return counts;
  }

  /// H(x) z = loss to rtol of its norm.
  int adjoint(const Buffer<double>& loss, double norm) {
    assemble(x_.get());
    multigrid_.prepare(values_.get(), x_.get(), stream_);
    const int cycles = solve(1.0, loss.get(), rtol_ * norm);
    CHECK(cudaStreamSynchronize(stream_));
    return cycles;
  }

  double residual() const { return residual_; }
  double tolerance() const { return tolerance_; }

  void print_kernels(double bandwidth) {
    const auto line = [&](const char* name, double ms, double bytes) {
      std::printf("  %-34s %8.3f ms", name, ms);
      if (bytes > 0.0)
        std::printf("  %5.0f GB/s, %3.0f %% of a copy's", bytes / ms * 1e-6,
                    100.0 * bytes / ms * 1e-6 / bandwidth);
      std::printf("\n");
    };
    const double blocks = 9.0 * entries_;
    line("energy and gradient", device_ms(stream_, 20, [&] { launch_energy(x_.get()); }), 0.0);
    line("element matrices", device_ms(stream_, 20, [&] { launch_matrices(x_.get()); }), 0.0);
    line("tangent, added up", device_ms(stream_, 20, [&] { assemble(x_.get()); }), 0.0);
    line("multigrid's numbers",
         device_ms(stream_, 20, [&] { multigrid_.prepare(values_.get(), x_.get(), stream_); }),
         0.0);
    line("of these: powers, finest level",
         device_ms(stream_, 20, [&] { multigrid_.estimate_finest(stream_); }), 0.0);
    line("of these: coarsest inverse",
         device_ms(stream_, 20, [&] { multigrid_.invert_coarsest(stream_); }), 0.0);
    line("product, float64",
         device_ms(stream_, 50,
                   [&] {
                     multiply<<<kSumBlocks * 4, kSumThreads, 0, stream_>>>(
                         nodes_, start_.get(), column_.get(), values_.get(), fixed_.get(),
                         wide_krylov());
                   }),
         8.0 * blocks + 4.0 * entries_ + 16.0 * n_);
    line("one cycle, launched one by one",
         device_ms(stream_, 50, [&] { multigrid_.cycle(stream_); }), 0.0);
    line("one iteration, as a graph",
         device_ms(stream_, 50, [&] { CHECK(cudaGraphLaunch(graph_, stream_)); }), 0.0);
  }

 private:
  static constexpr int kHBytes = kUnique * kSampleThreads * int(sizeof(double));
  double* sums(int k) const { return sums_.get() + k * kSumBlocks; }
  Krylov krylov() const {
    return {r_.get(), z_.get(), p_.get(), Ap_.get(),     d_.get(),
            sums(1),  sums(2),  sums(3),  last_rz_.get()};
  }
  Krylov wide_krylov() {
    if (wide_.size() == 0) wide_ = Buffer<double>(4 * kSumBlocks);
    Krylov k = krylov();
    k.pAp = wide_.get();
    return k;
  }

  const double* read(const double* a, const double* b, const double* c) {
    report<<<1, kSumThreads, 0, stream_>>>(a, b, c, host_);
    CHECK(cudaStreamSynchronize(stream_));
    return host_;
  }

  void launch_energy(const double* x) {
    const int blocks = blocks_for(std::size_t(count_), kElementsOfBlock);
    element_forces<<<blocks, kSampleThreads, 0, stream_>>>(table_.get(), elements_.get(), count_, x,
                                                           0, forces_.get(), energy_.get());
    sum_energies<<<kSumBlocks, kSumThreads, 0, stream_>>>(blocks, energy_.get(), sums(4));
    finish_gradient<<<kSumBlocks, kSumThreads, 0, stream_>>>(
        {nodes_, fixed_.get(), inertia_.get(), y_.get()}, node_start_.get(), node_item_.get(),
        forces_.get(), x, gradient_.get(), sums(5), sums(6));
  }
  double evaluate(const double* x, double& norm) {
    launch_energy(x);
    const double* s = read(sums(4), sums(5), sums(6));
    norm = std::sqrt(s[2]);
    return s[0] + s[1];
  }

  void launch_matrices(const double* x) {
    element_matrices<<<blocks_for(std::size_t(count_), kElementsOfBlock), kSampleThreads, kHBytes,
                       stream_>>>(table_.get(), elements_.get(), count_, x, 0, matrices_.get());
  }
  void assemble(const double* x) {
    launch_matrices(x);
    gather_matrix<<<blocks_for(9 * std::size_t(entries_)), kThreads, 0, stream_>>>(
        entries_, block_start_.get(), block_item_.get(), matrices_.get(), values_.get());
    add_inertia<<<blocks_for(std::size_t(nodes_)), kThreads, 0, stream_>>>(
        nodes_, diagonal_.get(), inertia_.get(), values_.get());
  }

  void iterate() {
    const Krylov k = krylov();
    to_cycle<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, k, fixed_.get(), multigrid_.rhs());
    multigrid_.cycle(stream_);
    from_cycle<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, k, multigrid_.answer());
    new_direction<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, k);
    keep_rz<<<1, kSumThreads, 0, stream_>>>(k);
    multiply<<<kSumBlocks, 1024, 0, stream_>>>(nodes_, start_.get(), column_.get(), values_.get(),
                                               fixed_.get(), k);
    advance<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, k);
    report<<<1, kSumThreads, 0, stream_>>>(k.rr, k.pAp, nullptr, host_);
  }
  void capture() {
    cudaGraph_t graph;
    CHECK(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeGlobal));
    iterate();
    CHECK(cudaStreamEndCapture(stream_, &graph));
    CHECK(cudaGraphInstantiate(&graph_, graph, 0));
  }

  /// H d = scale b.
  int solve(double scale, const double* b, double tolerance) {
    begin_solve<<<kSumBlocks, kSumThreads, 0, stream_>>>(n_, scale, b, fixed_.get(), krylov());
    for (int k = 0; k < 200; ++k) {
      CHECK(cudaGraphLaunch(graph_, stream_));
      CHECK(cudaStreamSynchronize(stream_));
      if (!(host_[1] > 0.0)) std::printf("negative curvature\n");
      if (std::sqrt(host_[0]) <= tolerance) return k + 1;
    }
    std::printf("conjugate gradients did not converge\n");
    return 200;
  }

  int n_, nodes_, count_, entries_ = 0;
  double rtol_, scale_ = 0.0, residual_ = 0.0, tolerance_ = 0.0;
  Buffer<int> elements_, node_start_, node_item_, block_start_, block_item_, diagonal_;
  Buffer<std::uint8_t> fixed_;
  Buffer<double> inertia_, y_;
  Buffer<int> start_, column_;
  Multigrid multigrid_;
  Buffer<ElementTable> table_;
  Buffer<double> values_, matrices_, forces_, energy_, x_, trial_, gradient_, d_, r_, z_, p_, Ap_;
  Buffer<double> sums_, last_rz_, wide_;
  double* host_ = nullptr;
  cudaStream_t stream_ = nullptr;
  cudaGraphExec_t graph_ = nullptr;
};

double wall_ms(auto&& call) {
  const auto began = std::chrono::steady_clock::now();
  call();
  return 1e3 * std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
}

double median(std::vector<double> v) {
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

double largest_difference(const std::vector<double>& a, const std::vector<double>& b,
                          double& scale) {
  double d = 0.0;
  scale = 0.0;
  for (std::size_t k = 0; k < a.size(); ++k)
    d = std::max(d, std::fabs(a[k] - b[k])), scale = std::max(scale, std::fabs(b[k]));
  return d;
}

double copy_bandwidth() {
  const std::size_t size = std::size_t(1) << 30;
  Buffer<char> a(size), b(size);
  const double ms = device_ms(nullptr, 20, [&] {
    CHECK(cudaMemcpyAsync(b.get(), a.get(), size, cudaMemcpyDeviceToDevice));
  });
  return 2.0 * double(size) / ms * 1e-6;
}

void compare(int width, const std::vector<int>& threads, double bandwidth) {
  const int cells[3] = {4 * width, width, width};
  const Scene scene = make_scene(cells, 10.0);
  std::printf("\n%d DoF\n", 3 * scene.num_nodes);
  std::unique_ptr<Step> step;
  const double prepare = wall_ms([&] { step = std::make_unique<Step>(scene); });
  const std::vector<double> loss = loss_gradient(scene);
  const Buffer<double> device_loss(loss);
  double square = 0.0;
  for (std::size_t k = 0; k < loss.size(); ++k)
    if (!scene.fixed[k]) square += loss[k] * loss[k];
  std::vector<double> forward, backward;
  Counts counts;
  int cycles = 0;
  for (int k = 0; k < 11; ++k) {
    forward.push_back(wall_ms([&] { counts = step->step(); }));
    backward.push_back(wall_ms([&] { cycles = step->adjoint(device_loss, std::sqrt(square)); }));
  }
  const std::vector<double> x = step->x().host(), z = step->z().host();
  std::size_t free, total;
  CHECK(cudaMemGetInfo(&free, &total));
  std::printf(
      "GPU: step %.2f ms (%d Newton, %d tangents, %d cycles), adjoint %.2f ms (%d cycles); "
      "made ready in %.0f ms; %.2f GB\n",
      median({forward.begin() + 1, forward.end()}), counts.newton, counts.tangents, counts.cycles,
      median({backward.begin() + 1, backward.end()}), cycles, prepare, double(total - free) * 1e-9);
  std::printf("     residual %.3g of tolerance %.3g N\n", step->residual(), step->tolerance());
  Counts again = step->step();
  const std::vector<double> second = step->x().host();
  std::printf("     same bits twice: %s\n",
              again.cycles == counts.cycles &&
                      !std::memcmp(x.data(), second.data(), x.size() * sizeof(double))
                  ? "yes"
                  : "no");
  for (int number : threads) {
    const Answer cpu = step_on_cpu(scene, number, scene.num_nodes < 20000 ? 9 : 3);
    double scale_x, scale_z, move = 0.0;
    const double dx = largest_difference(x, cpu.x, scale_x),
                 dz = largest_difference(z, cpu.z, scale_z);
    for (std::size_t k = 0; k < x.size(); ++k)
      move = std::max(move, std::fabs(cpu.x[k] - scene.start[k]));
    std::printf(
        "CPU, %2d threads: step %.1f ms (%.0f Newton, %.0f cycles), adjoint %.1f ms (%.0f); "
        "x off by %.1e of the largest motion, z by %.1e of its largest\n",
        number, 1e3 * cpu.step_s, cpu.newton, cpu.cycles, 1e3 * cpu.adjoint_s, cpu.adjoint_cycles,
        dx / move, dz / scale_z);
    std::fflush(stdout);
  }
  step->print_kernels(bandwidth);
}

}  // namespace
}  // namespace study

int main(int count, char** given) {
  using namespace study;
  cudaDeviceProp device;
  CHECK(cudaGetDeviceProperties(&device, 0));
  const double bandwidth = copy_bandwidth();
  std::printf("%s, %d multiprocessors; a copy moves %.0f GB/s\n", device.name,
              device.multiProcessorCount, bandwidth);
  const std::vector<int> threads{1, 8, 16};
  for (int k = 1; k < count; ++k) compare(std::atoi(given[k]), threads, bandwidth);
}
