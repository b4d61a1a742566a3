"""The force of water on a surface and its derivatives as ops."""

from __future__ import annotations

import torch

from diffsim.core.check import require_indices
from diffsim.core.compiled import core
from diffsim.core.ops import Call, Op, array

INPUTS = {
    "x": array("batch", "num_nodes", 3),  # positions [m]
    "v": array("batch", "num_nodes", 3),  # velocities [m/s]
    "water": array("batch", 3),  # velocity of the water [m/s]
    "density": array(),  # [kg/m^3]
    "drag": array(4),  # ordinates of the curves of both coefficients [-]
    "thrust": array(4),
}


def _arrays(call: Call, prefix: str = "") -> object:
    return core.WaterArrays(**call.addresses(*INPUTS, prefix=prefix))


def _common(call: Call) -> dict[str, object]:
    """What all kernels take."""
    faces, num_nodes, corners = call["faces"], call.sizes["num_nodes"], call.sizes["corners"]
    if corners not in (3, 4):
        raise TypeError(f"faces must have 3 or 4 corners, got {corners}")
    require_indices("faces", faces, num_nodes, "nodes")
    surface = core.WaterFaces(
        nodes=faces.data_ptr(), num_faces=len(faces), corners=corners, num_nodes=num_nodes
    )
    options = {name: call.sizes[name] for name in ("fade_angle", "batch")}
    return {"faces": surface, "inputs": _arrays(call), **options}


def _force(call: Call) -> None:
    core.water_force(**_common(call), **call.addresses("force"))


def _adjoint(call: Call) -> None:
    grads = _arrays(call, "grad_")
    core.water_force_adjoint(**_common(call), **call.addresses("grad_force"), grads=grads)


def _tangent(call: Call) -> None:
    rate = call["d_force"].data_ptr()
    core.water_force_tangent(**_common(call), directions=_arrays(call, "d_"), rate=rate)


# csrc/kernels/soft/water_force.h; ``fade_angle`` is the angle of attack below which the force
# fades [rad], 0: it does not. Faces are nodes of each, outward.
water_force = Op(
    "water_force",
    inputs={**INPUTS, "faces": array("num_faces", "corners", dtype=torch.int64, smooth=False)},
    outputs={"force": array("batch", "num_nodes", 3)},
    options="float fade_angle",
    kernel=_force,
    adjoint=_adjoint,
    tangent=_tangent,
)
