#include "kernels/linalg/cholesky_front.h"

#include <algorithm>
#include <cstring>

#include "kernels/linalg/tile_kernels.h"

namespace diffsim {
namespace {

constexpr int kBlockPanels = 16;  // 128 columns: three row tiles of them stay in L1
constexpr int kChunkPanels = 64;  // right operands of an update, 512 KiB: they stay in L2
constexpr int kChunkGroups = 8;   // row groups of one task of an update

template <typename F>
void for_each(ThreadPool* pool, std::int64_t count, F&& f) {
  if (pool) return pool->run(count, f);
  for (std::int64_t i = 0; i < count; ++i) f(i);
}

}  // namespace

/// Triangular diagonal tiles of the panels of one block, before they are replaced by inverses.
template <typename T>
struct Front<T>::Diagonals {
  alignas(64) T lower[kBlockPanels][kTile * kTile];
  T reciprocal[kBlockPanels][kTile];
};

template <typename T>
void Front<T>::set_zero(ThreadPool* pool) const {
  constexpr std::int64_t kChunk = (1 << 20) / sizeof(T);
  const auto clear = [&](T* begin, std::int64_t size) {
    for_each(pool, (size + kChunk - 1) / kChunk, [&](std::int64_t task) {
      const std::int64_t first = task * kChunk;
      std::memset(begin + first, 0, sizeof(T) * std::min(kChunk, size - first));
    });
  };
  clear(own_, node_.factor_size());
  clear(update_, triangle_size(tiles_ - panels_));
}

template <typename T>
void Front<T>::add(const Front& child, const int* map, const int* offset, ThreadPool* pool) const {
  const int rows = child.node_.num_rows;
  for_each(pool, tiles_of(rows), [&](std::int64_t panel) {
    const int begin = static_cast<int>(panel) * kTile;
    for (int c = begin; c < std::min(rows, begin + kTile); ++c) add_column(child, c, map, offset);
  });
}

template <typename T>
void Front<T>::add_column(const Front& child, int c, const int* map, const int* offset) const {
  const int rows = child.node_.num_rows;
  const int col = map[c], p = col / kTile, stride = width(p) * kTile;
  T* const target = tile(p, p) + (col % kTile) * kTile - std::int64_t{p} * stride;
  const int source_panel = child.panels_ + c / kTile;
  const int begin = c / kTile * kTile;  // row of the first source tile
  const T* source = child.tile(source_panel, source_panel) + (c % kTile) * kTile;
  if (stride != kTile * kTile) {  // the narrow last panel
    for (int r = c; r < rows; ++r) {
      target[map[r] / kTile * stride + map[r] % kTile] +=
          source[(r - begin) / kTile * kTile * kTile + r % kTile];
    }
    return;
  }
  for (int r = c; r < std::min(rows, begin + kTile); ++r) target[offset[r]] += source[r - begin];
  int r = begin + kTile;
  for (source += kTile * kTile; r + kTile <= rows; r += kTile, source += kTile * kTile) {
    const int* o = offset + r;
    if (o[kTile - 1] - o[0] == kTile - 1) {  // one whole tile onto another
      for (int k = 0; k < kTile; ++k) target[o[0] + k] += source[k];
    } else {
      for (int k = 0; k < kTile; ++k) target[o[k]] += source[k];
    }
  }
  for (int k = 0; r + k < rows; ++k) target[offset[r + k]] += source[k];
}

template <typename T>
void Front<T>::multiply(int i, int count, int p, int q0, int q1) const {
  const int full = std::min(q1, node_.num_cols / kTile);
  tiles::PanelRun<T> run{};
  run.num_full = std::max(0, full - q0);
  run.step = std::ptrdiff_t{tiles_ - q0 - 1} * kTile * kTile;
  run.left = tile(i, q0);
  run.right = tile(p, q0);
  if (full < q1) {
    run.last_left = tile(i, q1 - 1);
    run.last_right = tile(p, q1 - 1);
    run.last_width = width(q1 - 1);
  }
  T* c = tile(i, p);
  const int w = width(p);
  if (count == 1) {
    tiles::multiply<1>(c, w, run);
  } else if (count == 2) {
    tiles::multiply<2>(c, w, run);
  } else {
    tiles::multiply<3>(c, w, run);
  }
}

template <typename T>
FailedPivot Front<T>::factor_block(int p0, int p1, const double* floor,
                                   Diagonals& diagonals) const {
  constexpr int kRowTiles = tiles::Blocking<T>::kRowTiles;
  for (int p = p0; p < p1; ++p) {
    if (p > p0) {
      for (int i = p; i < p1; i += kRowTiles) {
        multiply(i, std::min(kRowTiles, p1 - i), p, p0, p);
      }
    }
    T* const diagonal = tile(p, p);
    const int w = width(p);
    FailedPivot failed;
    const int column = tiles::factor_diagonal(diagonal, w, floor + p * kTile, &failed.value);
    if (column >= 0) {
      failed.column = p * kTile + column;
      return failed;
    }
    T* const lower = diagonals.lower[p - p0];
    std::memcpy(lower, diagonal, sizeof(T) * kTile * w);
    for (int k = 0; k < w; ++k) diagonals.reciprocal[p - p0][k] = T{1} / lower[k * kTile + k];
    tiles::invert_lower(lower, w, diagonal);
    for (int i = p + 1; i < p1; ++i) {
      tiles::solve_right<1>(tile(i, p), w, lower, diagonals.reciprocal[p - p0]);
    }
  }
  return {};
}

template <typename T>
void Front<T>::solve_rows(int i, int count, int p0, int p1, const Diagonals& diagonals) const {
  for (int p = p0; p < p1; ++p) {
    if (p > p0) multiply(i, count, p, p0, p);
    const T* lower = diagonals.lower[p - p0];
    const T* reciprocal = diagonals.reciprocal[p - p0];
    if (count == 3) {
      tiles::solve_right<3>(tile(i, p), width(p), lower, reciprocal);
    } else {
      for (int r = 0; r < count; ++r) {
        tiles::solve_right<1>(tile(i + r, p), width(p), lower, reciprocal);
      }
    }
  }
}

template <typename T>
void Front<T>::update_rows(int i, int count, int c0, int c1, int p0, int p1) const {
  for (int p = c0; p < std::min(c1, i + count); ++p) {
    const int first = std::max(i, p);
    multiply(first, i + count - first, p, p0, p1);
  }
}

template <typename T>
FailedPivot Front<T>::factor(const double* floor, ThreadPool* pool) const {
  constexpr int kRowTiles = tiles::Blocking<T>::kRowTiles;
  Diagonals diagonals;
  for (int p0 = 0; p0 < panels_; p0 += kBlockPanels) {
    const int p1 = std::min(panels_, p0 + kBlockPanels);
    const FailedPivot failed = factor_block(p0, p1, floor, diagonals);
    if (failed.column >= 0) return failed;
    const int groups = (tiles_ - p1 + kRowTiles - 1) / kRowTiles;
    const auto row = [&](std::int64_t g) { return p1 + static_cast<int>(g) * kRowTiles; };
    const auto count = [&](int i) { return std::min(kRowTiles, tiles_ - i); };
    const auto solve = [&](std::int64_t g) {
      solve_rows(row(g), count(row(g)), p0, p1, diagonals);
    };
    // Chunk by chunk of columns, so that a chunk is read from far away only once.
    const int bands = (groups + kChunkGroups - 1) / kChunkGroups;
    const int chunks = (tiles_ - p1 + kChunkPanels - 1) / kChunkPanels;
    const auto update = [&](std::int64_t task) {
      const int chunk = static_cast<int>(task / bands), band = static_cast<int>(task % bands);
      const int c0 = p1 + chunk * kChunkPanels;
      for (int g = band * kChunkGroups; g < std::min(groups, (band + 1) * kChunkGroups); ++g) {
        update_rows(row(g), count(row(g)), c0, c0 + kChunkPanels, p0, p1);
      }
    };
    for_each(pool, groups, solve);
    for_each(pool, std::int64_t{bands} * chunks, update);
  }
  return {};
}

template class Front<double>;
template class Front<float>;

}  // namespace diffsim
