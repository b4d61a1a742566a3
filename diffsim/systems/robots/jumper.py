"""The soft jumper: a light table on four legs whose material swells and shrinks on command.

After the soft jumper of Xing, Luk and Oh, "Stabilizing reinforcement learning in differentiable
multiphysics simulation" (ICLR 2025, arXiv:2412.12089). Constants of material, actuation and
friction are theirs; of the mesh only the size was to be had, 204 nodes and 444 tetrahedra, so ours
is of cubes.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.contact import floor
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.mesh.box import KUHN
from diffsim.mesh.voxels import hex_from_mask
from diffsim.systems.robots.robot import SoftRobot, spread_nodes
from diffsim.systems.robots.walkers import build_table

# Passive stiffness of the fibers that carry the active stress [Pa]: 0.4 % of Young's modulus.
FIBER_STIFFNESS = 10.0
_Cells = tuple[int, int, int]


@checked
def soft_jumper(
    *,
    cell: float = 0.3,
    coarse: bool = False,
    dt: float = 1.0 / 120.0,
    youngs_modulus: float = 2500.0,
    poissons_ratio: float = 0.25,
    density: float = 1.0,
    active_stress: float = 300.0,
    friction: float = 0.7,
    damping: float = 1e-3,
    num_sensors: int = 12,
    rtol: float = 1e-4,
    integrator: str = "implicit_euler",
) -> SoftRobot:
    """A slab of 6 x 4 x 2 cells on legs of 2 x 1 x 3: 177 nodes, 432 tetrahedra, 216 commands.

    A command of 1 puts two tetrahedra under an isotropic tension of ``active_stress``, a command of
    -1 under as much pressure: free, their edges become 7.6 % shorter and 5.1 % longer. The stress
    comes from three orthogonal fibers in every tetrahedron, which hold it per undeformed area.

    Heights and speeds of jumps do not depend on the size, as stored energy and weight both grow
    with the volume; ``cell`` sets how long a jump's push takes.

    Args:
        cell: Edge length of a cell; six tetrahedra fill it [m].
        coarse: A slab of 3 x 2 x 1 cells of twice the edge on legs of 1 x 1 x 2, for quick trials:
            45 nodes, 84 tetrahedra, 42 commands.
        dt: Time step of the simulation [s].
        youngs_modulus, poissons_ratio: Stable neo-Hookean solid; mu = lambda = 1,000 Pa [Pa], [-].
        density: Mass per volume [kg/m^3].
        active_stress: Stress of a command of 1 [Pa].
        friction: Friction coefficient of the floor, >= 0 or infinite [-].
        damping: Stiffness-proportional damping of the material [s].
        num_sensors: Number of velocity sensors.
        rtol: Relative tolerance of a time step's solution. Its scale are inertial forces, which
            grow with 1 / dt^2: here 1 % of the weight, at half the step four times as much [-].
        integrator: As that of :class:`~diffsim.soft.SoftBody`.
    """
    edge = require_number("cell", cell, above=0.0, hint="unit is m") * (2.0 if coarse else 1.0)
    stress = require_number("active_stress", active_stress, above=0.0, hint="unit is Pa")
    shape = _build_table(edge, *(((3, 2, 1), (1, 1, 2)) if coarse else ((6, 4, 2), (2, 1, 3))))
    pairs = torch.arange(shape.num_elements).reshape(-1, 2)  # tetrahedra of a command
    body = soft.SoftBody(
        shape,
        dt=dt,
        element="standard",
        youngs_modulus=youngs_modulus,
        poissons_ratio=poissons_ratio,
        density=density,
        material="stable_neo_hookean",
        muscles=[_make_isotropic_muscle(pair) for pair in pairs],
        damping=soft.Damping(rayleigh_beta=damping),
        integrator=integrator,
        solver=soft.SolverOptions(method="newton_cholesky", rtol=rtol),
    )
    return SoftRobot(
        name="soft jumper",
        body=body,
        # psi = w/2 (|F m| - a)^2 pulls with w (1 - a) at rest, along each of three directions
        drive=-(stress / FIBER_STIFFNESS) * torch.eye(len(pairs), dtype=torch.float64),
        command_names=tuple(f"contract tetrahedra {a} and {b}" for a, b in pairs.tolist()),
        sensors=spread_nodes(shape.x_rest, num_sensors),
        forward=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        obstacles=(floor(friction=friction, name="floor"),),
    )


def _make_isotropic_muscle(elements: Tensor) -> soft.Muscle:
    """Three orthogonal fibers in each of the elements, one activation."""
    axes = torch.eye(3, dtype=torch.float64)
    return soft.Muscle(
        elements=elements.repeat_interleave(3),
        direction=axes.repeat(len(elements), 1),
        stiffness=FIBER_STIFFNESS,
    )


def _build_table(edge: float, slab: _Cells, leg: _Cells) -> mesh.TetMesh:
    """A slab of cubes on legs at its corners, soles on z = 0, middle at x = y = 0.

    Each cube is six tetrahedra around one of its diagonals; neighbors conform.
    """
    origin = edge * np.array([-0.5 * slab[0], -0.5 * slab[1], 0.0])
    grid = hex_from_mask(build_table(slab, leg)[0], origin, edge, "largest")
    return mesh.TetMesh(grid.x_rest, grid.hexes[:, torch.from_numpy(KUHN)].reshape(-1, 4))
