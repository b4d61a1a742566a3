"""Quadruped, cow and torus: the robots of thesis 4.1.6 that walk and roll, on a floor.

The thesis publishes sizes of meshes and time steps, not shapes, lengths or materials; ours are made
of cubes (the torus of bricks), about as many. Its contacts stick without bound; ours have Coulomb
friction of 1 (rubber on wood), pass ``friction=math.inf`` for the thesis's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.contact import floor
from diffsim.core.checked import checked
from diffsim.mesh.voxels import hex_from_mask
from diffsim.systems.robots.robot import SoftRobot, element_centers, fibers, spread_nodes

_SIDES = ("left", "right")


@checked
def quadruped(
    *,
    cell: float = 0.01,
    coarse: bool = False,
    dt: float = 0.01,
    youngs_modulus: float = 1e5,
    amplitude: float = 0.3,
    friction: float = 1.0,
    per_muscle: bool = True,
    num_sensors: int = 12,
    rtol: float = 1e-4,
    integrator: str = "implicit_euler",
    damping: float = 0.0,
    refine: int = 1,
    half: bool = False,
) -> SoftRobot:
    """A slab on four legs; it should walk along +x.

    Each leg has a muscle along its front and one along its back; a command of 1 shortens.

    Args:
        cell: Edge length of an element [m].
        coarse: Elements of twice the edge, for quick trials.
        dt: Time step of the simulation [s].
        youngs_modulus: Young's modulus of the body [Pa].
        amplitude: Largest contraction of a muscle [-].
        friction: Friction coefficient of the floor, >= 0 or infinite [-].
        per_muscle: One command per muscle (8); or two, for the fronts and for the backs of all
            legs: with one sinusoid in opposite phase the thesis's three parameters.
        num_sensors: Number of velocity sensors.
        rtol: Relative tolerance of a time step's solution [-].
        integrator: As that of :class:`~diffsim.soft.SoftBody`; "bdf2" is implicit
            Euler while anything touches the floor.
        damping: Stiffness-proportional damping of the material [s].
        refine: Every element becomes so many along each edge, of the same shape and muscles.
        half: The left half alone, held on the plane of symmetry: exact for motions that are
            symmetric, at a quarter of the cost. It takes one command for both sides.
    """
    if coarse:
        inside, legs = build_table((10, 5, 2), (2, 2, 3))
    else:
        inside, legs = build_table((18, 8, 3), (3, 3, 6))
    return _make_legged(
        "quadruped",
        inside,
        legs,
        edge=cell * (1.8 if coarse else 1.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        friction=friction,
        per_muscle=per_muscle,
        num_sensors=num_sensors,
        rtol=rtol,
        integrator=integrator,
        damping=damping,
        refine=refine,
        half=half,
        method="newton_cholesky",  # a third of the time of "auto" at 10 ms and large strokes
    )


@checked
def cow(
    *,
    cell: float = 0.01,
    coarse: bool = False,
    dt: float = 0.001,
    youngs_modulus: float = 1e5,
    amplitude: float = 0.3,
    friction: float = 1.0,
    per_muscle: bool = True,
    num_sensors: int = 12,
    rtol: float = 1e-4,
    integrator: str = "implicit_euler",
    damping: float = 0.0,
    refine: int = 1,
    half: bool = False,
) -> SoftRobot:
    """A ``quadruped`` with a head too large for it: it tends to fall on its face."""
    if coarse:
        inside, legs = build_table((8, 5, 2), (2, 2, 3), front=2, above=1)
        inside[-4:, :, -3:] = True
    else:
        inside, legs = build_table((12, 5, 4), (2, 2, 6), front=4, above=3)
        inside[-6:-1, :, -5:] = True
        inside[-1, :, -5:-2] = True  # muzzle
        inside[-4:-2, ::4, -1] = True
    return _make_legged(
        "cow",
        inside,
        legs,
        edge=cell * (1.5 if coarse else 1.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        friction=friction,
        per_muscle=per_muscle,
        num_sensors=num_sensors,
        rtol=rtol,
        integrator=integrator,
        damping=damping,
        refine=refine,
        half=half,
    )


@checked
def torus(
    *,
    radius: float = 0.08,
    coarse: bool = False,
    dt: float = 0.004,
    youngs_modulus: float = 1e5,
    amplitude: float = 0.3,
    friction: float = 1.0,
    num_sensors: int = 8,
    rtol: float = 1e-4,
    integrator: str = "implicit_euler",
    damping: float = 0.0,
    refine: int = 1,
) -> SoftRobot:
    """A ring on its edge with eight muscles along its rim; it should roll along +x.

    Args:
        radius: Radius of the ring's middle line [m].
        coarse: Half as many sections, of 2 x 2 elements instead of 3 x 3, for quick trials.
        dt, youngs_modulus, amplitude, friction, num_sensors, rtol, integrator, damping,
            refine: Those of the same names as those of ``quadruped``.
    """
    sections, width = (24, 2) if coarse else (64, 3)
    x, hexes = _build_ring(sections * refine, width * refine, radius, 0.4 * radius)
    shape = mesh.HexMesh(x, hexes)
    center = element_centers(shape)
    turn = torch.atan2(center[:, 0], radius * 1.4 - center[:, 2])  # from the lowest point to +x
    along = torch.stack([torch.cos(turn), torch.zeros_like(turn), torch.sin(turn)], 1)
    eighth = torch.floor((turn / (2.0 * math.pi)) % 1.0 * 8.0 + 1e-9).long()
    muscles = [fibers(eighth == k, along[eighth == k], 2.0 * youngs_modulus) for k in range(8)]
    return _make_walker(
        "torus",
        shape,
        muscles,
        -amplitude * torch.eye(8, dtype=torch.float64),
        tuple(f"shorten eighth {k} of the rim" for k in range(8)),
        dt=dt,
        youngs_modulus=youngs_modulus,
        friction=friction,
        num_sensors=num_sensors,
        rtol=rtol,
        integrator=integrator,
        damping=damping,
        upright_axis=1,
    )


def _build_ring(sections: int, width: int, radius: float, half: float) -> tuple[Tensor, Tensor]:
    """Nodes and bricks of a ring standing on z = 0, axis along y, section a round square."""
    tick = np.linspace(-1.0, 1.0, width + 1)
    a, b = (g.ravel() for g in np.meshgrid(tick, tick, indexing="ij"))
    out, across = a * np.sqrt(1.0 - 0.35 * b**2), b * np.sqrt(1.0 - 0.35 * a**2)
    turn = 2.0 * math.pi * np.arange(sections) / sections
    distance = radius + half * out
    x = np.stack(
        [
            np.sin(turn)[:, None] * distance,
            np.broadcast_to(half * across, (sections, len(a))),
            radius + half - np.cos(turn)[:, None] * distance,
        ],
        -1,
    )
    n = width + 1
    i, j, k = np.indices((sections, width, width)).reshape(3, -1)
    corners = [
        ((i + di) % sections * n + j + dj) * n + k + dk
        for di in (0, 1)
        for dj in (0, 1)
        for dk in (0, 1)
    ]
    return torch.from_numpy(x.reshape(-1, 3)), torch.from_numpy(np.stack(corners, -1))


def build_table(
    body: tuple[int, int, int], leg: tuple[int, int, int], front: int = 0, above: int = 0
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Cells of a slab on legs at its corners, with room in front and above; and the legs' cells."""
    (nx, ny, nz), (lx, ly, lz) = body, leg
    inside = np.zeros((nx + front, ny, nz + lz + above), dtype=bool)
    inside[:nx, :, lz : lz + nz] = True
    for x in (slice(0, lx), slice(nx - lx, nx)):
        for y in (slice(0, ly), slice(ny - ly, ny)):
            inside[x, y, :lz] = True
    return inside, leg


def _make_legged(
    name: str,
    inside: np.ndarray,
    leg: tuple[int, int, int],
    *,
    edge: float,
    amplitude: float,
    youngs_modulus: float,
    per_muscle: bool,
    refine: int,
    half: bool = False,
    **options: Any,
) -> SoftRobot:
    """A robot of cubes on four legs, a muscle along the front and the back of each."""
    fine = np.kron(inside, np.ones((refine,) * 3, dtype=bool))
    if half:
        _check_half(name, fine.shape[1], per_muscle)
        fine[:, : fine.shape[1] // 2] = False
    # in edges of the elements that are refined, so that muscles stay where they are
    grid = hex_from_mask(fine, np.zeros(3), 1.0 / refine, "largest")
    center = element_centers(grid)
    lx, _, lz = leg
    low = center[:, 2] < lz
    middle = center[low].mean(0)
    muscles, names = [], []
    for where, ahead in (("hind", False), ("front", True)):
        for side in _SIDES[:1] if half else _SIDES:
            of_leg = low & ((center[:, 0] > middle[0]) == ahead)
            of_leg &= (center[:, 1] > 0.5 * inside.shape[1]) == (side == "left")
            start = float(center[of_leg, 0].min()) - 0.5 / refine
            for face, place in (("front", lx - 0.5), ("back", 0.5)):
                layer = of_leg & ((center[:, 0] - start - place).abs() < 0.5)
                muscles.append(fibers(layer, (0.0, 0.0, 1.0), 2.0 * youngs_modulus))
                names.append(f"shorten {face} of {where} {side} leg")
    drive = -amplitude * torch.eye(len(names), dtype=torch.float64)
    if not per_muscle:
        drive = torch.stack([drive[0::2].sum(0), drive[1::2].sum(0)])
        names = ["shorten fronts of legs", "shorten backs of legs"]
    middle_line = torch.tensor([0.0, 0.5 * inside.shape[1], 0.0], dtype=torch.float64)
    shape = mesh.HexMesh(edge * (grid.x_rest - middle_line), grid.hexes)
    return _make_walker(
        name,
        shape,
        muscles,
        drive,
        tuple(names),
        youngs_modulus=youngs_modulus,
        upright_axis=2,
        fixed=_mark_middle(shape) if half else None,
        **options,
    )


def _check_half(name: str, across: int, per_muscle: bool) -> None:
    if per_muscle:
        raise ValueError(
            f"half of a {name} has the muscles of one side only; give per_muscle=False, one "
            "command for both sides"
        )
    if across % 2:
        raise ValueError(
            f"half of a {name} must end between elements, but it has {across} across; give an even "
            "refine, or half=False"
        )


def _mark_middle(shape: mesh.HexMesh) -> Tensor:
    """Mask (num_nodes, 3) that holds y on the plane y = 0."""
    held = torch.zeros(shape.num_nodes, 3, dtype=torch.bool)
    held[:, 1] = shape.x_rest[:, 1].abs() < 1e-9
    return held


def _make_walker(
    name: str,
    shape: mesh.HexMesh,
    muscles: list[soft.Muscle],
    drive: Tensor,
    command_names: tuple[str, ...],
    *,
    dt: float,
    youngs_modulus: float,
    friction: float,
    num_sensors: int,
    rtol: float,
    upright_axis: int,
    integrator: str,
    damping: float,
    method: str = "auto",
    fixed: Tensor | None = None,
) -> SoftRobot:
    body = soft.SoftBody(
        shape,
        dt=dt,
        element="standard",
        youngs_modulus=youngs_modulus,
        poissons_ratio=0.4,
        density=1000.0,
        fixed=fixed,
        muscles=muscles,
        integrator=integrator,
        damping=soft.Damping(rayleigh_beta=damping) if damping > 0.0 else None,
        solver=soft.SolverOptions(method=method, rtol=rtol),
    )
    return SoftRobot(
        name=name,
        body=body,
        drive=drive,
        command_names=command_names,
        sensors=spread_nodes(shape.x_rest, num_sensors),
        forward=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        obstacles=(floor(friction=friction, name="floor"),),
        upright_axis=upright_axis,
    )
