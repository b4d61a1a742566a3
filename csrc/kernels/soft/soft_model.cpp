#include "kernels/soft/soft_model.h"

#include <algorithm>
#include <array>
#include <map>

#include "kernels/soft/material.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

template <int kNodes>
GroupShape<kNodes> lanes_of(const double* grad[kLanes], const double weight[kLanes]) {
  GroupShape<kNodes> shape;
  for (int lane = 0; lane < kLanes; ++lane) {
    for (int a = 0; a < kNodes; ++a)
      for (int i = 0; i < 3; ++i) shape.grad[a][i][lane] = grad[lane][3 * a + i];
    shape.weight[lane] = weight[lane];
  }
  return shape;
}

NodeShape by_node(const GroupShape<8>& shape) {
  NodeShape nodes;
  for (int q = 0; q < kLanes; ++q)
    for (int j = 0; j < 3; ++j)
      for (int a = 0; a < 8; ++a) {
        nodes.grad[3 * q + j][a] = shape.grad[a][j][q];
        nodes.weighted[3 * q + j][a] = shape.grad[a][j][q] * shape.weight[q];
      }
  return nodes;
}

HourglassShape hourglass_lanes(const double* table[kLanes], int count) {
  HourglassShape shape;
  for (int lane = 0; lane < kLanes; ++lane) {
    const double *gamma = table[lane], *row = gamma + 8 * kHourglassModes;
    for (int m = 0; m < kHourglassModes; ++m)
      for (int a = 0; a < 8; ++a) shape.gamma[m][a][lane] = gamma[8 * m + a];
    for (int r = 0; r < kHourglassRows; ++r)
      for (int i = 0; i < 3; ++i) shape.row[r][i][lane] = lane < count ? row[3 * r + i] : 0.0;
  }
  return shape;
}

/// Shapes of the groups of kMeanHex: groups of the same classes share one.
void list_mean_shapes(ElementBlock& block, const MeshTables& t, const std::vector<Index>& classes) {
  std::map<std::array<Index, kLanes + 1>, Index> known;
  for (Index g = 0; g < block.num_groups; ++g) {
    const int count = static_cast<int>(std::min<Index>(kLanes, block.num_elements - g * kLanes));
    std::array<Index, kLanes + 1> key;
    const double *grad[kLanes], *table[kLanes];
    double weight[kLanes];
    key.back() = count;
    for (int lane = 0; lane < kLanes; ++lane) {
      const Index c = key[at(lane)] = classes[at(MeanHexGroup::element(block, g, lane))];
      grad[lane] = t.grad + c * 24;
      weight[lane] = lane < count ? t.weight[c] : 0.0;
      table[lane] = t.hourglass + c * kHourglassTable;
    }
    const auto [place, is_new] = known.try_emplace(key, static_cast<Index>(known.size()));
    block.mean_class.push_back(place->second);
    if (!is_new) continue;
    block.mean_shape.push_back(lanes_of<8>(grad, weight));
    block.hourglass.push_back(hourglass_lanes(table, count));
  }
}

/// The block of the elements listed in `subset` (all, where null).
ElementBlock make_block(const MeshTables& t, const Index* subset, Index count) {
  ElementBlock block;
  block.kind = t.kind;
  block.num_elements = count;
  const int n = block.nodes_per_element();
  std::vector<Index> classes(at(count));
  for (Index e = 0; e < count; ++e) {
    const Index element = subset ? subset[e] : e;
    block.nodes.insert(block.nodes.end(), t.elements + element * n, t.elements + (element + 1) * n);
    classes[at(e)] = t.class_idx[element];
  }
  if (t.kind == ElementKind::kHex) {
    block.num_groups = count;
    block.hex_class = std::move(classes);
    for (Index c = 0; c < t.num_classes; ++c) {
      const double* grad[kLanes];
      for (int q = 0; q < kLanes; ++q) grad[q] = t.grad + (c * kLanes + q) * 24;
      block.hex_shape.push_back(lanes_of<8>(grad, t.weight + c * kLanes));
      block.hex_nodes.push_back(by_node(block.hex_shape.back()));
    }
    return block;
  }
  block.num_groups = (count + kLanes - 1) / kLanes;
  if (t.kind == ElementKind::kMeanHex) {
    list_mean_shapes(block, t, classes);
    return block;
  }
  for (Index g = 0; g < block.num_groups; ++g) {
    const double* grad[kLanes];
    double weight[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Index c = classes[at(TetGroup::element(block, g, lane))];
      grad[lane] = t.grad + c * 3 * n;
      weight[lane] = g * kLanes + lane < count ? t.weight[c] : 0.0;
    }
    if (t.kind == ElementKind::kTet)
      block.tet_shape.push_back(lanes_of<4>(grad, weight));
    else
      block.eighth_shape.push_back(lanes_of<10>(grad, weight));
  }
  return block;
}

void list_fibers(SoftModel& model, const MeshTables& t) {
  model.fibers_start.assign(at(t.num_elements + 1), 0);
  for (Index k = 0; k < t.num_fibers; ++k) ++model.fibers_start[at(t.fiber_elements[k] + 1)];
  for (Index e = 0; e < t.num_elements; ++e)
    model.fibers_start[at(e + 1)] += model.fibers_start[at(e)];
  model.fibers_of.resize(at(t.num_fibers));
  std::vector<Index> fill(model.fibers_start.begin(), model.fibers_start.end() - 1);
  for (Index k = 0; k < t.num_fibers; ++k) model.fibers_of[at(fill[at(t.fiber_elements[k])]++)] = k;
}

/// CSR graph of nodes that share an element or the rim of a chamber.
void make_graph(SoftModel& model, const ChamberTables& chambers) {
  const int n = model.solid.nodes_per_element();
  std::vector<Index> start(at(model.num_nodes + 1), 0), elements_of;
  const std::vector<Index>& nodes = model.solid.nodes;
  for (Index node : nodes) ++start[at(node + 1)];
  for (Index i = 0; i < model.num_nodes; ++i) start[at(i + 1)] += start[at(i)];
  elements_of.resize(nodes.size());
  std::vector<Index> fill(start.begin(), start.end() - 1);
  for (std::size_t k = 0; k < nodes.size(); ++k)
    elements_of[at(fill[at(nodes[k])]++)] = static_cast<Index>(k) / n;

  std::vector<std::vector<Index>> lids_of(at(model.num_nodes));
  for (Index lid = 0; lid < chambers.num_lids; ++lid)
    for (Index k = chambers.lid_start[lid]; k < chambers.lid_start[lid + 1]; ++k)
      lids_of[at(chambers.lid_nodes[k])].push_back(lid);

  model.row_start.assign(1, 0);
  std::vector<Index> row;
  for (Index i = 0; i < model.num_nodes; ++i) {
    row.assign(1, i);
    for (Index k = start[at(i)]; k < start[at(i + 1)]; ++k) {
      const Index* node = nodes.data() + elements_of[at(k)] * n;
      row.insert(row.end(), node, node + n);
    }
    for (Index lid : lids_of[at(i)])
      row.insert(row.end(), chambers.lid_nodes + chambers.lid_start[lid],
                 chambers.lid_nodes + chambers.lid_start[lid + 1]);
    std::sort(row.begin(), row.end());
    row.erase(std::unique(row.begin(), row.end()), row.end());
    const auto diagonal = std::lower_bound(row.begin(), row.end(), i) - row.begin();
    model.diagonal.push_back(model.row_start.back() + diagonal);
    model.column.insert(model.column.end(), row.begin(), row.end());
    model.row_start.push_back(static_cast<Index>(model.column.size()));
  }
}

std::vector<std::int32_t> make_slots(const SoftModel& model, const ElementBlock& block) {
  const int n = block.nodes_per_element();
  std::vector<std::int32_t> slots(at(block.num_elements * n * n));
  for (Index e = 0; e < block.num_elements; ++e)
    for (int a = 0; a < n; ++a) {
      const Index row = block.nodes[at(e * n + a)];
      const auto first = model.column.begin() + model.row_start[at(row)];
      const auto last = model.column.begin() + model.row_start[at(row + 1)];
      for (int b = 0; b < n; ++b)
        slots[at((e * n + a) * n + b)] = static_cast<std::int32_t>(
            std::lower_bound(first, last, block.nodes[at(e * n + b)]) - first);
    }
  return slots;
}

/// Lists, per node and in element order, where its contributions lie in the vectors buffer.
void make_gather(SoftModel& model) {
  model.gather_stride = vector_stride(model.solid);
  model.fiber_vectors_start = model.solid.num_groups * model.solid.vectors_size();
  model.vectors_size =
      model.fiber_vectors_start + model.fiber.num_groups * model.fiber.vectors_size();
  model.gather_start.assign(at(model.num_nodes + 1), 0);
  for (const ElementBlock* block : {&model.solid, &model.fiber})
    for (Index node : block->nodes) ++model.gather_start[at(node + 1)];
  for (Index i = 0; i < model.num_nodes; ++i)
    model.gather_start[at(i + 1)] += model.gather_start[at(i)];
  model.gather_offset.resize(at(model.gather_start.back()));
  std::vector<Index> fill(model.gather_start.begin(), model.gather_start.end() - 1);
  for (const ElementBlock* block : {&model.solid, &model.fiber}) {
    const Index first = block == &model.solid ? 0 : model.fiber_vectors_start;
    const int n = block->nodes_per_element();
    for (Index e = 0; e < block->num_elements; ++e)
      for (int a = 0; a < n; ++a)
        model.gather_offset[at(fill[at(block->nodes[at(e * n + a)])]++)] =
            first + vector_offset(*block, e, a);
  }
}

}  // namespace

SoftModel make_soft_model(const MeshTables& t) {
  SoftModel model;
  model.num_nodes = t.num_nodes;
  model.material = t.material;
  model.num_weights = with_material(t.material, [](auto law) { return decltype(law)::kWeights; });
  if (t.kind == ElementKind::kMeanHex) model.num_weights += kHourglassWeights;
  model.solid = make_block(t, nullptr, t.num_elements);
  model.fiber = make_block(t, t.fiber_elements, t.num_fibers);
  model.fiber_elements.assign(t.fiber_elements, t.fiber_elements + t.num_fibers);
  model.fiber_directions.assign(t.fiber_directions, t.fiber_directions + 3 * t.num_fibers);
  model.fiber_pull_only.assign(t.fiber_pull_only, t.fiber_pull_only + t.num_fibers);
  list_fibers(model, t);
  make_graph(model, t.chambers);
  model.solid_slot = make_slots(model, model.solid);
  model.fiber_slot = make_slots(model, model.fiber);
  make_gather(model);
  model.chambers = make_chambers(t.chambers, model);
  return model;
}

}  // namespace diffsim
