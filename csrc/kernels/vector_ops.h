// Long vectors whose sums do not depend on the number of threads: fixed chunks, combined in order.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "kernels/linalg/lanes.h"
#include "kernels/parallel.h"

namespace diffsim {

using Vector = std::vector<double>;

class VectorOps {
 public:
  explicit VectorOps(ThreadPool& pool) : pool_(pool) {}

  double dot(const Vector& a, const Vector& b) {
    return sum_of_chunks(size(a), [&](std::int64_t begin, std::int64_t end) {
      return dot_of_chunk(a, b, begin, end);
    });
  }
  double norm(const Vector& a) { return std::sqrt(dot(a, a)); }

  /// y += alpha x
  void add(double alpha, const Vector& x, Vector& y) {
    for_chunks(size(y), [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) y[u(i)] += alpha * x[u(i)];
    });
  }
  /// y += alpha x, and the dot product of `a` with what y is then, in one pass.
  double add_and_dot(double alpha, const Vector& x, Vector& y, const Vector& a) {
    return sum_of_chunks(size(y), [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) y[u(i)] += alpha * x[u(i)];
      return dot_of_chunk(a, y, begin, end);
    });
  }
  /// y = x + beta y
  void scale_add(const Vector& x, double beta, Vector& y) {
    for_chunks(size(y), [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t i = begin; i < end; ++i) y[u(i)] = x[u(i)] + beta * y[u(i)];
    });
  }

 private:
  static constexpr std::int64_t kChunk = 4096;
  static std::size_t u(std::int64_t i) { return static_cast<std::size_t>(i); }
  static std::int64_t size(const Vector& v) { return static_cast<std::int64_t>(v.size()); }

  static double dot_of_chunk(const Vector& a, const Vector& b, std::int64_t begin,
                             std::int64_t end) {
    // Eight running sums fill vector registers without reordering a sum.
    Native sums[kParts] = {};
    std::int64_t i = begin;
    for (; i + kLanes <= end; i += kLanes)
      for (int part = 0; part < kParts; ++part) {
        Native x, y;
        std::memcpy(&x, a.data() + i + part * kNativeLanes, sizeof(Native));
        std::memcpy(&y, b.data() + i + part * kNativeLanes, sizeof(Native));
        sums[part] += x * y;
      }
    double lane[kLanes];
    std::memcpy(lane, sums, sizeof(lane));
    double total = 0.0;
    for (double v : lane) total += v;
    for (; i < end; ++i) total += a[u(i)] * b[u(i)];
    return total;
  }
  /// Of f(begin, end) over all chunks.
  template <typename F>
  double sum_of_chunks(std::int64_t n, F&& f) {
    partial_.resize(u((n + kChunk - 1) / kChunk));
    for_chunks(n, [&](std::int64_t begin, std::int64_t end) {
      partial_[u(begin / kChunk)] = f(begin, end);
    });
    double total = 0.0;
    for (double v : partial_) total += v;
    return total;
  }

  template <typename F>
  void for_chunks(std::int64_t n, F&& f) {
    const std::int64_t tasks = (n + kChunk - 1) / kChunk;
    const auto run = [&](std::int64_t t) { f(t * kChunk, std::min(n, (t + 1) * kChunk)); };
    if (tasks < 8)  // waking threads would cost more than the work
      for (std::int64_t t = 0; t < tasks; ++t) run(t);
    else
      pool_.run(tasks, run);
  }

  ThreadPool& pool_;
  Vector partial_;
};

}  // namespace diffsim
