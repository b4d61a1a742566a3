// How the items of a batch are laid out and shared among threads.
#pragma once

#include "kernels/parallel.h"

namespace diffsim {

/// Item k of an array of items of `stride` values; null stays null.
template <typename T>
T* offset(T* base, std::int64_t k, std::int64_t stride) {
  return base ? base + k * stride : nullptr;
}

/// Calls f(item, pool): one item gets all threads, several are dealt out, one thread each.
template <typename F>
void for_batch(std::int64_t batch, int num_threads, F&& f) {
  ThreadPool pool(num_threads);
  if (batch == 1) {
    f(0, pool);
    return;
  }
  pool.run(batch, [&](std::int64_t k) {
    ThreadPool alone(1);
    f(k, alone);
  });
}

}  // namespace diffsim
