// Rows of a vector shared out to threads.
#pragma once

#include <algorithm>

#include "kernels/parallel.h"

namespace diffsim {

/// f(i) for i < n, in tasks of 256.
template <typename F>
void for_chunks(std::int64_t n, ThreadPool& pool, F&& f) {
  constexpr std::int64_t kChunk = 256;
  pool.run((n + kChunk - 1) / kChunk, [&](std::int64_t task) {
    for (std::int64_t i = task * kChunk; i < std::min(n, (task + 1) * kChunk); ++i) f(i);
  });
}

}  // namespace diffsim
