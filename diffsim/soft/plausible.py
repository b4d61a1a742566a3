"""Do the numbers of a body look like meters, pascal and kilograms per cubic meter, and will its
elements lock?"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from diffsim.core.numbers import values_of
from diffsim.core.record import warn
from diffsim.mesh import HexMesh, TetMesh

# What soft robots and their test pieces are not: outside of these, a unit was usually forgotten.
SIZES = (1e-4, 30.0)  # longest side [m]
MODULI = (50.0, 5e12)  # [Pa]; agar gels have 1 kPa, diamond 1 TPa
DENSITIES = (0.5, 3e4)  # [kg/m^3]; foams have 10, osmium 22,600


class UnitsWarning(UserWarning):
    """A number of a body lies where its unit has usually been forgotten."""


def warn_of_units(x_rest: Tensor, youngs_modulus: Tensor, density: Tensor) -> None:
    """Warn once of all that looks like another unit; the body is made all the same.

    Args:
        x_rest: Nodes at rest, (n_nodes, 3) [m].
        youngs_modulus: () or (n_elements,) [Pa].
        density: () or (n_elements,) [kg/m^3]; zero is no mistake: masses may be attached.
    """
    said = list(_doubts(values_of(x_rest), values_of(youngs_modulus), values_of(density)))
    if said:
        warn(
            "check the units (meters, pascal, kg/m^3): " + "; ".join(said),
            UnitsWarning,
            stacklevel=3,
        )


class LockingWarning(UserWarning):
    """The standard element makes a thin body much too stiff in bending."""


THIN = 3.0  # longest side by thickness of what bends more than it is sheared
TOLD = 1.2  # stiffness by that of a fine mesh, from which on it is told


def expected_stiffness(mesh: HexMesh | TetMesh, poissons_ratio: float) -> tuple[float, float]:
    """About how much too stiff a body of standard elements is in bending, and cells it is thick.

    Fits within 5 % of what ``python -m benchmarks.elements --case beam`` measures up to nu 0.49;
    1 for a body that is not thin, by its sides along the axes. Tetrahedra in one direction
    (``tet_box`` without ``symmetric``) are stiffer still.

    Args:
        mesh: Rest shape.
        poissons_ratio: Of the solid [-].

    Returns:
        Stiffness by that of a fine mesh [-], and cells through the thickness [-].
    """
    corners = mesh.x_rest[mesh.elements]
    sides = mesh.x_rest.amax(0) - mesh.x_rest.amin(0)
    cells = (corners.amax(1) - corners.amin(1)).median(0).values
    thin, long = int(sides.argmin()), int(sides.argmax())
    count = max(1.0, float(sides[thin] / cells[thin]))
    if float(sides[long]) < THIN * float(sides[thin]):
        return 1.0, count
    shape = float(cells[long] / cells[thin])
    if mesh.kind == "tet":
        return 1.0 + 2.9 * max(1.0, shape**2) / count**2, count
    ratio = max(0.0, poissons_ratio / (1.0 - 2.0 * poissons_ratio))
    volume = 0.75 * ratio / (ratio + 8.0 * count**2)
    return 1.0 + 0.5 * shape**2 / count**2 + volume, count


def warn_of_locking(mesh: HexMesh | TetMesh, poissons_ratio: Tensor) -> None:
    """Warn of standard elements that nobody chose, with the size to be expected."""
    nu = float(values_of(poissons_ratio).max())
    stiffness, count = expected_stiffness(mesh, nu)
    if stiffness < TOLD:
        return
    cells = "one cell" if round(count) == 1 else f"{count:.0f} cells"
    better = (
        "element='assumed_strain' bends as it should"
        if mesh.kind == "hex"
        else "element='quadratic' on mesh.split_tets(...) bends as it should"
    )
    warn(
        f"the body is thin in bending, about {stiffness:.1f} times too stiff with {cells} through "
        f"the thickness at nu {nu:.3g}; {better}, element='standard' keeps it",
        LockingWarning,
        stacklevel=3,
    )


def _doubts(x_rest: Tensor, modulus: Tensor, density: Tensor) -> Iterator[str]:
    length = float((x_rest.amax(0) - x_rest.amin(0)).max())
    if not SIZES[0] <= length <= SIZES[1]:
        yield f"the body is {length:g} m long; nodes in millimeters times 1e-3 are meters"
    for name, values, (low, high), unit, hint in (
        ("youngs_modulus", modulus, MODULI, "Pa", "1 MPa is 1e6"),
        ("density", density, DENSITIES, "kg/m^3", "1 g/cm^3 is 1000"),
    ):
        odd = values[((values < low) & (values > 0.0)) | (values > high)]
        if torch.numel(odd):
            yield f"{name} is {float(odd.flatten()[0]):g} {unit}; {hint}"
