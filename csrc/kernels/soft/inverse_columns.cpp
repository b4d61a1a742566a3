#include "kernels/soft/inverse_columns.h"

#include "kernels/soft/constant_system.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

// Right-hand sides per pass over the factor: enough to reuse each tile from the cache.
constexpr std::size_t kWidth = 24;

}  // namespace

void InverseColumns::require(const std::vector<std::int64_t>& nodes, ThreadPool& pool) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const std::size_t n = at(system_.model().num_nodes);
  columns_.resize(at(system_.num_factors()));
  CholeskyWorkspace workspace;
  Vector block;
  for (std::size_t f = 0; f < columns_.size(); ++f) {
    columns_[f].resize(n);
    std::vector<std::int64_t> missing;
    for (std::int64_t node : nodes)
      if (!columns_[f][at(node)]) missing.push_back(node);
    for (std::size_t first = 0; first < missing.size(); first += kWidth) {
      const std::size_t width = std::min(kWidth, missing.size() - first);
      block.assign(n * width, 0.0);
      for (std::size_t k = 0; k < width; ++k) block[at(missing[first + k]) * width + k] = 1.0;
      system_.factor(static_cast<int>(f))
          .solve(block.data(), block.data(), static_cast<int>(width), workspace, pool);
      for (std::size_t k = 0; k < width; ++k) {
        auto column = std::make_unique<double[]>(n);
        for (std::size_t i = 0; i < n; ++i) column[i] = block[i * width + k];
        columns_[f][at(missing[first + k])] = std::move(column);
      }
    }
  }
}

const double* InverseColumns::column(std::int64_t node, int axis) const {
  return columns_[at(system_.factor_of_axis(axis))][at(node)].get();
}

void InverseColumns::clear() { columns_.clear(); }

}  // namespace diffsim
