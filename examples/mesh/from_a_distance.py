"""How good is a mesh of a solid that is given by a signed distance?

A ball with a hole through it, from formulas alone. Cubes are inside or not, so that their volume
scatters; tetrahedra have their nodes on the surface, and come closer with every finer spacing.

Expected: tetrahedra miss 4.4 % of the volume at 25 mm, 0.8 % at 12.5 mm. Running time: 2 s.

    python examples/mesh/from_a_distance.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import math

from diffsim import mesh

RADIUS, HOLE = 0.1, 0.04  # [m]


def main(spacings: tuple[float, ...] = (0.025, 0.0125)) -> dict[str, float]:
    """Relative error of the volume, by kind of element and spacing [m]."""
    solid = mesh.sdf.difference(mesh.sdf.sphere(RADIUS), mesh.sdf.cylinder(HOLE, 4.0 * RADIUS))
    bounds = ([-1.2 * RADIUS] * 3, [1.2 * RADIUS] * 3)
    exact = 4.0 / 3.0 * math.pi * (RADIUS**2 - HOLE**2) ** 1.5  # the napkin ring
    found = {}
    for spacing in spacings:
        for name, make in (("cubes", mesh.hex_from_sdf), ("tetrahedra", mesh.tet_from_sdf)):
            volume = float(mesh.total_volume(make(solid, bounds, spacing)))
            found[f"{name}, {1e3 * spacing:g} mm"] = volume / exact - 1.0
    return found


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:20s} {value:+.4f}")
