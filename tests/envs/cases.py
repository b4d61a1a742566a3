"""Small versions of all environments, and a robot of a few nodes."""

from typing import Any

import torch

from diffsim import mesh, soft
from diffsim.contact import floor
from diffsim.systems.robots import SoftRobot

COARSE = {"robot": {"coarse": True}}
OPTIONS: dict[str, dict[str, Any]] = {
    "CopterHover": {"seconds": 0.12},
    "CopterTrack": {"seconds": 0.12},
    "StarfishSwim": {**COARSE, "num_steps": 6},
    "SharkSwim": {**COARSE, "num_steps": 6},
    "QuadrupedWalk": {**COARSE, "num_steps": 6},
    "CowWalk": {**COARSE, "num_steps": 6, "substeps": 2},
    "TorusRoll": {**COARSE, "num_steps": 6, "substeps": 2},
    "TendonReach": {**COARSE, "num_steps": 6},
    "SoftJumper": {**COARSE, "num_steps": 6},
}
STEPS = 6
FLOOR = ("QuadrupedWalk", "CowWalk", "TorusRoll")


def block(*, water: bool = False, on_floor: bool = False, rtol: float = 1e-12) -> SoftRobot:
    """Two cubes with a muscle and a stretcher along x: 36 degrees of freedom."""
    shape = mesh.hex_box((2, 1, 1), (0.2, 0.1, 0.1))
    body = soft.SoftBody(
        shape,
        dt=0.01,
        youngs_modulus=1e5,
        poissons_ratio=0.3,
        gravity=(0.0, 0.0, -9.81 if on_floor else 0.0),
        muscles=[
            soft.Muscle(elements=torch.tensor([k]), direction=(1.0, 0.0, 0.0), stiffness=1e5)
            for k in (0, 1)
        ],
        solver=soft.SolverOptions(rtol=rtol),
    )
    return SoftRobot(
        name="block",
        body=body,
        drive=torch.tensor([[-0.2, 0.2]], dtype=torch.float64),
        command_names=("shorten the back, stretch the front",),
        sensors=torch.tensor([0, 11]),
        forward=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
        water=soft.Hydrodynamics(shape).requires_grad_(False) if water else None,
        obstacles=(floor(friction=0.5),) if on_floor else (),
        upright_axis=2 if on_floor else None,
    )
