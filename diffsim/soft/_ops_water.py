"""The force of water on a surface and its derivatives as ops."""

from __future__ import annotations

import torch
from torch import Tensor

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


class BoundWater:
    """The force on one surface, checked and handed to the kernels once, past PyTorch.

    Args:
        faces: Nodes of each face, (num_faces, 3 or 4) int64, outward.
        num_nodes: Nodes of the mesh.
        fade_angle: As ``Hydrodynamics`` has it [rad].
        density, drag, thrust: Of the water, (), (4,), (4,), contiguous.
    """

    def __init__(
        self,
        faces: Tensor,
        num_nodes: int,
        fade_angle: float,
        *,
        density: Tensor,
        drag: Tensor,
        thrust: Tensor,
    ):
        self._surface, self._held = _surface(faces, num_nodes), faces
        self.fade_angle = fade_angle
        self._constants = {"density": density, "drag": drag, "thrust": thrust}

    def force(self, x: Tensor, v: Tensor, water: Tensor) -> Tensor:
        """Forces (batch, num_nodes, 3) [N]; contiguous x, v of that shape, water (batch, 3)."""
        force = torch.empty_like(x)
        core.water_force(**self._common(x, v, water), force=force.data_ptr())
        return force

    def adjoint(
        self, x: Tensor, v: Tensor, water: Tensor, grad_force: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gradients of x and v from that of the forces, contiguous (batch, num_nodes, 3)."""
        grads = {
            "x": torch.empty_like(x),
            "v": torch.empty_like(v),
            "water": torch.empty_like(water),
        }
        grads |= {name: torch.empty_like(value) for name, value in self._constants.items()}
        core.water_force_adjoint(
            **self._common(x, v, water),
            grad_force=grad_force.data_ptr(),
            grads=core.WaterArrays(**{name: grad.data_ptr() for name, grad in grads.items()}),
        )
        return grads["x"], grads["v"]

    def _common(self, x: Tensor, v: Tensor, water: Tensor) -> dict[str, object]:
        tensors = {"x": x, "v": v, "water": water, **self._constants}
        return {
            "faces": self._surface,
            "inputs": core.WaterArrays(**{n: tensor.data_ptr() for n, tensor in tensors.items()}),
            "fade_angle": self.fade_angle,
            "batch": len(x),
        }


def _surface(faces: Tensor, num_nodes: int) -> object:
    """Faces as kernels read them, checked."""
    corners = faces.shape[1]
    if corners not in (3, 4):
        raise TypeError(f"faces must have 3 or 4 corners, got {corners}")
    require_indices("faces", faces, num_nodes, "nodes")
    return core.WaterFaces(
        nodes=faces.data_ptr(), num_faces=len(faces), corners=corners, num_nodes=num_nodes
    )


def _arrays(call: Call, prefix: str = "") -> object:
    return core.WaterArrays(**call.addresses(*INPUTS, prefix=prefix))


def _common(call: Call) -> dict[str, object]:
    """What all kernels take."""
    surface = _surface(call["faces"], call.sizes["num_nodes"])
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
