"""Starfish and shark: the swimmers of thesis 4.1.6 at their sizes, with bodies of our own making.

The thesis publishes numbers of elements and degrees of freedom, not meshes, lengths or materials.
Hydrodynamics is held over a step of 33 ms, which bounds speeds by thickness: the bodies are large,
soft and slow. Both swim by a passive end: muscles bend the root of an arm or tail, its end follows
late, and the wave that runs outward pushes water that way.

Steps are not solved to the thesis's 1e-3: there a command below about 0.1 leaves a residual below
tolerance, so that the body hardly moves, while the adjoint, which solves its own system, says it
would. Unstable feedback then shows in gradients alone (norms beyond 1e50 over 200 steps at zero
reward). Conjugate gradients at 1e-4 still show it: at an untrained network, gradients of 25 steps
of the large shark have a cosine of -0.1 with sampled ones, at 1e-5 one of 0.995. Large bodies take
them at 1e-5; coarse ones take one factor of the tangent per step, on which 1e-6 costs a third more
than 1e-4 and moves gradients by 1e-5 instead of 3e-3 (docs/measured/environments.md).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.core.checked import checked
from diffsim.mesh.voxels import hex_from_mask
from diffsim.systems.robots.robot import (
    SoftRobot,
    antagonists,
    element_centers,
    fibers,
    spread_nodes,
)

DT = 1.0 / 30.0  # [s]
HALF_WIDTH, LENGTH, HALF_THICKNESS = 2.5, 18.0, 2.0  # of the starfish's arms [cells]
# Min et al. 2019, but zero where a face turns edge-on: the force does not jump there, so that
# gradients of an episode are those of a continuous function
DRAG, THRUST = (0.0, 0.05, 1.85, 2.05), (-0.8, -2.0 / 3.0, 0.1, 2.5)
DENSITY = 1000.0  # of body and water [kg/m^3]: weight and buoyancy cancel


@checked
def starfish(
    *,
    cell: float = 0.08,
    coarse: bool = False,
    dt: float = DT,
    youngs_modulus: float = 3e5,
    amplitude: float = 0.15,
    droop: float = 0.6,
    num_sensors: int = 137,
    rtol: float | None = None,
    method: str | None = None,
) -> SoftRobot:
    """Four tapering arms that hang down around a square; it should rise.

    The inner part of each arm has a lower and an upper layer of fibers along it, driven by one
    command: +1 shortens the lower one, so the arm bends down.

    Args:
        cell: Edge of an element at the middle [m].
        coarse: Cells of twice the edge, an eighth of the elements: for quick trials.
        dt: Time step of the simulation [s].
        youngs_modulus: Young's modulus of the body [Pa].
        amplitude: Largest contraction of a muscle [-].
        droop: Slope of the arms' ends at rest [rad].
        num_sensors: Velocity sensors; 137 give the 411 inputs of the thesis's network.
        rtol: Relative tolerance of a time step's solution [-]; None: 1e-5, coarse 1e-6 (see the
            module).
        method: Of a time step, see :class:`~diffsim.soft.SolverOptions`; ``linearly_implicit``
            costs half of the default, and damps a little differently.
    """
    wide, long, thick = (2, 9, 2) if coarse else (5, 18, 4)
    n = wide + 2 * long
    inside = np.zeros((n, n, thick), dtype=bool)
    inside[long : long + wide] = True
    inside[:, long : long + wide] = True
    grid = hex_from_mask(inside, np.array([-0.5 * n, -0.5 * n, -0.5 * thick]), 1.0, "largest")
    counts = (wide, long, thick)
    center = element_centers(grid)
    x, _ = _bend_arms(grid.x_rest, counts, droop)
    _, slope = _bend_arms(center, counts, droop)
    shape = mesh.HexMesh(cell * x, grid.hexes)
    # the coarse layer is twice as thick, its lever two thirds as long
    stiffness = (1.5 if coarse else 2.0) * youngs_modulus
    muscles, names = [], []
    for axis, sign in ((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0)):
        along = sign * center[:, axis] - 0.5 * wide
        root = (along > 0.0) & (along < 0.6 * long)
        direction = torch.zeros_like(center)
        direction[:, axis], direction[:, 2] = sign * torch.cos(slope), -torch.sin(slope)
        for side in (-1.0, 1.0):
            layer = root & (side * center[:, 2] > 0.25 * thick - 1e-9)
            muscles.append(fibers(layer, direction[layer], stiffness))
        names.append(f"bend arm {'+-'[sign < 0]}{'xy'[axis]} down")
    return _make_swimmer(
        "starfish",
        shape,
        muscles,
        tuple(names),
        forward=(0.0, 0.0, 1.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        added=torch.ones(shape.num_nodes, dtype=torch.float64),
        num_sensors=num_sensors,
        solver=_choose_solver(coarse, rtol, method),
    )


def _bend_arms(points: Tensor, counts: tuple[int, int, int], droop: float) -> tuple[Tensor, Tensor]:
    """Grid of a cross to arms on arcs, in units of ``cell``; also the slope at every point.

    The upper side is a roof, the lower one is flat: it meets the water broadside, so that a stroke
    down pushes harder than the same stroke up.
    """
    wide, long, thick = counts
    out = torch.zeros_like(points)
    slope = torch.zeros(len(points), dtype=torch.float64)
    out[:, :2] = points[:, :2] * HALF_WIDTH / (0.5 * wide)
    level = points[:, 2] * HALF_THICKNESS / (0.5 * thick)
    out[:, 2] = level
    for axis in (0, 1):
        arm = points[:, axis].abs() > 0.5 * wide
        share = (points[arm, axis].abs() - 0.5 * wide) / long
        taper = 1.0 - 0.5 * share**1.5
        across = out[arm, 1 - axis] / HALF_WIDTH
        roof = torch.where(level[arm] > 0.0, 1.0 - 0.8 * across**2, 1.0)
        height = level[arm] * roof * taper
        angle, radius = droop * share, LENGTH / droop
        along = HALF_WIDTH + (radius + height) * torch.sin(angle)
        out[arm, axis] = points[arm, axis].sign() * along
        out[arm, 1 - axis] *= taper
        out[arm, 2] = height * torch.cos(angle) - radius * (1.0 - torch.cos(angle))
        slope[arm] = angle
    return out, slope


@checked
def shark(
    *,
    length: float = 4.0,
    coarse: bool = False,
    dt: float = DT,
    youngs_modulus: float = 3e5,
    amplitude: float = 0.15,
    num_sensors: int = 95,
    rtol: float | None = None,
    method: str | None = None,
) -> SoftRobot:
    """A spindle with back, breast and tail fins; it should swim along +x.

    Fibers along the left and the right of the tail are driven by one command.

    Args:
        length: Length from nose to tail [m].
        coarse: Cells of about twice the edge, for quick trials.
        dt: Time step of the simulation [s].
        youngs_modulus: Young's modulus of the body [Pa].
        amplitude: Largest contraction of a muscle [-].
        num_sensors: Velocity sensors; 95 give the 285 inputs of the thesis's network.
        rtol: Relative tolerance of a time step's solution [-]; None: 1e-5, coarse 1e-6 (see the
            module).
        method: Of a time step, see :class:`~diffsim.soft.SolverOptions`; ``linearly_implicit``
            costs half of the default, and damps a little differently.
    """
    n, wide, tall, fin = (15, 4, 4, 2) if coarse else (44, 6, 8, 6)
    inside = _list_shark_cells(n, wide, tall, fin)
    origin = np.array([0.0, -0.5 * inside.shape[1], -0.5 * inside.shape[2]])
    grid = hex_from_mask(inside, origin, 1.0, "largest")
    counts = torch.tensor([n, 0.5 * wide, 0.5 * tall], dtype=torch.float64)
    u = grid.x_rest / counts
    shape = mesh.HexMesh(length * _shape_spindle(u, fin / counts[1:]), grid.hexes)
    middle = element_centers(grid) / counts
    share, side, up = middle.unbind(1)
    tail = (share > 0.4) & (share < 0.8) & (up.abs() < 1.0)
    muscles = []
    for sign in (-1.0, 1.0):  # the grid's second axis is -y
        layer = tail & (sign * side > 0.5)
        muscles.append(fibers(layer, (1.0, 0.0, 0.0), 2.0 * youngs_modulus))
    added = torch.ones(shape.num_nodes, dtype=torch.float64)
    added[(u[:, 1:].abs() > 1.0).any(1) | (u[:, 0] > 0.86)] = 4.0  # plates: pi w / (4 t)
    return _make_swimmer(
        "shark",
        shape,
        muscles,
        ("bend tail to +y",),
        forward=(1.0, 0.0, 0.0),
        dt=dt,
        youngs_modulus=youngs_modulus,
        amplitude=amplitude,
        added=added,
        num_sensors=num_sensors,
        solver=_choose_solver(coarse, rtol, method),
    )


def _list_shark_cells(n: int, wide: int, tall: int, fin: int) -> np.ndarray:
    """Cells (n, wide + 2 fin, tall + 2 fin) of the body and of fins on it, two cells thick."""
    inside = np.zeros((n, wide + 2 * fin, tall + 2 * fin), dtype=bool)
    across, up = slice(fin, fin + wide), slice(fin, fin + tall)
    thin = slice(fin + wide // 2 - 1, fin + wide // 2 + 1)
    low = slice(fin + tall // 4, fin + tall // 4 + 2)
    short = fin // 3  # how much smaller back and breast fins are than the tail fin
    inside[:, across, up] = True
    inside[round(0.87 * n) :, thin] = True  # tail
    inside[round(0.4 * n) : round(0.54 * n), thin, fin : 2 * fin + tall - short] = True  # back
    inside[round(0.26 * n) : round(0.38 * n), short : 2 * fin + wide - short, low] = True  # breast
    return inside


def _shape_spindle(u: Tensor, reach: Tensor) -> Tensor:
    """Grid to shark over its length: u is 0..1 from the nose, -1..1 across, beyond +-1 a fin."""
    share, y, z = u.unbind(1)
    # fattest at 0.3; the peduncle before the tail fin is thin but high
    front = (1.0 - 0.85 * (1.0 - (share / 0.3).clamp(max=1.0)) ** 2).sqrt()
    slim = ((share - 0.3) / 0.6).clamp(0.0, 1.0) ** 1.3
    thick, high = 0.08 * front * (1.0 - 0.65 * slim), 0.1 * front * (1.0 - 0.6 * slim)
    side, level = y.clamp(-1.0, 1.0), z.clamp(-1.0, 1.0)
    # square to nearly a disc, which keeps corners of hexahedra below 180 degrees
    across = thick * side * (1.0 - 0.4 * level**2).sqrt()
    up = high * level * (1.0 - 0.4 * side**2).sqrt()
    beyond = (torch.stack([y.abs(), z.abs()], 1) - 1.0).clamp(min=0.0) / reach
    span = torch.where(share > 0.8, 0.14, 0.12)[:, None] * beyond
    sweep = 0.09 * beyond.sum(1)
    return torch.stack(
        [-share - sweep, -across - span[:, 0] * y.sign(), up + span[:, 1] * z.sign()], 1
    )


def _choose_solver(coarse: bool, rtol: float | None, method: str | None) -> soft.SolverOptions:
    usual, default = ("auto", 1e-6) if coarse else ("newton_pcg", 1e-5)
    return soft.SolverOptions(method=method or usual, rtol=default if rtol is None else rtol)


def _make_swimmer(
    name: str,
    shape: mesh.HexMesh,
    muscles: list[soft.Muscle],
    command_names: tuple[str, ...],
    *,
    forward: tuple[float, float, float],
    dt: float,
    youngs_modulus: float,
    amplitude: float,
    added: Tensor,
    num_sensors: int,
    solver: soft.SolverOptions,
) -> SoftRobot:
    water = soft.Hydrodynamics(
        shape, density=DENSITY, drag_coefficients=DRAG, thrust_coefficients=THRUST
    ).requires_grad_(False)
    body = soft.SoftBody(
        shape,
        dt=dt,
        element="standard",
        youngs_modulus=youngs_modulus,
        poissons_ratio=0.4,
        density=DENSITY,
        gravity=(0.0, 0.0, 0.0),
        muscles=muscles,
        masses=soft.Masses(added_mass=soft.added_mass(water, added)),
        solver=solver,
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
