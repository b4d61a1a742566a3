"""A quarter of the starfish: core and half of two legs, cut at the planes y = 0 and z = 0.

All four tendons hang on one servo, so body, water and rail are mirror images of each other about
both planes; motion along x is all that the rail leaves. The cut is exact for what is symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import mesh, soft
from diffsim.soft.hydrodynamics import DRAG_COEFFICIENTS, THRUST_COEFFICIENTS

Array = NDArray[np.float64]
REACH, WIDTH, CORE, THICK = 0.070, 0.015, 0.018, 0.0175  # tip, leg, half center, at center [m]
TENDON = 0.065  # full length, ends at the tip [m]
LEAD = 0.5  # the simulation tightens the tendons this long before the record begins [s]
FADE_ANGLE = 0.1  # of attack, below which the force of the water fades [rad]
DEPTH = 1.5e-3  # of the tendon under the flat side [m]
TENDON_LAYER = 2.0 * DEPTH
# thickness over distance from the center, read off starfish_half_simplified.obj [m]
FAR, THICKNESS = (0.0, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07), (17.5, 17.0, 15.6, 13.3, 11.0, 9.1, 6.3)
MIDDLE, TIP = 0.0381, 0.0666  # places of the markers, mean of the upper and the lower leg [m]


@dataclass(frozen=True, eq=False)
class Quarter:
    """A quarter of the starfish on one mesh."""

    body: soft.SoftBody  # soft body with one muscle, which stands for both half tendons
    rail: Tensor  # (num_nodes,) shares of the nodes that the rail holds; they sum to 1
    rows: Tensor  # (2, n) weights of ``nodes``: marker at the middle of a leg, marker at its tip
    nodes: Tensor  # (n,) along the leg's edge on the flat side

    def look(self, x: Tensor) -> Tensor:
        """Channels (..., 3) [m]: the tip's x and z less those of the middle; the middle's x."""
        middle, tip = (self.rows @ x[..., self.nodes, :]).unbind(-2)
        leg = tip - middle
        return torch.stack([leg[..., 0], leg[..., 2], middle[..., 0]], -1)


def make_mesh(refine: int = 1) -> mesh.HexMesh:
    """Flat side x = 0, top at x < 0, legs along +y and +z; ``refine`` splits every cell's edge.

    The layer under the flat side is one cell, with the tendons in its middle, on every mesh: a
    fiber acts along the center of its cells, so that its arm does not depend on ``refine``.
    """
    core = np.linspace(0.0, WIDTH / 2, 1 + refine)
    shoulder = np.linspace(WIDTH / 2, CORE, 1 + refine)[1:]
    arm = np.linspace(CORE, REACH, 1 + 9 * refine)[1:]
    ticks = np.concatenate([core, shoulder, arm])
    layers, n = 1 + 2 * refine, len(ticks) - 1
    grid = mesh.hex_box((layers, n, n))
    scale = torch.tensor([layers, n, n], dtype=torch.float64)
    index = torch.round(grid.x_rest * scale).long().numpy()
    y, z = ticks[index[:, 1]], ticks[index[:, 2]]
    thick = 1e-3 * np.interp(np.maximum(y, z), FAR, THICKNESS)
    above = np.minimum(index[:, 0], layers - 1) / (layers - 1)
    depth = thick - (thick - TENDON_LAYER) * above
    depth[index[:, 0] == layers] = 0.0
    x = torch.from_numpy(np.stack([-depth, y, z], 1))
    middle = x[grid.hexes].mean(1)
    leg = (middle[:, 1:] < WIDTH / 2).any(1)
    used, local = torch.unique(grid.hexes[leg | (middle[:, 1:] < CORE).all(1)], return_inverse=True)
    return mesh.HexMesh(x[used], local)


def tendons(m: mesh.HexMesh) -> list[soft.Tendon]:
    """Half a tendon along either leg."""
    reach = REACH - TENDON
    ends = (
        (np.array([0.0, WIDTH / 4]), np.array([reach, 0.0]), np.array([REACH, 0.0])),
        (np.array([WIDTH / 4, 0.0]), np.array([0.0, reach]), np.array([0.0, REACH])),
    )
    return [
        soft.Tendon(m, [[-DEPTH, *(a + side)], [-DEPTH, *(b + side)]], axial_stiffness=100.0)
        for side, a, b in ends
    ]


def quarter(
    refine: int, dt_s: float, rtol: float, integrator: str, poissons_ratio: float
) -> Quarter:
    """The body with its tendons; density, stiffness and damping are the scene's to say."""
    m = make_mesh(refine)
    x = m.x_rest
    held = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    on_rail = (x[:, 1:] < WIDTH / 2 + 1e-9).all(1)  # the same part of the core on every mesh
    held[on_rail, 1:] = True
    held[x[:, 1] < 1e-9, 1] = True
    held[x[:, 2] < 1e-9, 2] = True
    volume = mesh.nodal_volume(m)
    body = soft.SoftBody(
        m,
        dt=dt_s,
        element="standard",
        integrator=integrator,
        youngs_modulus=6e5,
        poissons_ratio=poissons_ratio,
        density=1000.0,
        gravity=(0.0, 0.0, 0.0),  # neutrally buoyant, as trimmed
        damping=soft.Damping(rayleigh_beta=5e-3),
        fixed=held,
        muscles=[t.muscle for t in tendons(m)],
        masses=soft.Masses(added_mass=torch.zeros_like(volume)),
        solver=soft.SolverOptions(rtol=rtol),
    )
    rail = torch.where(on_rail, volume, 0.0)
    edge = (x[:, 0] > -1e-9) & ((x[:, 1] - WIDTH / 2).abs() < 1e-9) & (x[:, 2] > WIDTH / 4)
    nodes = torch.nonzero(edge)[:, 0]
    nodes = nodes[x[nodes, 2].argsort()]
    along = x[nodes, 2].numpy()
    rows = [
        [np.interp(place, along, unit) for unit in np.eye(len(along))] for place in (MIDDLE, TIP)
    ]
    return Quarter(body, rail / rail.sum(), torch.tensor(rows, dtype=torch.float64), nodes)


def water(m: mesh.HexMesh | mesh.TetMesh, drag: Tensor, thrust: Tensor) -> soft.Hydrodynamics:
    """Water around the quarter: published coefficients times ``drag`` and ``thrust``.

    The force fades where a face turns edge-on; as published it jumps there, and slopes with it.

    Faces on the planes of symmetry meet no water; there the flow along them would be edge-on.
    """
    hydrodynamics = soft.Hydrodynamics(
        m,
        drag_coefficients=drag * torch.tensor(DRAG_COEFFICIENTS).double(),
        thrust_coefficients=thrust * torch.tensor(THRUST_COEFFICIENTS).double(),
        fade_angle=FADE_ANGLE,
    )
    inside = (m.x_rest[hydrodynamics.faces][..., 1:] < 1e-9).all(1).any(1)
    hydrodynamics.faces = hydrodynamics.faces[~inside]
    return hydrodynamics
