// Linearly implicit steps of many small bodies on the device beside the CPU's.
//
// A body has one shape and its own positions. A warp factors a body's tangent, 3x3 blocks in a
// minimum degree order as csrc/kernels/linalg/small_cholesky.h does; everything is float64.
#include <chrono>
#include <cmath>
#include <cstring>
#include <set>

#include "elements.cuh"
#include "scene.h"

namespace study {
namespace {

constexpr int kMostRows = 72;  // of a column of the factor
constexpr int kWarpsOfBlock = 4;

/// The factor's pattern. Columns have their diagonal block first.
struct Symbolic {
  std::vector<int> order, start, row;  // order[k] = node eliminated k-th
  std::vector<int> update_start;       // of columns, into the next three
  std::vector<int> update_slot;        // of block (k, j) of an earlier column j
  std::vector<int> update_count;       // blocks of that column from there on
  std::vector<int> update_place;       // where their places begin in `place`
  std::vector<int> place;              // rows' places in column k
  int products = 0, most_rows = 0;

  Symbolic(const Pattern& graph) {
    const int n = graph.rows();
    std::vector<std::set<int>> next(static_cast<std::size_t>(n));
    for (int i = 0; i < n; ++i)
      for (int e = graph.start[i]; e < graph.start[i + 1]; ++e)
        if (graph.column[e] != i) next[i].insert(graph.column[e]);
    std::vector<int> rank(n, -1);
    std::vector<std::set<int>> below(n);
    for (int k = 0; k < n; ++k) {
      int best = -1;
      for (int i = 0; i < n; ++i)
        if (rank[i] < 0 && (best < 0 || next[i].size() < next[best].size())) best = i;
      rank[best] = k;
      order.push_back(best);
      below[k] = next[best];
      for (int a : next[best]) {
        next[a].erase(best);
        for (int b : next[best])
          if (a != b) next[a].insert(b);
      }
    }
    start.push_back(0);
    for (int k = 0; k < n; ++k) {
      std::vector<int> rows{k};
      for (int i : below[k]) rows.push_back(rank[i]);
      std::sort(rows.begin(), rows.end());
      row.insert(row.end(), rows.begin(), rows.end());
      start.push_back(int(row.size()));
      most_rows = std::max(most_rows, int(rows.size()));
    }
    std::vector<std::vector<std::pair<int, int>>> updates(n);  // column j, slot
    for (int j = 0; j < n; ++j)
      for (int s = start[j] + 1; s < start[j + 1]; ++s) updates[row[s]].push_back({j, s});
    for (int k = 0; k < n; ++k) {
      update_start.push_back(int(update_slot.size()));
      for (const auto& [j, slot] : updates[k]) {
        update_slot.push_back(slot), update_count.push_back(start[j + 1] - slot);
        update_place.push_back(int(place.size()));
        for (int s = slot; s < start[j + 1]; ++s) place.push_back(place_of(row[s], k));
        products += start[j + 1] - slot;
      }
    }
    update_start.push_back(int(update_slot.size()));
  }
  int place_of(int i, int column) const {
    return int(std::lower_bound(row.begin() + start[column], row.begin() + start[column + 1], i) -
               row.begin()) -
           start[column];
  }
  int blocks() const { return int(row.size()); }
};

struct SymbolicView {
  int nodes, blocks;
  const int *order, *start, *row, *update_start, *update_slot, *update_count, *update_place, *place;
};

/// Blocks of A in the factor's places (members, blocks, 3, 3) row-major; identity where held.
__global__ void fill(SymbolicView s, const int* item_start, const int* item, std::size_t elements,
                     const double* matrices, const double* inertia, const std::uint8_t* fixed,
                     const int* column_of, double* L) {
  const std::size_t member = blockIdx.y;
  const int id = blockIdx.x * blockDim.x + threadIdx.x;
  const int block = id / 9, r = id % 9 / 3, c = id % 3;
  if (block >= s.blocks) return;
  const int i = s.order[s.row[block]], j = s.order[column_of[block]];
  double total = 0.0;
  if (fixed[3 * i + r] || fixed[3 * j + c]) {
    total = i == j && r == c;
  } else {
    for (int n = item_start[block]; n < item_start[block + 1]; ++n)
      total += matrices[(member * elements * kPairs + item[n] / 2) * 9 +
                        (item[n] % 2 ? 3 * c + r : 3 * r + c)];
    if (i == j && r == c) total += inertia[i];
  }
  L[(member * s.blocks) * 9 + id] = total;
}

/// Factors in place; a warp a member.
__global__ void __launch_bounds__(32 * kWarpsOfBlock)
    factorize(SymbolicView s, int members, double* all) {
  __shared__ double columns[kWarpsOfBlock][kMostRows * 9];
  const int lane = threadIdx.x % 32;
  const std::size_t member = blockIdx.x * kWarpsOfBlock + threadIdx.x / 32;
  if (member >= members) return;
  double* L = all + member * s.blocks * 9;
  double* column = columns[threadIdx.x / 32];
  for (int k = 0; k < s.nodes; ++k) {
    const int begin = s.start[k], count = (s.start[k + 1] - begin) * 9;
    for (int t = lane; t < count; t += 32) column[t] = L[std::size_t(begin) * 9 + t];
    __syncwarp();
    for (int u = s.update_start[k]; u < s.update_start[k + 1]; ++u) {
      const double* from = L + std::size_t(s.update_slot[u]) * 9;
      const int* place = s.place + s.update_place[u];
      double own[9];
      for (int m = 0; m < 9; ++m) own[m] = from[m];
      const int tasks = s.update_count[u] * 3;
      for (int t = lane; t < tasks; t += 32) {  // a row of a block
        const double* left = from + 3 * t;
        double* to = column + place[t / 3] * 9 + t % 3 * 3;
        const double l0 = left[0], l1 = left[1], l2 = left[2];
        for (int c = 0; c < 3; ++c)
          to[c] -= l0 * own[3 * c] + l1 * own[3 * c + 1] + l2 * own[3 * c + 2];
      }
      __syncwarp();
    }
    // The diagonal block's factor, by every lane.
    const double a = sqrt(column[0]), b = column[3] / a, c = column[6] / a;
    const double d = sqrt(column[4] - b * b), e = (column[7] - c * b) / d;
    const double f = sqrt(column[8] - c * c - e * e);
    __syncwarp();
    const double ia = 1.0 / a, id = 1.0 / d, jf = 1.0 / f;
    for (int t = lane; t < count / 3; t += 32) {
      double* v = column + 3 * t;
      double x0, x1, x2;
      if (t < 3) {
        x0 = t == 0 ? a : t == 1 ? b : c, x1 = t == 0 ? 0.0 : t == 1 ? d : e, x2 = t == 2 ? f : 0.0;
      } else {
        x0 = v[0] * ia, x1 = (v[1] - x0 * b) * id, x2 = (v[2] - x0 * c - x1 * e) * jf;
      }
      double* out = L + std::size_t(begin) * 9 + 3 * t;
      out[0] = x0, out[1] = x1, out[2] = x2;
    }
    __syncwarp();
  }
}

/// L L^T z = b, z in the order of elimination; a warp a member.
__global__ void solve(SymbolicView s, int members, const double* all, const double* rhs,
                      double* z) {
  const int lane = threadIdx.x % 32;
  const std::size_t member = blockIdx.x * std::size_t(blockDim.x / 32) + threadIdx.x / 32;
  if (member >= members) return;
  const double* L = all + member * s.blocks * 9;
  double* y = z + member * s.nodes * 3;
  const double* b = rhs + member * s.nodes * 3;
  for (int t = lane; t < 3 * s.nodes; t += 32) y[t] = b[3 * s.order[t / 3] + t % 3];
  __syncwarp();
  for (int k = 0; k < s.nodes; ++k) {
    const double* D = L + std::size_t(s.start[k]) * 9;
    const double y0 = y[3 * k] / D[0], y1 = (y[3 * k + 1] - D[3] * y0) / D[4];
    const double y2 = (y[3 * k + 2] - D[6] * y0 - D[7] * y1) / D[8];
    __syncwarp();
    if (lane == 0) y[3 * k] = y0, y[3 * k + 1] = y1, y[3 * k + 2] = y2;
    const int count = (s.start[k + 1] - s.start[k]) * 3;
    for (int t = 3 + lane; t < count; t += 32)
      y[3 * s.row[s.start[k] + t / 3] + t % 3] -=
          D[3 * t] * y0 + D[3 * t + 1] * y1 + D[3 * t + 2] * y2;
    __syncwarp();
  }
  for (int k = s.nodes - 1; k >= 0; --k) {
    const double* D = L + std::size_t(s.start[k]) * 9;
    const int count = (s.start[k + 1] - s.start[k]) * 3;
    double t0 = 0.0, t1 = 0.0, t2 = 0.0;
    for (int t = 3 + lane; t < count; t += 32) {
      const double v = y[3 * s.row[s.start[k] + t / 3] + t % 3];
      t0 += D[3 * t] * v, t1 += D[3 * t + 1] * v, t2 += D[3 * t + 2] * v;
    }
    t0 = warp_sum(t0), t1 = warp_sum(t1), t2 = warp_sum(t2);
    if (lane == 0) {
      const double x2 = (y[3 * k + 2] - t2) / D[8];
      const double x1 = (y[3 * k + 1] - t1 - D[7] * x2) / D[4];
      y[3 * k + 2] = x2, y[3 * k + 1] = x1;
      y[3 * k] = (y[3 * k] - t0 - D[3] * x1 - D[6] * x2) / D[0];
    }
    __syncwarp();
  }
}

/// -(gradient of the step's objective) at the start, where only elements push.
__global__ void right_side(int nodes, const int* start, const int* item, std::size_t elements,
                           const double* forces, const std::uint8_t* fixed, double* rhs) {
  const std::size_t member = blockIdx.y;
  const int k = blockIdx.x * blockDim.x + threadIdx.x;
  if (k >= 3 * nodes) return;
  double total = 0.0;
  for (int n = start[k / 3]; n < start[k / 3 + 1]; ++n)
    total -= forces[member * elements * kVector + 3 * std::size_t(item[n]) + k % 3];
  rhs[member * 3 * nodes + k] = fixed[k] ? 0.0 : total;
}
__global__ void finish(int nodes, const int* order, const double* z, const double* from,
                       double* to) {
  const std::size_t offset = std::size_t(blockIdx.y) * 3 * nodes;
  const int t = blockIdx.x * blockDim.x + threadIdx.x;
  if (t >= 3 * nodes) return;
  const int k = 3 * order[t / 3] + t % 3;
  to[offset + k] = from[offset + k] + z[offset + t];
}

void compare(const Scene& scene, int members, bool on_cpu) {
  const Symbolic symbolic(scene.levels[0]);
  if (symbolic.most_rows > kMostRows) {
    std::printf("a column has %d rows\n", symbolic.most_rows);
    std::exit(1);
  }
  std::vector<double> starts;
  for (int m = 0; m < members; ++m) {
    const double share = 0.5 + double(m) / members;
    for (std::size_t k = 0; k < scene.start.size(); ++k)
      starts.push_back(scene.rest[k] + share * (scene.start[k] - scene.rest[k]));
  }
  const int n = scene.num_nodes, blocks = symbolic.blocks();
  std::vector<int> column_of;
  for (int k = 0; k < n; ++k)
    column_of.insert(column_of.end(), symbolic.start[k + 1] - symbolic.start[k], k);
  // Where elements' pairs go in the factor.
  std::vector<std::vector<int>> of(static_cast<std::size_t>(blocks));
  std::vector<int> rank(n);
  for (int k = 0; k < n; ++k) rank[symbolic.order[k]] = k;
  for (int e = 0; e < scene.num_elements; ++e)
    for (int b = 0; b < 8; ++b)
      for (int a = 0; a <= b; ++a) {
        const int i = rank[scene.elements[8 * e + a]], j = rank[scene.elements[8 * e + b]];
        const int low = std::min(i, j), high = std::max(i, j);
        of[symbolic.start[low] + symbolic.place_of(high, low)].push_back(
            (e * kPairs + pair_place(a, b)) * 2 + (i < j));
      }
  std::vector<int> item_start(1, 0), item;
  for (const auto& some : of) {
    item.insert(item.end(), some.begin(), some.end());
    item_start.push_back(int(item.size()));
  }
  ElementTable host;
  std::memcpy(host.grad, scene.grad, sizeof(host.grad));
  std::memcpy(host.weight, scene.weight, sizeof(host.weight));
  host.w_mu = scene.w_mu, host.w_vol = scene.w_vol;
  const Buffer<ElementTable> table(std::vector<ElementTable>{host});
  const Gather gather = Gather::nodes(scene.elements, n);
  const Buffer<int> elements(scene.elements), node_start(gather.start), node_item(gather.item),
      order(symbolic.order), start(symbolic.start), row(symbolic.row),
      update_start(symbolic.update_start), update_slot(symbolic.update_slot),
      update_count(symbolic.update_count), update_place(symbolic.update_place),
      place(symbolic.place), column(column_of), istart(item_start), items(item);
  const Buffer<std::uint8_t> fixed(scene.fixed);
  const Buffer<double> inertia(scene.inertia), from(starts);
  const std::size_t many = std::size_t(members), count = std::size_t(scene.num_elements);
  const Buffer<double> forces(many * count * kVector), matrices(many * count * kPairs * 9),
      L(many * blocks * 9), rhs(many * 3 * n), z(many * 3 * n), to(many * 3 * n);
  const SymbolicView view{n,
                          blocks,
                          order.get(),
                          start.get(),
                          row.get(),
                          update_start.get(),
                          update_slot.get(),
                          update_count.get(),
                          update_place.get(),
                          place.get()};
  constexpr int kHBytes = kUnique * kSampleThreads * int(sizeof(double));
  CHECK(
      cudaFuncSetAttribute(element_matrices, cudaFuncAttributeMaxDynamicSharedMemorySize, kHBytes));
  const dim3 by_element(unsigned(blocks_for(count, kElementsOfBlock)), unsigned(members));
  const dim3 by_entry(unsigned(blocks_for(std::size_t(blocks) * 9)), unsigned(members));
  const dim3 by_node(unsigned(blocks_for(3 * std::size_t(n))), unsigned(members));
  const auto run_forces = [&] {
    element_forces<<<by_element, kSampleThreads>>>(table.get(), elements.get(), int(count),
                                                   from.get(), 3 * std::size_t(n), forces.get(),
                                                   nullptr);
    right_side<<<by_node, kThreads>>>(n, node_start.get(), node_item.get(), count, forces.get(),
                                      fixed.get(), rhs.get());
  };
  const auto run_matrices = [&] {
    element_matrices<<<by_element, kSampleThreads, kHBytes>>>(
        table.get(), elements.get(), int(count), from.get(), 3 * std::size_t(n), matrices.get());
  };
  const auto run_fill = [&] {
    fill<<<by_entry, kThreads>>>(view, istart.get(), items.get(), count, matrices.get(),
                                 inertia.get(), fixed.get(), column.get(), L.get());
  };
  const auto run_factor = [&] {
    factorize<<<blocks_for(many, kWarpsOfBlock), 32 * kWarpsOfBlock>>>(view, members, L.get());
  };
  const auto run_solve = [&] {
    solve<<<blocks_for(many, kWarpsOfBlock), 32 * kWarpsOfBlock>>>(view, members, L.get(),
                                                                   rhs.get(), z.get());
  };
  const auto run_all = [&] {
    run_forces();
    run_matrices();
    run_fill();
    run_factor();
    run_solve();
    finish<<<by_node, kThreads>>>(n, order.get(), z.get(), from.get(), to.get());
  };
  const double all = device_ms(nullptr, 7, run_all);
  const std::vector<double> x = to.host();
  const double f = device_ms(nullptr, 7, run_forces), m = device_ms(nullptr, 7, run_matrices);
  const double both = device_ms(nullptr, 7, [&] {
    run_fill();
    run_factor();
  });
  const double solves = device_ms(nullptr, 7, run_solve);
  const double fills = device_ms(nullptr, 7, run_fill);
  std::printf(
      "%6d bodies of %d DoF: %8.3f ms a step, %9.0f steps/s (forces %.3f, matrices %.3f, "
      "adding up %.3f, factor %.3f, solve %.3f ms; %d products a factor)\n",
      members, 3 * n, all, 1e3 * members / all, f, m, fills, both - fills, solves,
      symbolic.products);
  if (!on_cpu) return;
  for (int threads : {1, 16}) {
    const Answer cpu = batch_on_cpu(scene, starts, threads, 3);
    double off = 0.0, move = 0.0;
    for (std::size_t k = 0; k < x.size(); ++k) {
      off = std::max(off, std::fabs(x[k] - cpu.x[k]));
      move = std::max(move, std::fabs(cpu.x[k] - starts[k]));
    }
    std::printf(
        "       CPU, %2d threads: %9.0f steps/s, with gradient %9.0f; x off by %.1e of "
        "the largest motion\n",
        threads, members / cpu.step_s, members / (cpu.step_s + cpu.adjoint_s), off / move);
    std::fflush(stdout);
  }
}

}  // namespace
}  // namespace study

int main() {
  // 351 nodes as the coarse starfish has, and slender as its arms are.
  const int cells[3] = {38, 2, 2};
  const study::Scene scene = study::make_scene(cells, 10.0);
  for (int members : {1, 16, 64, 256, 1024, 4096, 16384})
    study::compare(scene, members, members == 64 || members == 1024);
}
