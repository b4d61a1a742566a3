// Rows of numbers of which equal ones are kept once. Away from walls all rows of a matrix on a grid
// are the same: a product that finds them in one place finds them in cache.
#pragma once

#include <cstdint>
#include <cstring>
#include <vector>

#include "kernels/subscript.h"

namespace diffsim {

/// Of bytes; equal ones have equal hashes.
inline std::uint64_t hash_bytes(const void* from, std::size_t count) {
  constexpr std::uint64_t kOdd = 0x9E3779B97F4A7C15u;  // 2^64 over the golden ratio (Knuth)
  constexpr int kChains = 4;                           // that do not wait for each other
  const char* next = static_cast<const char*>(from);
  std::uint64_t hash[kChains] = {1, 2, 3, 4};
  const auto mix = [](std::uint64_t& h, std::uint64_t word) {
    h = (h ^ word) * kOdd;
    h ^= h >> 32;
  };
  constexpr std::size_t kWord = sizeof(std::uint64_t);
  for (; count >= kChains * kWord; count -= kChains * kWord, next += kChains * kWord)
    for (std::size_t i = 0; i < kChains; ++i) {
      std::uint64_t word;
      std::memcpy(&word, next + i * kWord, kWord);
      mix(hash[i], word);
    }
  for (; count > 0; --count, ++next) mix(hash[0], static_cast<unsigned char>(*next));
  for (int i = 1; i < kChains; ++i) mix(hash[0], hash[i]);
  return hash[0];
}

/// Moves rows of numbers together, so that those with the same bytes lie in one place.
/// @param values rows one after another; then the distinct ones, in the order of their first
/// @param begin  (num_rows + 1,) of rows, in numbers
/// @param alike  alike(i, k): whether rows of equal numbers mean the same
/// @param[out] start (num_rows,) where a row begins now
/// @return how many numbers are left
template <typename T, typename Alike>
std::int64_t keep_distinct_rows(T* values, const std::vector<std::int64_t>& begin, Alike&& alike,
                                std::vector<std::int64_t>& start) {
  const std::int64_t num_rows = static_cast<std::int64_t>(begin.size()) - 1;
  struct Place {
    std::uint64_t hash;
    std::int64_t row;  // the first that has it, or -1
  };
  std::size_t size = 2;
  while (size < 2 * u(num_rows)) size *= 2;
  std::vector<Place> table(size, {0, -1});
  start.resize(u(num_rows));
  std::int64_t kept = 0;
  for (std::int64_t i = 0; i < num_rows; ++i) {
    const std::int64_t count = begin[u(i) + 1] - begin[u(i)];
    const std::size_t bytes = u(count) * sizeof(T);
    const T* row = values + begin[u(i)];
    const std::uint64_t hash = hash_bytes(row, bytes);
    const auto same = [&](const Place& place) {
      return place.hash == hash && begin[u(place.row) + 1] - begin[u(place.row)] == count &&
             std::memcmp(values + start[u(place.row)], row, bytes) == 0 && alike(place.row, i);
    };
    std::size_t at = hash & (size - 1);
    while (table[at].row >= 0 && !same(table[at])) at = (at + 1) & (size - 1);
    if (table[at].row < 0) {
      table[at] = {hash, i};
      start[u(i)] = kept;
      std::memmove(values + kept, row, bytes);
      kept += count;
    } else {
      start[u(i)] = start[u(table[at].row)];
    }
  }
  return kept;
}

}  // namespace diffsim
