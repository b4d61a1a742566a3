#include "kernels/linalg/batched_svd.h"

#include <algorithm>
#include <cstring>

#include "kernels/linalg/svd3.h"
#include "kernels/linalg/svd3_vjp.h"
#include "kernels/parallel.h"

namespace diffsim {
namespace {

constexpr int kGroup = 2 * kLanes;                   // matrices per call of the lane kernels
constexpr std::int64_t kTaskMatrices = 32 * kGroup;  // matrices per task

// Calls f(first, count) for groups of at most kGroup matrices, in parallel over fixed blocks.
template <class F>
void for_groups(std::int64_t n, int num_threads, F&& f) {
  const std::int64_t num_blocks = (n + kTaskMatrices - 1) / kTaskMatrices;
  ThreadPool pool(static_cast<int>(std::min<std::int64_t>(num_threads, num_blocks)));
  pool.run(num_blocks, [&](std::int64_t block) {
    const std::int64_t end = std::min(n, (block + 1) * kTaskMatrices);
    for (std::int64_t i = block * kTaskMatrices; i < end; i += kGroup) {
      f(i, static_cast<int>(std::min<std::int64_t>(kGroup, end - i)));
    }
  });
}

// Records [first, first + count) of kSize doubles to two Lanes and back; missing ones are zero.
template <int kSize>
void load_group(const double* p, std::int64_t first, int count, Lane* out) {
  alignas(64) double padded[kSize * kGroup];
  const double* from = p + first * kSize;
  if (count < kGroup) {
    std::memset(padded, 0, sizeof(padded));
    std::memcpy(padded, from, sizeof(double) * kSize * count);
    from = padded;
  }
  load_records<kSize, Lane>(from, out);
  load_records<kSize, Lane>(from + kLanes * kSize, out + kSize);
}
template <int kSize>
void store_group(double* p, std::int64_t first, int count, const Lane* in) {
  alignas(64) double padded[kSize * kGroup];
  double* to = count < kGroup ? padded : p + first * kSize;
  store_records<kSize, Lane>(to, in);
  store_records<kSize, Lane>(to + kLanes * kSize, in + kSize);
  if (count < kGroup) std::memcpy(p + first * kSize, padded, sizeof(double) * kSize * count);
}

}  // namespace

void batched_svd3(const double* F, std::int64_t n, double* U, double* s, double* V,
                  int num_threads) {
  for_groups(n, num_threads, [=](std::int64_t first, int count) {
    Lane f[18], u[18], sigma[6], v[18];
    load_group<9>(F, first, count, f);
    svd3<2>(f, u, sigma, v);
    store_group<9>(U, first, count, u);
    store_group<3>(s, first, count, sigma);
    store_group<9>(V, first, count, v);
  });
}

void batched_svd3_vjp(const double* U, const double* s, const double* V, const double* grad_U,
                      const double* grad_s, const double* grad_V, std::int64_t n, double* grad_F,
                      int num_threads) {
  for_groups(n, num_threads, [=](std::int64_t first, int count) {
    Lane u[18], sigma[6], v[18], gu[18], gs[6], gv[18], gf[18];
    load_group<9>(U, first, count, u);
    load_group<3>(s, first, count, sigma);
    load_group<9>(V, first, count, v);
    load_group<9>(grad_U, first, count, gu);
    load_group<3>(grad_s, first, count, gs);
    load_group<9>(grad_V, first, count, gv);
    svd3_vjp<2>(u, sigma, v, gu, gs, gv, gf);
    store_group<9>(grad_F, first, count, gf);
  });
}

void batched_polar3(const double* F, std::int64_t n, double* R, int num_threads) {
  for_groups(n, num_threads, [=](std::int64_t first, int count) {
    Lane f[18], r[18];
    load_group<9>(F, first, count, f);
    polar3<2>(f, r);
    store_group<9>(R, first, count, r);
  });
}

void batched_polar3_vjp(const double* F, const double* R, const double* grad_R, std::int64_t n,
                        double* grad_F, int num_threads) {
  for_groups(n, num_threads, [=](std::int64_t first, int count) {
    Lane f[18], r[18], gr[18], gf[18];
    load_group<9>(F, first, count, f);
    load_group<9>(R, first, count, r);
    load_group<9>(grad_R, first, count, gr);
    polar3_vjp<2>(f, r, gr, gf);
    store_group<9>(grad_F, first, count, gf);
  });
}

}  // namespace diffsim
