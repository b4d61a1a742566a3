// Pneumatic chambers of a soft body: closed surfaces of its nodes, ready for threads.
//
// Triangles are oriented as the solid's boundary is: normals point out of the solid, into the
// cavity. A surface with rims (a pocket that is open) is closed by one *lid* per rim: a cone from
// the rim's nodes to their mean, so that the volume, and with it the energy -p V, is defined and
// moves with the body. The fluid's force on a lid is carried by the rim.
#pragma once

#include <cstdint>
#include <vector>

namespace diffsim {

struct SoftModel;

/// Chambers as Python computes them (diffsim/soft/chambers.py).
struct ChamberTables {
  std::int64_t num_chambers = 0, num_lids = 0;
  const std::int64_t* start = nullptr;        // (num_chambers + 1,) first face of each chamber
  const std::int64_t* faces = nullptr;        // (num_faces, 3)
  const std::int64_t* lid_chamber = nullptr;  // (num_lids,)
  const std::int64_t* lid_start = nullptr;    // (num_lids + 1,) first rim node of each lid
  const std::int64_t* lid_nodes = nullptr;    // in the order that lid triangles run through them
};

/// Immutable. *Points* are nodes, then the lids' centers.
struct Chambers {
  /// A node's place in one triangle (node, next, previous).
  struct Corner {
    std::int64_t chamber, next, previous;   // the latter two are points
    std::int32_t slot_next, slot_previous;  // in the node's matrix row; -1 at a lid's center
  };
  /// A node's place on a rim.
  struct RimCorner {
    std::int64_t lid, place;
    std::vector<std::int32_t> slots;  // of all nodes of the rim, in the node's matrix row
  };

  std::int64_t num_chambers = 0, num_lids = 0;
  std::vector<std::int64_t> start, triangles;  // lids included, (num_triangles, 3) points
  std::vector<std::int64_t> lid_chamber, lid_start, lid_nodes;

  std::vector<std::int64_t> nodes;  // on any chamber, ascending; each has corners and rims
  std::vector<std::int64_t> corner_start, rim_start;
  std::vector<Corner> corners;
  std::vector<RimCorner> rims;
};

/// The model's graph must join the nodes of each triangle, and all nodes of each rim.
Chambers make_chambers(const ChamberTables& tables, const SoftModel& model);

}  // namespace diffsim
