#include "kernels/soft/chambers.h"

#include <algorithm>

#include "kernels/soft/soft_model.h"
#include "kernels/subscript.h"

namespace diffsim {
namespace {

using Index = std::int64_t;

/// Faces of every chamber, each followed by its lids.
void add_triangles(const ChamberTables& t, Index num_nodes, Chambers& out) {
  out.start.assign(1, 0);
  for (Index c = 0; c < t.num_chambers; ++c) {
    out.triangles.insert(out.triangles.end(), t.faces + 3 * t.start[c],
                         t.faces + 3 * t.start[c + 1]);
    for (Index lid = 0; lid < t.num_lids; ++lid) {
      if (t.lid_chamber[lid] != c) continue;
      const Index first = t.lid_start[lid], size = t.lid_start[lid + 1] - first;
      for (Index k = 0; k < size; ++k)
        out.triangles.insert(
            out.triangles.end(),
            {t.lid_nodes[first + k], t.lid_nodes[first + (k + 1) % size], num_nodes + lid});
    }
    out.start.push_back(static_cast<Index>(out.triangles.size()) / 3);
  }
}

std::int32_t slot_of(const SoftModel& model, Index row, Index col) {
  if (col >= model.num_nodes) return -1;
  const auto first = model.column.begin() + model.row_start[at(row)];
  const auto last = model.column.begin() + model.row_start[at(row + 1)];
  return static_cast<std::int32_t>(std::lower_bound(first, last, col) - first);
}

}  // namespace

Chambers make_chambers(const ChamberTables& t, const SoftModel& model) {
  Chambers out;
  out.num_chambers = t.num_chambers;
  out.num_lids = t.num_lids;
  if (t.num_chambers == 0) return out;
  add_triangles(t, model.num_nodes, out);
  out.lid_chamber.assign(t.lid_chamber, t.lid_chamber + t.num_lids);
  out.lid_start.assign(t.lid_start, t.lid_start + t.num_lids + 1);
  out.lid_nodes.assign(t.lid_nodes, t.lid_nodes + out.lid_start.back());

  std::vector<std::vector<Chambers::Corner>> corners(at(model.num_nodes));
  for (Index c = 0; c < t.num_chambers; ++c)
    for (Index k = out.start[at(c)]; k < out.start[at(c + 1)]; ++k)
      for (int a = 0; a < 3; ++a) {
        const Index* triangle = out.triangles.data() + 3 * k;
        const Index node = triangle[a], next = triangle[(a + 1) % 3], prev = triangle[(a + 2) % 3];
        if (node >= model.num_nodes) continue;
        corners[at(node)].push_back(
            {c, next, prev, slot_of(model, node, next), slot_of(model, node, prev)});
      }
  std::vector<std::vector<Chambers::RimCorner>> rims(at(model.num_nodes));
  for (Index lid = 0; lid < t.num_lids; ++lid)
    for (Index k = out.lid_start[at(lid)]; k < out.lid_start[at(lid + 1)]; ++k) {
      const Index node = out.lid_nodes[at(k)];
      Chambers::RimCorner rim{lid, k - out.lid_start[at(lid)], {}};
      for (Index j = out.lid_start[at(lid)]; j < out.lid_start[at(lid + 1)]; ++j)
        rim.slots.push_back(slot_of(model, node, out.lid_nodes[at(j)]));
      rims[at(node)].push_back(std::move(rim));
    }

  out.corner_start.assign(1, 0);
  out.rim_start.assign(1, 0);
  for (Index i = 0; i < model.num_nodes; ++i) {
    if (corners[at(i)].empty()) continue;
    out.nodes.push_back(i);
    for (const auto& corner : corners[at(i)]) out.corners.push_back(corner);
    for (auto& rim : rims[at(i)]) out.rims.push_back(std::move(rim));
    out.corner_start.push_back(static_cast<Index>(out.corners.size()));
    out.rim_start.push_back(static_cast<Index>(out.rims.size()));
  }
  return out;
}

}  // namespace diffsim
