#include "kernels/linalg/rigid_hierarchy.h"

#include <algorithm>

#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

// A level of this many nodes is factorized: 1,200 unknowns cost about 2 ms.
constexpr Index kCoarsestNodes = 200;
// A level that shrinks by less than this is not worth its cycle.
constexpr double kLeastCoarsening = 0.6;

/// Pattern of the product of two; `f(row, entry)` names the rows of `b` that a row gathers.
template <typename ForRows>
Pattern gathered(Index num_rows, const Pattern& b, Index num_columns, ForRows&& for_rows) {
  Pattern out;
  out.row_start.assign(1, 0);
  std::vector<Index> seen(at(num_columns), -1);
  std::vector<std::int32_t> row;
  for (Index i = 0; i < num_rows; ++i) {
    row.clear();
    for_rows(i, [&](Index j) {
      for (Index k = b.begin(j); k < b.end(j); ++k) {
        const std::int32_t c = b[k];
        if (seen[at(c)] == i) continue;
        seen[at(c)] = i;
        row.push_back(c);
      }
    });
    std::sort(row.begin(), row.end());
    out.column.insert(out.column.end(), row.begin(), row.end());
    out.row_start.push_back(static_cast<Index>(out.column.size()));
  }
  return out;
}

Pattern product(const Pattern& a, const Pattern& b, Index num_columns) {
  return gathered(a.num_rows(), b, num_columns, [&](Index i, auto&& take) {
    for (Index k = a.begin(i); k < a.end(i); ++k) take(a[k]);
  });
}

Pattern identity_of(const Aggregates& aggregates) {
  Pattern p;
  p.column = aggregates.of_node;
  for (std::size_t i = 0; i <= p.column.size(); ++i) p.row_start.push_back(static_cast<Index>(i));
  return p;
}

void transpose(const Pattern& p, Index num_columns, Pattern& out, std::vector<Index>& entry) {
  out.row_start.assign(at(num_columns + 1), 0);
  for (std::int32_t c : p.column) ++out.row_start[at(c) + 1];
  for (Index c = 0; c < num_columns; ++c) out.row_start[at(c + 1)] += out.row_start[at(c)];
  out.column.resize(p.column.size());
  entry.resize(p.column.size());
  std::vector<Index> fill(out.row_start.begin(), out.row_start.end() - 1);
  for (Index i = 0; i < p.num_rows(); ++i)
    for (Index k = p.begin(i); k < p.end(i); ++k) {
      const Index place = fill[at(p[k])]++;
      out.column[at(place)] = static_cast<std::int32_t>(i);
      entry[at(place)] = k;
    }
}

std::vector<Index> diagonal_of(const Pattern& p) {
  std::vector<Index> found;
  for (Index i = 0; i < p.num_rows(); ++i)
    found.push_back(std::lower_bound(p.column.begin() + p.begin(i), p.column.begin() + p.end(i),
                                     static_cast<std::int32_t>(i)) -
                    p.column.begin());
  return found;
}

RigidTransfer make_transfer(const Pattern& matrix, Aggregates aggregates) {
  RigidTransfer t;
  const Index coarse = aggregates.count;
  t.prolongation = product(matrix, identity_of(aggregates), coarse);
  t.product = product(matrix, t.prolongation, coarse);
  transpose(t.prolongation, coarse, t.restriction, t.restriction_entry);
  t.aggregates = std::move(aggregates);
  return t;
}

}  // namespace

RigidHierarchy::RigidHierarchy(Pattern fine) {
  matrices_.push_back(std::move(fine));
  while (matrices_.size() == 1 || matrices_.back().num_rows() > kCoarsestNodes) {
    Aggregates aggregates = aggregate_nodes(matrices_.back());
    const double left =
        static_cast<double>(aggregates.count) / static_cast<double>(matrices_.back().num_rows());
    if (matrices_.size() > 1 && left > kLeastCoarsening) break;
    transfers_.push_back(make_transfer(matrices_.back(), std::move(aggregates)));
    const RigidTransfer& t = transfers_.back();
    matrices_.push_back(product(t.restriction, t.product, t.aggregates.count));
  }
  for (const Pattern& p : matrices_) diagonals_.push_back(diagonal_of(p));
  const Pattern& last = matrices_.back();
  const std::vector<Index> column(last.column.begin(), last.column.end());
  coarsest_ = analyze_cholesky(last.num_rows(), last.row_start.data(), column.data(), nullptr, 6);
}

}  // namespace diffsim
