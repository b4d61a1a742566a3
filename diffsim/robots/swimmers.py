"""Starfish and shark: the swimmers of thesis 4.1.6 at their sizes, with bodies of our own making.

The thesis publishes numbers of elements and degrees of freedom, not meshes, lengths or materials;
ours have nearly its numbers and are as large as explicit hydrodynamics asks for at 33 ms.
"""

from __future__ import annotations

import numpy as np
import torch

from diffsim import mesh, soft
from diffsim.mesh.voxels import hex_from_mask
from diffsim.robots.robot import SoftRobot, antagonists, element_centres, fibres, spread_nodes

DT = 1.0 / 30.0  # [s]
DENSITY = 1000.0  # of body and water [kg/m^3]: weight and buoyancy cancel


def starfish(
    *,
    cell: float = 0.03,
    refine: int = 1,
    coarse: bool = False,
    dt: float = DT,
    youngs_modulus: float = 5e5,
    amplitude: float = 0.3,
    num_sensors: int = 137,
    rtol: float = 1e-3,
) -> SoftRobot:
    """Four arms around a square, lying flat; it should rise.

    Each arm has a lower and an upper layer of fibres along it, driven by one command: +1 shortens
    the lower one, so the arm bends down.

    Args:
        cell: Edge of an element [m].
        refine: Whole factor on the resolution.
        coarse: Two layers, arms of nine cells: an eighth of the elements, for quick trials.
        dt: Time step [s].
        youngs_modulus: [Pa].
        amplitude: Largest contraction of a muscle [-].
        num_sensors: Velocity sensors; 137 give the 411 inputs of the thesis's network.
        rtol: Of a step.
    """
    wide, long, thick = (3, 9, 2) if coarse else (5, 18, 4)
    cell = cell * (2.0 if coarse else 1.0) / refine
    wide, long, thick = wide * refine, long * refine, thick * refine
    n = wide + 2 * long
    inside = np.zeros((n, n, thick), dtype=bool)
    inside[long : long + wide] = True
    inside[:, long : long + wide] = True
    origin = np.array([-0.5 * n * cell, -0.5 * n * cell, 0.0])
    shape = hex_from_mask(inside, origin, cell, "largest")
    centre = element_centres(shape)
    half, layer = 0.5 * wide * cell, thick * cell / 4.0 if not coarse else thick * cell / 2.0
    muscles, names = [], []
    for axis, sign in ((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0)):
        along = sign * centre[:, axis] > half
        direction = [0.0, 0.0, 0.0]
        direction[axis] = 1.0
        for low in (True, False):
            height = centre[:, 2] if low else thick * cell - centre[:, 2]
            muscles.append(fibres(shape, along & (height < layer), direction, 4.0 * youngs_modulus))
        names.append(f"bend arm {'+-'[sign < 0]}{'xy'[axis]} down")
    return _swimmer(
        "starfish",
        shape,
        muscles,
        tuple(names),
        forward=(0.0, 0.0, 1.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        num_sensors=num_sensors,
        rtol=rtol,
    )


def shark(
    *,
    cell: float = 0.04,
    coarse: bool = False,
    dt: float = DT,
    youngs_modulus: float = 1e6,
    amplitude: float = 0.3,
    num_sensors: int = 95,
    rtol: float = 1e-3,
) -> SoftRobot:
    """A body tapering into a tail with a fin; it should swim along +x.

    Fibres along the left and the right of the tail are driven by one command.

    Args:
        cell: Edge of an element [m].
        coarse: Cells of twice the edge, for quick trials.
        dt: Time step [s].
        youngs_modulus: [Pa].
        amplitude: Largest contraction of a muscle [-].
        num_sensors: Velocity sensors; 95 give the 285 inputs of the thesis's network.
        rtol: Of a step.
    """
    edge = cell * (2.0 if coarse else 1.0)
    length, n = 52 * cell, round(52 * cell / edge)
    wide = 2 * round(4 * cell / edge)
    tall = 2 * round(8 * cell / edge)
    ticks = [
        (np.arange(n) + 0.5) * edge - length,
        (np.arange(wide) + 0.5 - wide / 2) * edge,
        (np.arange(tall) + 0.5 - tall / 2) * edge,
    ]
    x, y, z = np.meshgrid(*ticks, indexing="ij")
    inside = _shark_inside(-x / length, np.abs(y), z, cell)
    origin = np.array([-length, -0.5 * wide * edge, -0.5 * tall * edge])
    shape = hex_from_mask(inside, origin, edge, "largest")
    centre = element_centres(shape)
    share = -centre[:, 0] / length
    tail = (share > 0.5) & (share < 0.9) & (centre[:, 2].abs() < 2.5 * cell)
    muscles = [
        fibres(shape, tail & (side * centre[:, 1] > 0.0), (1.0, 0.0, 0.0), 2.0 * youngs_modulus)
        for side in (1.0, -1.0)
    ]
    return _swimmer(
        "shark",
        shape,
        muscles,
        ("bend tail to +y",),
        forward=(1.0, 0.0, 0.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        num_sensors=num_sensors,
        rtol=rtol,
    )


def _shark_inside(share: np.ndarray, y: np.ndarray, z: np.ndarray, cell: float) -> np.ndarray:
    """Body of revolution, thin tail, fins; ``share`` is the distance from the nose over length."""
    radius = (
        4.2
        * cell
        * np.sqrt(np.clip(share / 0.25, 0.0, 1.0))
        * np.clip(1.35 - share * 1.25, 0.3, 1.0)
    )
    body = (y / np.maximum(np.minimum(radius, 3.6 * cell), cell)) ** 2 + (z / radius) ** 2 < 1.0
    body |= (share > 0.6) & (y < cell) & (np.abs(z) < 2.0 * cell)
    fork = 2.0 * cell + (share - 0.86) / 0.14 * 6.0 * cell
    tail_fin = (share > 0.86) & (y < cell) & (np.abs(z) < fork)
    back_fin = (share > 0.36) & (share < 0.5) & (y < cell) & (z > 0.0)
    back_fin &= z < 3.0 * cell + (share - 0.36) / 0.14 * 4.0 * cell
    return body | tail_fin | back_fin


def _swimmer(
    name: str,
    shape: mesh.HexMesh,
    muscles: list[soft.Muscle],
    command_names: tuple[str, ...],
    *,
    forward: tuple[float, float, float],
    dt: float,
    youngs_modulus: float,
    amplitude: float,
    num_sensors: int,
    rtol: float,
) -> SoftRobot:
    water = soft.Hydrodynamics(shape, density=DENSITY).requires_grad_(False)
    body = soft.SoftBody(
        shape,
        dt=dt,
        youngs_modulus=youngs_modulus,
        poissons_ratio=0.45,
        density=DENSITY,
        gravity=(0.0, 0.0, 0.0),
        muscles=muscles,
        added_mass=soft.added_mass(water, 1.0),
        solver=soft.SolverOptions(rtol=rtol),
    )
    return SoftRobot(
        name=name,
        body=body,
        drive=antagonists(len(command_names), amplitude),
        command_names=command_names,
        sensors=spread_nodes(shape.x_rest, num_sensors),
        forward=torch.tensor(forward, dtype=torch.float64),
        water=water,
    )
