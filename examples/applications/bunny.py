"""How must a soft bunny be thrown to the floor so that it bounces to a point?

Thesis 4.1.6, "Bunny", Fig. 4-11: orientation, position and velocity at the start (nine numbers
within bounds) so that the center of mass is at a target after 100 steps of 1 ms. Contact is
complementarity; what touches, sticks, as in the thesis. Ours is a bunny of ellipsoids, 1,538
hexahedra and 6,795 DoF (thesis: a Stanford bunny, 1,601 and 7,062). The target was made by no
known throw: without the floor it lies out of reach, since all throws go down at 3 m/s at least.
The first guess is thrown away from it. How near other throws come: `studies.bunny_starts`.

    python examples/applications/bunny.py  # diffsim examples run bunny --quick
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.mesh.sdf import ellipsoid, rotate, smooth_union, translate
from examples.applications import Application, Parameters
from examples.applications.command import main

RTOL, MAX_EVALUATIONS = 1e-4, 40
DT, STEPS = 0.001, 100  # [s]
TARGET = (0.15, 0.15, 0.15)  # [m]
NAMES = ("roll", "pitch", "yaw", "x", "y", "z", "vx", "vy", "vz")  # [rad], [m], [m/s]
LOWER = (-math.pi / 3,) * 3 + (-0.01, -0.01, 0.19, -1.5, -1.5, -5.0)
UPPER = (math.pi / 3,) * 3 + (0.01, 0.01, 0.21, 1.5, 1.5, -3.0)
FIRST = (0.3, -0.3, 0.5, 0.0, 0.0, 0.2, -0.8, -0.6, -4.0)


def build(solver: soft.SolverOptions, quick: bool, refine: int = 1, cells: int = 1) -> Application:
    """The bunny in cells of 5.2 mm (quick: 10 mm, 50 steps of 2 ms).

    ``refine`` time steps are made of one, and cells are so many times smaller, to see what they do.
    """
    steps, dt = (STEPS // 2, 2 * DT) if quick else (STEPS, DT)
    steps, dt = steps * refine, dt / refine
    body = soft.SoftBody(
        bunny((0.010 if quick else 0.0052) / cells),
        dt=dt,
        element="standard",
        youngs_modulus=1e6,
        poissons_ratio=0.45,
        density=1000.0,
        solver=solver,
    )
    ground = (contact.floor(friction=math.inf),)
    target = torch.tensor(TARGET, dtype=torch.float64)
    share = body.physics().mass / body.physics().mass.sum()
    arm = body.x_rest - share @ body.x_rest

    def simulate(throw: Tensor) -> Tensor:
        x = arm @ rotation(throw[:3]).T + throw[3:6]
        start = soft.State(x, throw[6:].expand_as(x).contiguous())
        return soft.rollout(body, start, steps, obstacles=ground).x

    def center(x: Tensor) -> Tensor:
        return share @ x

    def loss(_throw: Tensor, x: Tensor) -> Tensor:
        return (center(x[-1]) - target).square().sum()

    def numbers(_throw: np.ndarray, x: Tensor) -> Mapping[str, float]:
        return {"distance mm": 1e3 * float((center(x[-1]) - target).norm())}

    return Application(
        name="bunny",
        title="A thrown bunny bounces to a point",
        source="thesis Fig. 4-11",
        body=body,
        parameters=Parameters(
            names=NAMES, lower=np.array(LOWER), upper=np.array(UPPER), first=np.array(FIRST)
        ),
        simulate=simulate,
        loss=loss,
        numbers=numbers,
        obstacles=ground,
        follow=center,
        targets={"target": TARGET},
    )


def rotation(angles: Tensor) -> Tensor:
    """Rz(yaw) Ry(pitch) Rx(roll) of (roll, pitch, yaw) [rad]."""
    c, s = torch.cos(angles), torch.sin(angles)
    zero, one = torch.zeros_like(c[0]), torch.ones_like(c[0])
    about_x = torch.stack([one, zero, zero, zero, c[0], -s[0], zero, s[0], c[0]]).reshape(3, 3)
    about_y = torch.stack([c[1], zero, s[1], zero, one, zero, -s[1], zero, c[1]]).reshape(3, 3)
    about_z = torch.stack([c[2], -s[2], zero, s[2], c[2], zero, zero, zero, one]).reshape(3, 3)
    return about_z @ about_y @ about_x


def bunny(spacing: float) -> mesh.HexMesh:
    """A bunny, 11 cm tall, that looks along +x, in cubes of ``spacing`` [m]."""
    body = ellipsoid((0.036, 0.026, 0.030), (-0.010, 0.0, 0.030))  # haunches
    body = smooth_union(body, ellipsoid((0.024, 0.020, 0.026), (0.016, 0.0, 0.032)), 0.020)  # chest
    body = smooth_union(body, ellipsoid((0.022, 0.017, 0.018), (0.034, 0.0, 0.062)), 0.012)  # head
    body = smooth_union(body, ellipsoid((0.011,) * 3, (-0.046, 0.0, 0.026)), 0.006)  # tail
    ear = rotate(ellipsoid((0.0085, 0.006, 0.026)), (0.0, 1.0, 0.0), -0.55)
    for side in (-1.0, 1.0):
        body = smooth_union(body, translate(ear, (0.014, side * 0.010, 0.092)), 0.006)
        hind = ellipsoid((0.018, 0.009, 0.009), (-0.004, side * 0.022, 0.008))
        fore = ellipsoid((0.012, 0.0075, 0.007), (0.034, side * 0.011, 0.006))
        body = smooth_union(smooth_union(body, hind, 0.006), fore, 0.006)
    return mesh.hex_from_sdf(body, ((-0.065, -0.045, 0.0), (0.065, 0.045, 0.13)), spacing)


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS)
