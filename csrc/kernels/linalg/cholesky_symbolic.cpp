#include "kernels/linalg/cholesky_symbolic.h"

#include <limits>
#include <stdexcept>
#include <string>

#include "kernels/linalg/cholesky.h"
#include "kernels/linalg/cholesky_schedule.h"
#include "kernels/linalg/nested_dissection.h"
#include "kernels/linalg/supernodes.h"

namespace diffsim {
namespace {

[[noreturn]] void refuse(const std::string& what) {
  throw std::invalid_argument("analyze_cholesky: " + what);
}

/// Off-diagonal graph of the pattern, checked: in range, diagonal present, structurally symmetric.
Graph checked_graph(std::int64_t num_nodes, const std::int64_t* indptr,
                    const std::int64_t* indices) {
  Graph g;
  g.num_nodes = static_cast<int>(num_nodes);
  g.begin.assign(num_nodes + 1, 0);
  g.neighbors.reserve(indptr[num_nodes]);
  for (std::int64_t i = 0; i < num_nodes; ++i) {
    bool diagonal = false;
    for (std::int64_t k = indptr[i]; k < indptr[i + 1]; ++k) {
      if (indices[k] < 0 || indices[k] >= num_nodes) {
        refuse("row " + std::to_string(i) + " has column " + std::to_string(indices[k]) +
               " outside [0, " + std::to_string(num_nodes) + ")");
      }
      if (indices[k] == i) {
        if (diagonal) refuse("row " + std::to_string(i) + " stores its diagonal twice");
        diagonal = true;
      } else {
        g.neighbors.push_back(static_cast<int>(indices[k]));
      }
    }
    if (!diagonal) refuse("row " + std::to_string(i) + " stores no diagonal entry");
    g.begin[i + 1] = static_cast<std::int64_t>(g.neighbors.size());
  }
  // Structural symmetry: what row i names and what names row i agree in number and in hash.
  std::vector<int> mark(num_nodes, -1);
  std::vector<std::int64_t> incoming(num_nodes, 0), hash(num_nodes, 0);
  for (int i = 0; i < g.num_nodes; ++i) {
    for (const int* u = g.first(i); u != g.last(i); ++u) {
      if (mark[*u] == i) {
        refuse("row " + std::to_string(i) + " stores column " + std::to_string(*u) + " twice");
      }
      mark[*u] = i;
      const auto mix = [](std::uint64_t x) { return (x + 1) * 0x9E3779B97F4A7C15u; };
      incoming[*u] += 1;
      hash[*u] += static_cast<std::int64_t>(mix(i) >> 8);
      incoming[i] -= 1;
      hash[i] -= static_cast<std::int64_t>(mix(*u) >> 8);
    }
  }
  for (std::int64_t i = 0; i < num_nodes; ++i) {
    if (incoming[i] || hash[i]) {
      refuse("the pattern is not symmetric: row " + std::to_string(i) + " and column " +
             std::to_string(i) + " differ");
    }
  }
  return g;
}

/// Which unknowns of every node take part, one bit per component.
struct Present {
  std::vector<std::uint8_t> mask;
  std::vector<int> nodes;  // those with any

  Present(std::int64_t num_nodes, int block, const std::uint8_t* absent)
      : mask(num_nodes, static_cast<std::uint8_t>((1 << block) - 1)) {
    for (int v = 0; v < num_nodes; ++v) {
      for (int a = 0; absent && a < block; ++a) {
        if (absent[std::int64_t{v} * block + a]) mask[v] &= static_cast<std::uint8_t>(~(1 << a));
      }
      if (mask[v]) nodes.push_back(v);
    }
  }
  int count(int v) const { return __builtin_popcount(mask[v]); }
};

/// Supernodes of the nodes present, in the caller's numbering.
Supernodes order_nodes(const Graph& graph, const Present& present, const double* coords,
                       bool lattice) {
  std::vector<int> number(graph.num_nodes, -1), weight;
  std::vector<double> at;
  Graph part;
  for (int v : present.nodes) {
    number[v] = part.num_nodes++;
    weight.push_back(present.count(v));
    if (coords) at.insert(at.end(), coords + 3 * v, coords + 3 * (v + 1));
  }
  const bool whole = part.num_nodes == graph.num_nodes;
  if (!whole) {
    part.begin.push_back(0);
    for (int v : present.nodes) {
      for (const int* u = graph.first(v); u != graph.last(v); ++u) {
        if (number[*u] >= 0) part.neighbors.push_back(number[*u]);
      }
      part.begin.push_back(static_cast<std::int64_t>(part.neighbors.size()));
    }
  }
  const Graph& ordered = whole ? graph : part;
  Supernodes nodes = find_supernodes(
      ordered, nested_dissection(ordered, coords ? at.data() : nullptr, lattice), weight);
  for (int& v : nodes.order) v = present.nodes[v];
  return nodes;
}

/// Sizes and storage of every supernode, in unknowns.
void lay_out(const Supernodes& nodes, const Present& present, CholeskySymbolic& sym) {
  const int count = nodes.count();
  sym.supernodes.resize(count);
  std::vector<std::int64_t> num_children(count + 1, 0);
  std::int64_t own = 0, rows = 0;
  int first = 0;
  for (int s = 0; s < count; ++s) {
    CholeskySupernode& node = sym.supernodes[s];
    node.first = first;
    for (int k = nodes.begin[s]; k < nodes.begin[s + 1]; ++k) {
      node.num_cols += present.count(nodes.order[k]);
    }
    for (std::int64_t i = nodes.rows_begin[s]; i < nodes.rows_begin[s + 1]; ++i) {
      node.num_rows += present.count(nodes.order[nodes.rows[i]]);
    }
    first += node.num_cols;
    node.rows = rows;
    rows += node.num_rows;
    node.parent = nodes.parent[s];
    node.factor = sym.factor_size;
    node.own = own;
    own += std::int64_t{node.panels()} * kTile;
    sym.factor_size += node.factor_size();
    const double c = node.num_cols, r = node.num_rows;
    sym.nnz += static_cast<std::int64_t>(c * (c + 1) / 2 + c * r);
    sym.flops += c * c * c / 3 + c * c * r + c * r * r;
    if (node.parent >= 0) ++num_children[node.parent];
  }
  sym.workspace_size = own;
  std::int64_t next = 0;
  for (int s = 0; s < count; ++s) {
    sym.supernodes[s].children = sym.supernodes[s].children_end = next;
    next += num_children[s];
  }
  sym.children.resize(next);
  for (int s = 0; s < count; ++s) {
    const int parent = sym.supernodes[s].parent;
    if (parent >= 0) sym.children[sym.supernodes[parent].children_end++] = s;
  }
}

/// Index maps: rows in the caller's numbering and in the parent's, and input entries to L.
void map_indices(const Supernodes& nodes, const Present& present, const std::int64_t* indptr,
                 const std::int64_t* indices, CholeskySymbolic& sym) {
  const int block = sym.block;
  std::vector<int> position(sym.num_nodes, -1), local(sym.num_nodes, 0);
  const auto add_unknowns = [&](int v, std::vector<int>& list) {
    for (int a = 0; a < block; ++a) {
      if (present.mask[v] >> a & 1) list.push_back(v * block + a);
    }
  };
  for (std::size_t k = 0; k < nodes.order.size(); ++k) {
    position[nodes.order[k]] = static_cast<int>(k);
    add_unknowns(nodes.order[k], sym.unknown);
  }
  for (int v = 0; v < sym.num_nodes; ++v) {
    for (int a = 0; a < block; ++a) {
      if (!(present.mask[v] >> a & 1)) sym.absent.push_back(v * block + a);
    }
  }
  const CholeskySupernode& last =
      sym.supernodes.empty() ? CholeskySupernode() : sym.supernodes.back();
  sym.row_unknown.reserve(last.rows + last.num_rows);
  sym.row_in_parent.resize(last.rows + last.num_rows);
  for (int s = 0; s < nodes.count(); ++s) {
    CholeskySupernode& node = sym.supernodes[s];
    // Local index of every node that this supernode knows.
    int next = 0;
    for (int k = nodes.begin[s]; k < nodes.begin[s + 1]; ++k) {
      local[k] = next;
      next += present.count(nodes.order[k]);
    }
    next = node.panels() * kTile;
    for (std::int64_t i = nodes.rows_begin[s]; i < nodes.rows_begin[s + 1]; ++i) {
      const int v = nodes.order[nodes.rows[i]];
      local[nodes.rows[i]] = next;
      next += present.count(v);
      add_unknowns(v, sym.row_unknown);
    }
    for (std::int64_t c = node.children; c < node.children_end; ++c) {
      const int child = sym.children[c];
      int* in_parent = sym.row_in_parent.data() + sym.supernodes[child].rows;
      for (std::int64_t i = nodes.rows_begin[child]; i < nodes.rows_begin[child + 1]; ++i) {
        const int count = present.count(nodes.order[nodes.rows[i]]);
        for (int a = 0; a < count; ++a) *in_parent++ = local[nodes.rows[i]] + a;
      }
    }
    node.entries = static_cast<std::int64_t>(sym.entries.size());
    for (int k = nodes.begin[s]; k < nodes.begin[s + 1]; ++k) {
      const int v = nodes.order[k];
      for (std::int64_t e = indptr[v]; e < indptr[v + 1]; ++e) {
        const int other = position[indices[e]];
        if (other < k) continue;  // above the diagonal, or absent
        sym.entries.push_back(
            {e, local[other], local[k], present.mask[indices[e]], present.mask[v]});
      }
    }
    node.entries_end = static_cast<std::int64_t>(sym.entries.size());
  }
  for (int row : sym.row_in_parent) {
    sym.row_offset_in_parent.push_back(row / kTile * kTile * kTile + row % kTile);
  }
}

}  // namespace

std::shared_ptr<const CholeskySymbolic> analyze_cholesky(std::int64_t num_nodes,
                                                         const std::int64_t* indptr,
                                                         const std::int64_t* indices,
                                                         const double* coords, int block,
                                                         const std::uint8_t* absent, bool lattice) {
  if (block < 1 || block > 6) refuse("block must be 1 to 6, got " + std::to_string(block));
  if (num_nodes < 0 || num_nodes > std::numeric_limits<int>::max() / block) {
    refuse("num_nodes must fit 32-bit indices, got " + std::to_string(num_nodes));
  }
  auto sym = std::make_shared<CholeskySymbolic>();
  sym->num_nodes = num_nodes;
  sym->num_unknowns = num_nodes * block;
  sym->num_blocks = indptr[num_nodes];
  sym->block = block;
  const Graph graph = checked_graph(num_nodes, indptr, indices);
  const Present present(num_nodes, block, absent);
  const Supernodes nodes = order_nodes(graph, present, coords, lattice);
  lay_out(nodes, present, *sym);
  map_indices(nodes, present, indptr, indices, *sym);
  schedule_cholesky(*sym);
  return sym;
}

}  // namespace diffsim
