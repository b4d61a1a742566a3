"""Which constant contractions of 16 muscle groups bring a soft cuboid's corner to a point?

Thesis 4.1.6, "Routing tendon", Fig. 4-12: a cuboid of 512 elements stuck to the ground by its
bottom face; its elements are grouped into 16 muscles along the height. Their stretches are constant
in time; after 1 s (100 steps of 10 ms) the corner opposite the clamped one should be at the
target, a point made by no known contraction.

    python examples/applications/routing_tendon.py  # diffsim examples run routing_tendon
"""

from __future__ import annotations

from diffsim.core.script import interruptible

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from examples.applications import Application, Parameters
from examples.applications.command import main

RTOL, MAX_EVALUATIONS = 1e-4, 60
SIDE, HEIGHT, DT, STEPS = 0.04, 0.16, 0.01, 100  # [m], [m], [s]
TARGET = (0.06, 0.05, 0.13)  # [m]; the corner rests at (0.02, 0.02, 0.16)
STRETCHES = (0.6, 1.4)  # of a muscle


def build(solver: soft.SolverOptions, quick: bool) -> Application:
    """The cuboid, 4 x 4 x 32 elements (quick: 2 x 2 x 16)."""
    across, along = (2, 16) if quick else (4, 32)
    shape = mesh.hex_box(
        cells=(across, across, along),
        size=(SIDE, SIDE, HEIGHT),
        origin=(-SIDE / 2, -SIDE / 2, 0.0),
    )
    body = soft.SoftBody(
        shape,
        dt=DT,
        element="standard",
        youngs_modulus=1e5,
        poissons_ratio=0.45,
        density=1070.0,
        gravity=(0.0, 0.0, 0.0),  # thesis Table 4.3
        fixed=shape.nodes_near_plane("z", 0.0),
        muscles=_muscles(shape),
        solver=solver,
    )
    corner = int((shape.x_rest - torch.tensor([SIDE / 2, SIDE / 2, HEIGHT])).norm(dim=1).argmin())
    target = torch.tensor(TARGET, dtype=torch.float64)
    steps = 25 if quick else STEPS

    def simulate(stretches: Tensor) -> Tensor:
        return soft.rollout(body, body.rest_state(), steps, activation=stretches).x

    def loss(_stretches: Tensor, x: Tensor) -> Tensor:
        return (x[-1, corner] - target).square().sum()

    def numbers(_values: np.ndarray, x: Tensor) -> Mapping[str, float]:
        return {"distance mm": 1e3 * float((x[-1, corner] - target).norm())}

    count = len(body.muscles.rest_activation)
    rng = np.random.default_rng(0)
    return Application(
        name="routing_tendon",
        title="A corner of a cuboid reaches a point",
        source="thesis Fig. 4-12",
        body=body,
        parameters=Parameters(
            names=tuple(f"stretch_{k}" for k in range(count)),
            lower=np.full(count, STRETCHES[0]),
            upper=np.full(count, STRETCHES[1]),
            first=rng.uniform(0.9, 1.1, count),
        ),
        simulate=simulate,
        loss=loss,
        numbers=numbers,
        targets={"target": TARGET},
    )


def _muscles(shape: mesh.HexMesh) -> list[soft.Muscle]:
    """Four columns in the corners by four heights."""
    center = shape.x_rest[shape.elements].mean(1)
    level = torch.clamp((center[:, 2] / HEIGHT * 4).long(), max=3)
    return [
        soft.Muscle(
            elements=torch.nonzero(
                (level == k) & (sx * center[:, 0] > 0) & (sy * center[:, 1] > 0)
            )[:, 0],
            direction=(0.0, 0.0, 1.0),
            stiffness=2e5,
        )
        for k in range(4)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]


if __name__ == "__main__":
    with interruptible():
        main(build, __doc__, rtol=RTOL, max_evaluations=MAX_EVALUATIONS)
