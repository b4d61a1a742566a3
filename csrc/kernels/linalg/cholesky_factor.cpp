// CholeskyFactor: multifrontal factorization.
#include <cmath>
#include <cstring>
#include <limits>
#include <mutex>
#include <string>
#include <type_traits>
#include <vector>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/cholesky_front.h"
#include "kernels/linalg/cholesky_symbolic.h"

namespace diffsim {

NotPositiveDefinite::NotPositiveDefinite(std::int64_t unknown_index, double pivot_value)
    : std::runtime_error("matrix is not positive definite: pivot of unknown " +
                         std::to_string(unknown_index) + " is " + std::to_string(pivot_value)),
      unknown(unknown_index),
      pivot(pivot_value) {}

namespace {
constexpr int kSplitTiles = 128;  // fronts from here on keep several threads busy
}

/// One factorization in progress.
/// @tparam T  double or float, what it computes in
template <typename T>
struct CholeskyFactor::Refactor {
  const CholeskySymbolic& sym;
  const double* values;
  CholeskyMemory& memory;
  T* fronts;
  bool is_stored_as_computed;
  double relative_floor;            // smallest accepted pivot, relative to the diagonal entry
  std::vector<double> floor;        // by elimination order
  std::vector<FailedPivot> failed;  // by supernode
  std::mutex mutex;                 // of memory.panels

  /// Adds the matrix's own entries and notes the smallest pivots to accept.
  void assemble(const CholeskySupernode& node, const Front<T>& front) {
    const int block = sym.block;
    for (std::int64_t e = node.entries; e < node.entries_end; ++e) {
      const CholeskyEntry& entry = sym.entries[e];
      const double* value = values + entry.source * block * block;
      // The stored block sits in the column's row of A: its transpose belongs below the diagonal.
      int col = entry.col;
      for (int b = 0; b < block; ++b) {
        if (!(entry.col_mask >> b & 1)) continue;
        int row = entry.row;
        for (int a = 0; a < block; ++a) {
          if (!(entry.row_mask >> a & 1)) continue;
          if (row >= col) front.at(row, col) += static_cast<T>(value[b * block + a]);
          ++row;
        }
        ++col;
      }
    }
    for (int k = 0; k < node.num_cols; ++k) {
      floor[node.first + k] = relative_floor * front.at(k, k);
    }
  }

  bool run(int s, ThreadPool* pool) {
    const CholeskySupernode& node = sym.supernodes[s];
    if constexpr (std::is_same_v<T, float>) {
      return factor_supernode(s, memory.factor32.data() + node.factor, pool);
    } else {
      if (is_stored_as_computed)
        return factor_supernode(s, memory.factor.data() + node.factor, pool);
      AlignedBuffer<double> panels = take_panels();
      const double* own = panels.resize(node.factor_size());
      const bool done = factor_supernode(s, panels.data(), pool);
      float* rounded = memory.factor32.data() + node.factor;
      for (std::int64_t i = 0; i < node.factor_size(); ++i) rounded[i] = static_cast<float>(own[i]);
      const std::lock_guard<std::mutex> lock(mutex);
      memory.panels.push_back(std::move(panels));
      return done;
    }
  }

  /// What another supernode has left, or nothing yet.
  AlignedBuffer<double> take_panels() {
    const std::lock_guard<std::mutex> lock(mutex);
    if (memory.panels.empty()) return {};
    AlignedBuffer<double> panels = std::move(memory.panels.back());
    memory.panels.pop_back();
    return panels;
  }

  /// @param own  where its panels of L go
  bool factor_supernode(int s, T* own, ThreadPool* pool) {
    const CholeskySupernode& node = sym.supernodes[s];
    const Front<T> front(node, own, fronts);
    front.set_zero(pool);
    assemble(node, front);
    for (std::int64_t c = node.children; c < node.children_end; ++c) {
      const CholeskySupernode& child = sym.supernodes[sym.children[c]];
      front.add(Front<T>(child, nullptr, fronts), sym.row_in_parent.data() + child.rows,
                sym.row_offset_in_parent.data() + child.rows, pool);
    }
    failed[s] = front.factor(floor.data() + node.first, pool);
    return failed[s].column < 0;
  }

  void check() const {
    for (std::size_t s = 0; s < failed.size(); ++s) {
      if (failed[s].column < 0) continue;
      throw NotPositiveDefinite(sym.unknown[sym.supernodes[s].first + failed[s].column],
                                failed[s].value);
    }
  }
};

CholeskyFactor::CholeskyFactor(std::shared_ptr<const CholeskySymbolic> symbolic,
                               FactorPrecision precision, CholeskyMemory memory)
    : symbolic_(std::move(symbolic)), precision_(precision), memory_(std::move(memory)) {}

template <typename T>
void CholeskyFactor::refactor_in(const double* values, ThreadPool& pool) {
  const CholeskySymbolic& sym = *symbolic_;
  // The last pivot of a singular matrix is the sum of all entries' rounding errors, weighted by the
  // null vector: about eps sqrt(nnz) of its diagonal entry. Below a few times that it is noise.
  const double entries = static_cast<double>(sym.num_blocks) * sym.block * sym.block;
  const double floor = 4 * std::numeric_limits<T>::epsilon() * std::sqrt(entries);
  const std::size_t fronts_bytes = static_cast<std::size_t>(sym.fronts_size) * sizeof(T);
  T* fronts = reinterpret_cast<T*>(memory_.fronts.resize(fronts_bytes));
  Refactor<T> work{sym,
                   values,
                   memory_,
                   fronts,
                   precision_ == FactorPrecision::kFloat64,
                   floor,
                   std::vector<double>(sym.num_unknowns),
                   std::vector<FailedPivot>(sym.supernodes.size()),
                   {}};
  pool.run(static_cast<std::int64_t>(sym.tasks.size()), [&](std::int64_t t) {
    for (const auto& [begin, end] : sym.tasks[t]) {
      for (int s = begin; s < end; ++s) {
        if (!work.run(s, nullptr)) return;
      }
    }
  });
  work.check();
  for (const std::vector<int>& level : sym.levels) {
    // Large fronts one after the other, split among the threads; smaller ones side by side.
    const auto small = [&](int s) {
      return level.size() >= static_cast<std::size_t>(pool.size()) &&
             sym.supernodes[s].num_tiles() < kSplitTiles;
    };
    pool.run(static_cast<std::int64_t>(level.size()), [&](std::int64_t i) {
      if (small(level[i])) work.run(level[i], nullptr);
    });
    for (int s : level) {
      if (!small(s)) work.run(s, &pool);
    }
    work.check();
  }
}

void CholeskyFactor::refactor(const double* values, ThreadPool& pool) {
  usable_ = false;
  if (precision_ == FactorPrecision::kFloat64)
    memory_.factor.resize(symbolic_->factor_size);
  else
    memory_.factor32.resize(symbolic_->factor_size);
  bool is_done = false;
  if (precision_ == FactorPrecision::kFloat32) {
    try {
      refactor_in<float>(values, pool);
      is_done = true;
    } catch (const NotPositiveDefinite&) {  // to single precision
    }
  }
  if (!is_done) refactor_in<double>(values, pool);
  usable_ = true;
}

void CholeskyFactor::release_refactor_memory() {
  memory_.fronts.release();
  memory_.panels.clear();
}
CholeskyMemory CholeskyFactor::take_memory() {
  usable_ = false;
  return std::move(memory_);
}

std::int64_t CholeskyFactor::num_unknowns() const { return symbolic_->num_unknowns; }
std::int64_t CholeskyFactor::nnz() const { return symbolic_->nnz; }
double CholeskyFactor::flops() const { return symbolic_->flops; }
std::int64_t CholeskyFactor::bytes() const {
  const bool single = precision_ != FactorPrecision::kFloat64;
  return symbolic_->factor_size * (single ? sizeof(float) : sizeof(double));
}

}  // namespace diffsim
