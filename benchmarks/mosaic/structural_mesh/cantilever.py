"""Mosaic's cantilever: inputs of the domain structural-mesh, and the values that it keeps.

The box [0, 2] x [0, 1] x [0, 1] has N x ny x nz equal hexahedra and is clamped at x = 0. A total
force of 1 pulls the face x = 2 down: as equal forces on its nodes, or as a traction.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim import mesh

SIZE = (2.0, 1.0, 1.0)
# Compliances that Mosaic keeps for its own checks, float32: uniform density over N with ny = 2,
# nz = 4; and N = 8 over the density. Traction on the loaded face.
KEPT_BY_SIZE = {4: 0.00366518, 6: 0.00388678, 8: 0.00397532, 12: 0.00404401, 16: 0.00406958}
KEPT_BY_DENSITY = {
    0.2: 0.0556488,
    0.4: 0.00770596,
    0.5: 0.00397532,
    0.7: 0.00145609,
    0.9: 6.8616e-4,
}


def inputs(
    cells: tuple[int, int, int], rho: float | np.ndarray = 0.5, *, kind: str = "force"
) -> dict[str, Any]:
    """Inputs of the domain, float32 and int32 as its schema wants them.

    Args:
        cells: Hexahedra along x, y, z.
        rho: Density of all, or of each in the mesh's order.
        kind: ``force`` or ``traction``.
    """
    box = mesh.hex_box(cells, SIZE)
    points = box.nodes.numpy().astype(np.float32)
    end = points[:, 0] > SIZE[0] - 1e-6
    load = 1.0 / end.sum() if kind == "force" else 1.0 / (SIZE[1] * SIZE[2])
    return {
        "rho": np.broadcast_to(np.asarray(rho, np.float32), (box.num_elements,)).copy(),
        "hex_mesh": {
            "points": points,
            "faces": box.hexes.numpy()[:, mesh.VTK_FROM_HEX].astype(np.int32),
            "n_points": box.num_nodes,
            "n_faces": box.num_elements,
        },
        "boundary_conditions": {
            "dirichlet": {"mask": (points[:, 0] < 1e-6).astype(np.int32), "values": None},
            "neumann": {
                "mask": end.astype(np.int32),
                "values": np.array([[0.0, 0.0, -load]], np.float32),
            },
        },
        "neumann_kind": kind,
    }
