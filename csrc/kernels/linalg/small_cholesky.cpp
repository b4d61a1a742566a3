#include "kernels/linalg/small_cholesky.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "kernels/linalg/registers.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

constexpr std::ptrdiff_t kBlock = SmallCholesky::kBlock;
constexpr int kColumn = SmallCholesky::kColumn;
// Columns to the left that are taken at once: a block that they change is loaded and stored once.
constexpr int kMostColumns = 4;

#if defined(__AVX__)
using Column = double __attribute__((vector_size(kColumn * sizeof(double))));
#else
using Column = Registers<Native, 2>;
#endif
DIFFSIM_INLINE Column load_column(const double* p) {
  Column c;
  std::memcpy(&c, p, sizeof(Column));
  return c;
}
DIFFSIM_INLINE Column fill(double value) {
#if defined(__AVX__)
  return broadcast<Column>(value);
#else
  return {broadcast<Native>(value), broadcast<Native>(value)};
#endif
}

/// A block times a vector of three.
DIFFSIM_INLINE Column times_vector(const double* block, const double* v) {
  return load_column(block) * v[0] + load_column(block + kColumn) * v[1] +
         load_column(block + 2 * kColumn) * v[2];
}

/// A sum of transposed blocks times vectors.
struct TransposedProduct {
  Column sum[3] = {fill(0.0), fill(0.0), fill(0.0)};

  DIFFSIM_INLINE void add(const double* block, const Column& v) {
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) sum[k] += load_column(block + k * kColumn) * v;
  }
  DIFFSIM_INLINE double entry(int k) const {
    double parts[kColumn];
    store(parts, sum[k]);
    return parts[0] + parts[1] + parts[2];
  }
};

/// Vectors (num_nodes, 3) into columns in elimination order, and back.
void put(const std::vector<int>& order, const double* from, double* to) {
  for (int node : order) {
    for (int i = 0; i < 3; ++i) to[i] = from[3 * node + i];
    to[3] = 0.0;
    to += kColumn;
  }
}
void get(const std::vector<int>& order, const double* from, double* to) {
  for (int node : order) {
    for (int i = 0; i < 3; ++i) to[3 * node + i] = from[i];
    from += kColumn;
  }
}

using Rows = std::vector<std::vector<int>>;

/// The graph that is left when nodes are eliminated, a row of bits for each node.
class EliminationGraph {
 public:
  EliminationGraph(const std::vector<std::int64_t>& row_start,
                   const std::vector<std::int32_t>& column)
      : words_((row_start.size() + kBits - 2) / kBits), bits_((row_start.size() - 1) * words_, 0) {
    for (std::size_t i = 0; i + 1 < row_start.size(); ++i)
      for (std::int64_t k = row_start[i]; k < row_start[i + 1]; ++k) set(i, at(column[at(k)]));
  }

  /// Calls f(neighbor) in ascending order; a node left is its own neighbor.
  template <typename F>
  void for_neighbors(std::size_t node, F&& f) const {
    for (std::size_t w = 0; w < words_; ++w)
      for (std::uint64_t left = row(node)[w]; left; left &= left - 1)
        f(w * kBits + at(__builtin_ctzll(left)));
  }
  /// Twice the edges that eliminating a node would add.
  std::int64_t fill(std::size_t node) const {
    const std::uint64_t* own = row(node);
    std::int64_t missing = 0;
    for_neighbors(node, [&](std::size_t other) {
      for (std::size_t w = 0; w < words_; ++w)
        missing += __builtin_popcountll(own[w] & ~row(other)[w]);
    });
    return missing;
  }
  /// Joins the neighbors of a node and takes it out of their rows.
  void eliminate(std::size_t node) {
    for_neighbors(node, [&](std::size_t other) {
      if (other == node) return;
      for (std::size_t w = 0; w < words_; ++w) row(other)[w] |= row(node)[w];
      row(other)[node / kBits] &= ~(std::uint64_t{1} << node % kBits);
    });
  }

 private:
  static constexpr std::size_t kBits = 64;
  const std::uint64_t* row(std::size_t i) const { return bits_.data() + i * words_; }
  std::uint64_t* row(std::size_t i) { return bits_.data() + i * words_; }
  void set(std::size_t i, std::size_t j) { row(i)[j / kBits] |= std::uint64_t{1} << j % kBits; }

  std::size_t words_;
  std::vector<std::uint64_t> bits_;
};

/// Nodes by the fill that they make in the graph that is left of them, least first (of equal ones
/// the first).
std::vector<int> minimum_fill(const std::vector<std::int64_t>& row_start,
                              const std::vector<std::int32_t>& column) {
  constexpr std::int64_t kUnknown = -1, kDone = std::numeric_limits<std::int64_t>::max();
  const std::size_t n = row_start.size() - 1;
  EliminationGraph graph(row_start, column);
  std::vector<int> order;
  std::vector<std::int64_t> fill(n, kUnknown);
  while (order.size() < n) {
    for (std::size_t i = 0; i < n; ++i)
      if (fill[i] == kUnknown) fill[i] = graph.fill(i);
    const std::size_t node = at(std::min_element(fill.begin(), fill.end()) - fill.begin());
    order.push_back(static_cast<int>(node));
    graph.eliminate(node);
    // New edges are between its neighbors: only these and theirs count them.
    graph.for_neighbors(node, [&](std::size_t other) {
      if (other != node) graph.for_neighbors(other, [&](std::size_t i) { fill[i] = kUnknown; });
    });
    fill[node] = kDone;
  }
  return order;
}

std::vector<int> positions(const std::vector<int>& order) {
  std::vector<int> position(order.size());
  for (std::size_t k = 0; k < order.size(); ++k) position[at(order[k])] = static_cast<int>(k);
  return position;
}

/// Rows of the columns of L in an order, diagonal first, ascending: those of A and those of the
/// columns whose first row below is this one.
Rows factor_rows(const std::vector<std::int64_t>& row_start,
                 const std::vector<std::int32_t>& column, const std::vector<int>& order) {
  const int n = static_cast<int>(order.size());
  const std::vector<int> position = positions(order);
  Rows rows(at(n)), children(at(n));
  std::vector<int> mark(at(n), -1);
  for (int j = 0; j < n; ++j) {
    std::vector<int>& own = rows[at(j)];
    const auto add = [&](int row) {
      if (row < j || mark[at(row)] == j) return;
      mark[at(row)] = j;
      own.push_back(row);
    };
    const int node = order[at(j)];
    for (std::int64_t k = row_start[at(node)]; k < row_start[at(node + 1)]; ++k)
      add(position[at(column[at(k)])]);
    for (int child : children[at(j)])
      for (int row : rows[at(child)]) add(row);
    std::sort(own.begin(), own.end());
    if (own.size() > 1) children[at(own[1])].push_back(j);
  }
  return rows;
}

/// The same order and fill with children just before their parents, so that columns of equal rows
/// stand side by side.
std::vector<int> postorder(const Rows& rows, const std::vector<int>& order) {
  const std::size_t n = rows.size();
  Rows children(n + 1);  // the last: of no parent
  for (std::size_t j = 0; j < n; ++j)
    children[rows[j].size() > 1 ? at(rows[j][1]) : n].push_back(static_cast<int>(j));
  std::vector<int> result, todo(children[n].rbegin(), children[n].rend());
  std::vector<char> opened(n, 0);
  while (!todo.empty()) {
    const int j = todo.back();
    if (opened[at(j)]) {
      todo.pop_back();
      result.push_back(order[at(j)]);
      continue;
    }
    opened[at(j)] = 1;
    todo.insert(todo.end(), children[at(j)].rbegin(), children[at(j)].rend());
  }
  return result;
}

/// Changes one column of blocks by `count` ones to its left that have equal rows.
/// @param left   where their blocks of the first row would be
/// @param first  slot of the changed column's own row among these rows
template <int count>
void subtract_products(const double* const left[], const int* row, int first, int last,
                       const int* slot_of_row, double* L) {
  Column b[count][9];
  for (int i = 0; i < count; ++i)
    for (int q = 0; q < 3; ++q)
      for (int k = 0; k < 3; ++k) b[i][3 * q + k] = fill(left[i][first * kBlock + q * kColumn + k]);
  for (int s = first; s < last; ++s) {
    double* to = L + slot_of_row[row[s]] * kBlock;
    Column c[3];
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) c[k] = load_column(to + k * kColumn);
#pragma GCC unroll 4
    for (int i = 0; i < count; ++i)
#pragma GCC unroll 3
      for (int q = 0; q < 3; ++q) {
        const Column a = load_column(left[i] + s * kBlock + q * kColumn);
#pragma GCC unroll 3
        for (int k = 0; k < 3; ++k) c[k] -= a * b[i][3 * q + k];
      }
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) store(to + k * kColumn, c[k]);
  }
}

}  // namespace

SmallPattern::SmallPattern(const std::vector<std::int64_t>& row_start,
                           const std::vector<std::int32_t>& column)
    : order_(minimum_fill(row_start, column)), place_(column.size()) {
  order_ = postorder(factor_rows(row_start, column, order_), order_);
  const Rows rows = factor_rows(row_start, column, order_);
  const std::vector<int> position = positions(order_);
  const int n = static_cast<int>(order_.size());
  std::vector<std::pair<int, std::int64_t>> entries;
  start_.assign(1, 0);
  a_start_.assign(1, 0);
  for (int j = 0; j < n; ++j) {
    const std::vector<int>& own = rows[at(j)];
    row_.insert(row_.end(), own.begin(), own.end());
    start_.push_back(static_cast<int>(row_.size()));
    // A's blocks of this column, in the order of its rows.
    const int node = order_[at(j)];
    entries.clear();
    for (std::int64_t k = row_start[at(node)]; k < row_start[at(node + 1)]; ++k) {
      const int row = position[at(column[at(k)])];
      if (row >= j) entries.emplace_back(row, k);
    }
    std::sort(entries.begin(), entries.end());
    for (const auto& [row, k] : entries) {
      const auto slot = std::lower_bound(own.begin(), own.end(), row) - own.begin();
      place_[at(k)] = {static_cast<std::int32_t>(a_row_.size()), row != j};
      a_row_.push_back(row);
      a_column_.push_back(j);
      a_slot_.push_back(start_[at(j)] + static_cast<int>(slot));
    }
    a_start_.push_back(static_cast<int>(a_row_.size()));
  }
  // The other triangle's entries: the same blocks as they are, row first.
  for (int i = 0; i < n; ++i)
    for (std::int64_t k = row_start[at(i)]; k < row_start[at(i + 1)]; ++k) {
      const std::int64_t other = column[at(k)];
      if (position[at(other)] >= position[at(i)]) continue;
      const auto begin = column.begin() + row_start[at(other)];
      const auto end = column.begin() + row_start[at(other + 1)];
      place_[at(k)] = {place_[at(std::find(begin, end, i) - column.begin())].block, false};
    }
  std::vector<std::vector<Update>> updates(at(n));
  for (int k = 0, count; k < n; k += count) {
    const int height = static_cast<int>(rows[at(k)].size());
    count = 1;
    while (count < kMostColumns && count < height && rows[at(k)][at(count)] == k + count &&
           static_cast<int>(rows[at(k + count)].size()) == height - count)
      ++count;
    for (int s = 1; s < height; ++s) {
      const int most = std::min(count, s);
      updates[at(rows[at(k)][at(s)])].push_back({k, most, s});
      num_products_ += most * (height - s);
    }
  }
  update_start_.assign(1, 0);
  for (const auto& list : updates) {
    update_.insert(update_.end(), list.begin(), list.end());
    update_start_.push_back(static_cast<int>(update_.size()));
  }
}

void SmallCholesky::clear(const SmallPattern& pattern) {
  const std::size_t size = at(pattern.num_blocks() * kBlock);
  std::memset(matrix_.resize(size), 0, size * sizeof(double));
}

// A column is filled just before it is factored: it is then in the nearest cache.
void SmallCholesky::fill_column(const SmallPattern& pattern, const std::uint8_t* fixed, int j) {
  const std::ptrdiff_t begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
  std::memset(factor_.data() + begin * kBlock, 0, at((end - begin) * kBlock) * sizeof(double));
  for (std::size_t b = at(pattern.a_start_[at(j)]); b < at(pattern.a_start_[at(j + 1)]); ++b) {
    double* block = factor_.data() + pattern.a_slot_[b] * kBlock;
    std::memcpy(block, matrix_.data() + b * at(kBlock), at(kBlock) * sizeof(double));
    const std::uint8_t* row = fixed + 3 * pattern.order_[at(pattern.a_row_[b])];
    const std::uint8_t* column = fixed + 3 * pattern.order_[at(pattern.a_column_[b])];
    if (!(row[0] | row[1] | row[2] | column[0] | column[1] | column[2])) continue;
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)
        if (row[i] || column[k]) block[kColumn * k + i] = row == column && i == k ? 1.0 : 0.0;
  }
}

bool SmallCholesky::factor(const SmallPattern& pattern, const std::uint8_t* fixed) {
  const int n = static_cast<int>(pattern.num_nodes());
  double* L = factor_.resize(at(pattern.num_factor_blocks() * kBlock));
  slot_of_row_.assign(at(n), 0);
  // As in CholeskyFactor: below this of its diagonal entry a pivot is noise.
  const double relative = 4.0 * std::numeric_limits<double>::epsilon() *
                          std::sqrt(9.0 * static_cast<double>(pattern.place_.size()));
  bool is_definite = true;
  for (int j = 0; j < n; ++j) {
    fill_column(pattern, fixed, j);
    const int begin = pattern.start_[at(j)];
    double floor[3];
    for (int i = 0; i < 3; ++i) floor[i] = relative * L[begin * kBlock + (kColumn + 1) * i];
    for (int s = begin; s < pattern.start_[at(j + 1)]; ++s)
      slot_of_row_[at(pattern.row_[at(s)])] = s;
    for (int u = pattern.update_start_[at(j)]; u < pattern.update_start_[at(j + 1)]; ++u) {
      const auto [column, count, first] = pattern.update_[at(u)];
      const double* left[kMostColumns];
      for (int i = 0; i < count; ++i) left[i] = L + (pattern.start_[at(column + i)] - i) * kBlock;
      const int* row = pattern.row_.data() + pattern.start_[at(column)];
      const int last = pattern.start_[at(column + 1)] - pattern.start_[at(column)];
      const auto subtract = count == 1   ? subtract_products<1>
                            : count == 2 ? subtract_products<2>
                            : count == 3 ? subtract_products<3>
                                         : subtract_products<kMostColumns>;
      subtract(left, row, first, last, slot_of_row_.data(), L);
    }
    is_definite = factor_column(pattern, j, floor) && is_definite;
  }
  return is_definite;
}

/// The diagonal block becomes the inverse of its Cholesky factor, and those below C its product
/// C inverse^T.
/// @param floor  (3,) what the pivots must be above
/// @return whether they are; pivots that are not are taken for one
bool SmallCholesky::factor_column(const SmallPattern& pattern, int j, const double floor[3]) {
  const std::ptrdiff_t begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
  double* d = factor_.data() + begin * kBlock;
  bool is_definite = true;
  const auto inverse_root = [&](double pivot, double least) {
    const bool is_good = least < pivot;
    is_definite = is_definite && is_good;
    return 1.0 / std::sqrt(is_good ? pivot : 1.0);
  };
  const double r0 = inverse_root(d[0], floor[0]);
  const double l10 = d[1] * r0, l20 = d[2] * r0;
  const double r1 = inverse_root(d[kColumn + 1] - l10 * l10, floor[1]);
  const double l21 = (d[kColumn + 2] - l20 * l10) * r1;
  const double r2 = inverse_root(d[2 * kColumn + 2] - l20 * l20 - l21 * l21, floor[2]);
  const double i10 = -l10 * r0 * r1, i21 = -l21 * r1 * r2, i20 = -(l20 * r0 + l21 * i10) * r2;
  const double inverse[kBlock] = {r0, i10, i20, 0.0, 0.0, r1, i21, 0.0, 0.0, 0.0, r2, 0.0};
  std::memcpy(d, inverse, sizeof(inverse));
  for (double* block = d + kBlock; block < factor_.data() + end * kBlock; block += kBlock) {
    const Column c0 = load_column(block), c1 = load_column(block + kColumn);
    const Column c2 = load_column(block + 2 * kColumn);
    store(block, c0 * r0);
    store(block + kColumn, c0 * i10 + c1 * r1);
    store(block + 2 * kColumn, c0 * i20 + c1 * i21 + c2 * r2);
  }
  return is_definite;
}

void SmallCholesky::solve(const SmallPattern& pattern, const double* b, double* x) {
  const int n = static_cast<int>(pattern.num_nodes());
  const double* L = factor_.data();
  double* y = columns_.resize(at(kColumn * n));
  put(pattern.order_, b, y);
  for (int j = 0; j < n; ++j) {
    const double* d = L + pattern.start_[at(j)] * kBlock;
    double* own = y + kColumn * j;
    store(own, times_vector(d, own));
    const double z[3] = {own[0], own[1], own[2]};
    for (int s = pattern.start_[at(j)] + 1; s < pattern.start_[at(j + 1)]; ++s) {
      double* out = y + kColumn * pattern.row_[at(s)];
      store(out, load_column(out) - times_vector(L + s * kBlock, z));
    }
  }
  for (int j = n - 1; j >= 0; --j) {
    double* own = y + kColumn * j;
    TransposedProduct below;
    for (int s = pattern.start_[at(j)] + 1; s < pattern.start_[at(j + 1)]; ++s)
      below.add(L + s * kBlock, load_column(y + kColumn * pattern.row_[at(s)]));
    for (int k = 0; k < 3; ++k) own[k] -= below.entry(k);
    TransposedProduct inverse;
    inverse.add(L + pattern.start_[at(j)] * kBlock, load_column(own));
    for (int k = 0; k < 3; ++k) own[k] = inverse.entry(k);
  }
  get(pattern.order_, y, x);
}

void SmallCholesky::multiply(const SmallPattern& pattern, const double* x, double* y) {
  const int n = static_cast<int>(pattern.num_nodes());
  double* in = columns_.resize(at(2 * kColumn * n));
  double* out = in + kColumn * n;
  put(pattern.order_, x, in);
  std::fill(out, out + kColumn * n, 0.0);
  for (int j = 0; j < n; ++j) {
    const double* own = in + kColumn * j;
    TransposedProduct right;  // of the blocks below the diagonal
    for (int b = pattern.a_start_[at(j)]; b < pattern.a_start_[at(j + 1)]; ++b) {
      const double* block = matrix_.data() + b * kBlock;
      const int row = pattern.a_row_[at(b)];
      double* to = out + kColumn * row;
      store(to, load_column(to) + times_vector(block, own));
      if (row != j) right.add(block, load_column(in + kColumn * row));
    }
    for (int k = 0; k < 3; ++k) out[kColumn * j + k] += right.entry(k);
  }
  get(pattern.order_, out, y);
}

}  // namespace diffsim
