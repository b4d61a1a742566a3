"""A tendon-driven arm (thesis 4.1.6, "Routing tendon"): 4 x 4 x 32 cells, sixteen muscle groups."""

from __future__ import annotations

import torch

from diffsim import mesh, soft
from diffsim.core.checked import checked
from diffsim.systems.robots.robot import SoftRobot, element_centers, fibers


@checked
def tendon_arm(
    *,
    length: float = 0.4,
    coarse: bool = False,
    dt: float = 0.01,
    youngs_modulus: float = 1e5,
    amplitude: float = 0.15,
    gravity: float = 0.0,
    rtol: float = 1e-4,
) -> SoftRobot:
    """An upright bar whose foot is fixed; each quarter of its length has four muscles.

    A command of 1 shortens one corner of one quarter. Sensors are the middles
    of the quarters' upper faces; the last is the tip.

    Args:
        length: Height [m]; it is an eighth as wide.
        coarse: 2 x 2 x 16 cells, for quick trials.
        dt: Time step of the simulation [s].
        youngs_modulus: Young's modulus of the bar [Pa].
        amplitude: Largest contraction of a muscle [-].
        gravity: Downward [m/s^2]; none by default, as an arm this slender buckles at this modulus.
        rtol: Relative tolerance of a time step's solution [-].
    """
    wide, tall = (2, 16) if coarse else (4, 32)
    width = length / 8.0
    shape = mesh.hex_box(
        (wide, wide, tall), (width, width, length), (-0.5 * width, -0.5 * width, 0.0)
    )
    center = element_centers(shape)
    part = torch.floor(4.0 * center[:, 2] / length).long()
    muscles, names = [], []
    for k in range(4):
        for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
            corner = (part == k) & (sx * center[:, 0] > 0.0) & (sy * center[:, 1] > 0.0)
            muscles.append(fibers(corner, (0.0, 0.0, 1.0), 2.0 * youngs_modulus))
            names.append(f"shorten quarter {k} at corner {'-+'[sx > 0]}x{'-+'[sy > 0]}y")
    body = soft.SoftBody(
        shape,
        dt=dt,
        element="standard",
        youngs_modulus=youngs_modulus,
        poissons_ratio=0.4,
        density=1000.0,
        gravity=(0.0, 0.0, -gravity),
        fixed=torch.nonzero(shape.x_rest[:, 2] < 1e-9)[:, 0],
        muscles=muscles,
        solver=soft.SolverOptions(rtol=rtol),
    )
    x = shape.x_rest
    ends = [
        (x - torch.tensor([0.0, 0.0, q * length]).double()).norm(dim=1).argmin()
        for q in (0.25, 0.5, 0.75, 1.0)
    ]
    return SoftRobot(
        name="tendon arm",
        body=body,
        drive=-amplitude * torch.eye(16, dtype=torch.float64),
        command_names=tuple(names),
        sensors=torch.stack(ends),
        forward=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
    )
