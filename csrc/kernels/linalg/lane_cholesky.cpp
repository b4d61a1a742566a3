#include "kernels/linalg/lane_cholesky.h"

#include <algorithm>
#include <cstring>
#include <limits>

#include "kernels/subscript.h"

namespace diffsim {
namespace {

constexpr int kWidth = LaneCholesky::kCount;
constexpr int kBlockSize = 9 * kWidth;  // doubles of a block
// Columns that are updated together: each column to their left is read from afar once for all of
// them, and they stay in the nearest cache meanwhile.
constexpr int kPanel = 4;

DIFFSIM_INLINE void load_block(const double* from, Native out[9]) {
#pragma GCC unroll 9
  for (int i = 0; i < 9; ++i) out[i] = load<Native>(from + i * kWidth);
}

/// c -= a b^T.
DIFFSIM_INLINE void subtract_product(const double* a, const Native b[9], double* c) {
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i) {
    Native row[3], sum[3];
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) row[k] = load<Native>(a + (3 * i + k) * kWidth);
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) {
      sum[k] = load<Native>(c + (3 * i + k) * kWidth);
      sum[k] -= row[0] * b[3 * k];
      sum[k] -= row[1] * b[3 * k + 1];
      sum[k] -= row[2] * b[3 * k + 2];
    }
#pragma GCC unroll 3
    for (int k = 0; k < 3; ++k) store(c + (3 * i + k) * kWidth, sum[k]);
  }
}

/// Lower triangular Cholesky factor of a symmetric block, inverted; entries above the diagonal are
/// zero.
/// @param floor  (3,) what the pivots must be above
/// @return where they are; elsewhere pivots are taken for one
DIFFSIM_INLINE NativeMask invert_factor(const Native a[9], const Native floor[3], Native out[9]) {
  const Native one = broadcast<Native>(1.0), zero = broadcast<Native>(0.0);
  const auto good0 = less(floor[0], a[0]);
  const Native r0 = one / sqrt(select(good0, a[0], one));
  const Native l10 = a[3] * r0, l20 = a[6] * r0;
  const Native p1 = a[4] - l10 * l10;
  const auto good1 = less(floor[1], p1);
  const Native r1 = one / sqrt(select(good1, p1, one));
  const Native l21 = (a[7] - l20 * l10) * r1;
  const Native p2 = a[8] - l20 * l20 - l21 * l21;
  const auto good2 = less(floor[2], p2);
  const Native r2 = one / sqrt(select(good2, p2, one));
  out[0] = r0, out[4] = r1, out[8] = r2;
  out[3] = -l10 * r0 * r1;
  out[7] = -l21 * r1 * r2;
  out[6] = -(l20 * r0 + l21 * out[3]) * r2;
  out[1] = out[2] = out[5] = zero;
  return good0 & good1 & good2;
}

}  // namespace

LanePattern::LanePattern(const std::vector<std::int64_t>& row_start,
                         const std::vector<std::int64_t>& column, std::vector<int> order)
    : order_(std::move(order)), position_(order_.size()), place_(column.size()) {
  const int n = static_cast<int>(order_.size());
  for (int k = 0; k < n; ++k) position_[at(order_[at(k)])] = k;
  // Columns of L: those of A and those of the columns whose first row below is this one.
  std::vector<std::vector<int>> rows(at(n)), children(at(n));
  std::vector<int> mark(at(n), -1);
  std::vector<std::pair<int, std::int64_t>> entries;
  start_.assign(1, 0);
  a_start_.assign(1, 0);
  for (int j = 0; j < n; ++j) {
    std::vector<int>& own = rows[at(j)];
    const auto add = [&](int row) {
      if (row < j || mark[at(row)] == j) return;
      mark[at(row)] = j;
      own.push_back(row);
    };
    const int node = order_[at(j)];
    for (std::int64_t k = row_start[at(node)]; k < row_start[at(node + 1)]; ++k)
      add(position_[at(column[at(k)])]);
    for (int child : children[at(j)])
      for (int row : rows[at(child)]) add(row);
    std::sort(own.begin(), own.end());
    if (own.size() > 1) children[at(own[1])].push_back(j);
    row_.insert(row_.end(), own.begin(), own.end());
    start_.push_back(static_cast<int>(row_.size()));
    // A's blocks of this column, in the order of its rows.
    entries.clear();
    for (std::int64_t k = row_start[at(node)]; k < row_start[at(node + 1)]; ++k) {
      const int row = position_[at(column[at(k)])];
      if (row >= j) entries.emplace_back(row, k);
    }
    std::sort(entries.begin(), entries.end());
    for (const auto& [row, k] : entries) {
      const int slot =
          static_cast<int>(std::lower_bound(own.begin(), own.end(), row) - own.begin());
      place_[at(k)] = {static_cast<std::int32_t>(a_row_.size()), row != j};
      a_row_.push_back(row);
      a_column_.push_back(j);
      a_slot_.push_back(start_[at(j)] + slot);
    }
    a_start_.push_back(static_cast<int>(a_row_.size()));
  }
  // The other triangle's entries: the same blocks as they are, row first.
  for (int i = 0; i < n; ++i)
    for (std::int64_t k = row_start[at(i)]; k < row_start[at(i + 1)]; ++k) {
      const std::int64_t other = column[at(k)];
      if (position_[at(other)] >= position_[at(i)]) continue;
      const auto begin = column.begin() + row_start[at(other)];
      const auto end = column.begin() + row_start[at(other + 1)];
      const auto mirror = std::find(begin, end, i) - column.begin();
      place_[at(k)] = {place_[at(mirror)].block, false};
    }
  std::vector<std::vector<Update>> updates(at((n + kPanel - 1) / kPanel));
  for (int k = 0; k < n; ++k)
    for (int s = start_[at(k)] + 1; s < start_[at(k + 1)]; ++s) {
      updates[at(row_[at(s)] / kPanel)].push_back({k, s});
      num_products_ += start_[at(k + 1)] - s;
    }
  update_start_.assign(1, 0);
  for (const auto& list : updates) {
    update_.insert(update_.end(), list.begin(), list.end());
    update_start_.push_back(static_cast<int>(update_.size()));
  }
}

void LaneCholesky::clear(const LanePattern& pattern) {
  const std::size_t size = at(pattern.num_blocks() * kBlockSize);
  std::memset(matrix_.resize(size), 0, size * sizeof(double));
}

void LaneCholesky::clear_lane(const LanePattern& pattern, int lane) {
  double* entry = matrix_.data() + lane;
  for (std::int64_t i = 0; i < 9 * pattern.num_blocks(); ++i) entry[i * kWidth] = 0.0;
}

// A column is filled just before it is factored: it is then in the nearest cache.
void LaneCholesky::fill_column(const LanePattern& pattern, const std::uint8_t* fixed, int j) {
  const std::ptrdiff_t begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
  std::memset(factor_.data() + begin * kBlockSize, 0,
              at((end - begin) * kBlockSize) * sizeof(double));
  for (std::size_t b = at(pattern.a_start_[at(j)]); b < at(pattern.a_start_[at(j + 1)]); ++b) {
    double* block = factor_.data() + at(pattern.a_slot_[b]) * kBlockSize;
    std::memcpy(block, matrix_.data() + b * kBlockSize, kBlockSize * sizeof(double));
    const std::uint8_t* row = fixed + 3 * pattern.order_[at(pattern.a_row_[b])];
    const std::uint8_t* column = fixed + 3 * pattern.order_[at(pattern.a_column_[b])];
    if (!(row[0] | row[1] | row[2] | column[0] | column[1] | column[2])) continue;
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)
        if (row[i] || column[k])
          store(block + (3 * i + k) * kWidth,
                broadcast<Native>(row == column && i == k ? 1.0 : 0.0));
  }
}

unsigned LaneCholesky::factor(const LanePattern& pattern, const std::uint8_t* fixed) {
  const int n = static_cast<int>(pattern.num_nodes());
  factor_.resize(at(pattern.num_factor_blocks() * kBlockSize));
  slot_of_row_.assign(at(kPanel * n), 0);
  NativeMask good = ~NativeMask{};
  for (int first = 0; first < n; first += kPanel) {
    for (int j = first; j < std::min(n, first + kPanel); ++j) fill_column(pattern, fixed, j);
    good &= factor_panel(pattern, first);
  }
  unsigned bits = 0;
  for (int lane = 0; lane < kWidth; ++lane) bits |= (good[lane] ? 1u : 0u) << lane;
  return bits;
}

NativeMask LaneCholesky::factor_panel(const LanePattern& pattern, int first) {
  double* L = factor_.data();
  const int* row = pattern.row_.data();
  const int n = static_cast<int>(pattern.num_nodes()), last = std::min(n, first + kPanel);
  // As in CholeskyFactor: below this of its diagonal entry a pivot is noise.
  const double relative = 4.0 * std::numeric_limits<double>::epsilon() *
                          std::sqrt(9.0 * static_cast<double>(pattern.place_.size()));
  Native floor[kPanel][3];
  for (int j = first; j < last; ++j) {
    const int begin = pattern.start_[at(j)];
    for (int i = 0; i < 3; ++i)
      floor[j - first][i] =
          relative * load<Native>(L + begin * std::ptrdiff_t{kBlockSize} + 4 * i * kWidth);
    int* slots = slot_of_row_.data() + std::ptrdiff_t{j - first} * n;
    for (int s = begin; s < pattern.start_[at(j + 1)]; ++s) slots[row[s]] = s;
  }
  NativeMask good = ~NativeMask{};
  int next = first;  // columns before it are factored
  const auto factor_up_to = [&](int column) {
    for (; next <= column; ++next) good &= factor_column(pattern, next, floor[next - first]);
  };
  const int panel = first / kPanel;
  for (int u = pattern.update_start_[at(panel)]; u < pattern.update_start_[at(panel + 1)]; ++u) {
    const auto [k, slot] = pattern.update_[at(u)];
    factor_up_to(std::min(k, last - 1));  // none of those to the left
    const int* slots = slot_of_row_.data() + std::ptrdiff_t{row[slot] - first} * n;
    Native b[9];
    load_block(L + slot * std::ptrdiff_t{kBlockSize}, b);
    for (int s = slot; s < pattern.start_[at(k + 1)]; ++s)
      subtract_product(L + s * std::ptrdiff_t{kBlockSize}, b,
                       L + slots[row[s]] * std::ptrdiff_t{kBlockSize});
  }
  factor_up_to(last - 1);
  return good;
}

NativeMask LaneCholesky::factor_column(const LanePattern& pattern, int j, const Native floor[3]) {
  double* L = factor_.data();
  const int begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
  Native a[9], inverse[9];
  double* diagonal = L + begin * std::ptrdiff_t{kBlockSize};
  load_block(diagonal, a);
  const NativeMask good = invert_factor(a, floor, inverse);
  for (int i = 0; i < 9; ++i) store(diagonal + i * kWidth, inverse[i]);
  for (int s = begin + 1; s < end; ++s) {  // L = C inverse^T, the inverse being lower triangular
    double* block = L + s * std::ptrdiff_t{kBlockSize};
    for (int i = 0; i < 3; ++i) {
      Native c[3];
      for (int k = 0; k < 3; ++k) c[k] = load<Native>(block + (3 * i + k) * kWidth);
      store(block + 3 * i * kWidth, c[0] * inverse[0]);
      store(block + (3 * i + 1) * kWidth, c[0] * inverse[3] + c[1] * inverse[4]);
      store(block + (3 * i + 2) * kWidth,
            c[0] * inverse[6] + c[1] * inverse[7] + c[2] * inverse[8]);
    }
  }
  return good;
}

void LaneCholesky::put(const LanePattern& pattern, const double* from, int lane, Columns& to) {
  double* out = to.resize(at(3 * pattern.num_nodes() * kWidth)) + lane;
  for (int node : pattern.order_)
    for (int i = 0; i < 3; ++i, out += kWidth) *out = from[3 * node + i];
}

void LaneCholesky::get(const LanePattern& pattern, const Columns& from, int lane, double* to) {
  const double* in = from.data() + lane;
  for (int node : pattern.order_)
    for (int i = 0; i < 3; ++i, in += kWidth) to[3 * node + i] = *in;
}

void LaneCholesky::solve(const LanePattern& pattern, Columns& columns) const {
  const int n = static_cast<int>(pattern.num_nodes());
  const double* L = factor_.data();
  double* x = columns.data();
  const auto part = [&](int row) { return x + 3 * kWidth * std::ptrdiff_t{row}; };
  for (int j = 0; j < n; ++j) {
    const int begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
    Native d[9], b[3], y[3];
    load_block(L + begin * std::ptrdiff_t{kBlockSize}, d);
    for (int i = 0; i < 3; ++i) b[i] = load<Native>(part(j) + i * kWidth);
    y[0] = d[0] * b[0], y[1] = d[3] * b[0] + d[4] * b[1];
    y[2] = d[6] * b[0] + d[7] * b[1] + d[8] * b[2];
    for (int i = 0; i < 3; ++i) store(part(j) + i * kWidth, y[i]);
    for (int s = begin + 1; s < end; ++s) {
      const double* block = L + s * std::ptrdiff_t{kBlockSize};
      double* out = part(pattern.row_[at(s)]);
      for (int i = 0; i < 3; ++i) {
        Native sum = load<Native>(out + i * kWidth);
        for (int k = 0; k < 3; ++k) sum -= load<Native>(block + (3 * i + k) * kWidth) * y[k];
        store(out + i * kWidth, sum);
      }
    }
  }
  for (int j = n - 1; j >= 0; --j) {
    const int begin = pattern.start_[at(j)], end = pattern.start_[at(j + 1)];
    Native d[9], y[3];
    for (int i = 0; i < 3; ++i) y[i] = load<Native>(part(j) + i * kWidth);
    for (int s = begin + 1; s < end; ++s) {
      const double* block = L + s * std::ptrdiff_t{kBlockSize};
      const double* in = part(pattern.row_[at(s)]);
      for (int i = 0; i < 3; ++i) {
        const Native v = load<Native>(in + i * kWidth);
        for (int k = 0; k < 3; ++k) y[k] -= load<Native>(block + (3 * i + k) * kWidth) * v;
      }
    }
    load_block(L + begin * std::ptrdiff_t{kBlockSize}, d);
    store(part(j), d[0] * y[0] + d[3] * y[1] + d[6] * y[2]);
    store(part(j) + kWidth, d[4] * y[1] + d[7] * y[2]);
    store(part(j) + 2 * kWidth, d[8] * y[2]);
  }
}

void LaneCholesky::multiply(const LanePattern& pattern, const Columns& columns,
                            Columns& product) const {
  const std::size_t size = at(3 * pattern.num_nodes() * kWidth);
  const double* x = columns.data();
  double* y = product.resize(size);
  std::memset(y, 0, size * sizeof(double));
  for (std::size_t b = 0; b < pattern.a_row_.size(); ++b) {
    const int row = pattern.a_row_[b], column = pattern.a_column_[b];
    const std::ptrdiff_t to = std::ptrdiff_t{3} * row * kWidth;
    const std::ptrdiff_t from = std::ptrdiff_t{3} * column * kWidth;
    Native a[9], v[3], w[3];
    load_block(matrix_.data() + b * kBlockSize, a);
    for (int i = 0; i < 3; ++i) {
      v[i] = load<Native>(x + from + i * kWidth);
      w[i] = load<Native>(x + to + i * kWidth);
    }
    for (int i = 0; i < 3; ++i)
      store(y + to + i * kWidth, load<Native>(y + to + i * kWidth) + a[3 * i] * v[0] +
                                     a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2]);
    if (row == column) continue;
    for (int k = 0; k < 3; ++k)
      store(y + from + k * kWidth,
            load<Native>(y + from + k * kWidth) + a[k] * w[0] + a[3 + k] * w[1] + a[6 + k] * w[2]);
  }
}

}  // namespace diffsim
