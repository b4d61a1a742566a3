"""The force of water on a surface and its derivatives, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require_indices
from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_first_order, make_layer
from diffsim.soft._arrays import require_array

INPUTS = ("x", "v", "water", "density", "drag", "thrust")


def _addresses(tensors: Sequence[Tensor]) -> object:
    return core.WaterArrays(**{n: t.data_ptr() for n, t in zip(INPUTS, tensors, strict=True)})


def _call(faces: Tensor, tensors: Sequence[Tensor], fade_angle: float) -> dict[str, object]:
    """What all kernels take, from the tensors of ``INPUTS``."""
    batch, num_nodes = tensors[0].shape[:2]
    nodal = (batch, num_nodes, 3)
    shapes = (nodal, nodal, (batch, 3), (), (4,), (4,))
    for name, tensor, shape in zip(INPUTS, tensors, shapes, strict=True):
        require_array(name, tensor, shape)
    if (
        faces.dtype != torch.int64
        or not faces.is_contiguous()
        or faces.shape[1:] not in ((3,), (4,))
    ):
        raise TypeError(
            f"faces must be contiguous int64 of shape (num_faces, 3 or 4), got {faces.dtype} of "
            f"shape {tuple(faces.shape)}"
        )
    require_indices("faces", faces, num_nodes, "nodes")
    surface = core.WaterFaces(
        nodes=faces.data_ptr(),
        num_faces=faces.shape[0],
        corners=faces.shape[1],
        num_nodes=num_nodes,
    )
    return {
        "faces": surface,
        "inputs": _addresses(tensors),
        "fade_angle": fade_angle,
        "batch": batch,
    }


@custom_op("diffsim::water_force")
def water_force(
    x: Tensor,
    v: Tensor,
    water: Tensor,
    density: Tensor,
    drag: Tensor,
    thrust: Tensor,
    faces: Tensor,
    *,
    fade_angle: float,
) -> Tensor:
    """Forces of the water on the nodes; see csrc/kernels/soft/water_force.h.

    Args:
        x, v: Positions [m] and velocities [m/s], (batch, num_nodes, 3).
        water: Velocity of the water, (batch, 3) [m/s].
        density: Density of the water, () [kg/m^3].
        drag, thrust: Ordinates of the curves of both coefficients, (4,) [-].
        faces: Nodes of each face, outward, (num_faces, 3 or 4) int64.
        fade_angle: Angle of attack below which the force fades [rad]; 0: it does not.

    Returns:
        (batch, num_nodes, 3) [N].
    """
    force = torch.empty_like(x)
    call = _call(faces, (x, v, water, density, drag, thrust), fade_angle)
    core.water_force(**call, force=force.data_ptr())
    return force


@water_force.register_fake
def _(x, *_inputs, **_options):
    return torch.empty_like(x)


@custom_op("diffsim::water_force_vjp")
def water_force_vjp(
    grad: Tensor, inputs: list[Tensor], faces: Tensor, *, fade_angle: float
) -> list[Tensor]:
    """Adjoint of :func:`water_force`: gradients of ``INPUTS``."""
    grad = grad.contiguous()
    call = _call(faces, inputs, fade_angle)
    require_array("grad", grad, tuple(inputs[0].shape))
    grads = [torch.empty_like(tensor) for tensor in inputs]
    core.water_force_adjoint(**call, grad_force=grad.data_ptr(), grads=_addresses(grads))
    return grads


@water_force_vjp.register_fake
def _(grad, inputs, faces, **_options):
    return [torch.empty_like(tensor) for tensor in inputs]


@custom_op("diffsim::water_force_jvp")
def water_force_jvp(
    inputs: list[Tensor], directions: list[Tensor], faces: Tensor, *, fade_angle: float
) -> Tensor:
    """:func:`water_force` along one direction of all ``INPUTS``."""
    call = _call(faces, inputs, fade_angle)
    moved = [direction.contiguous() for direction in directions]
    for name, direction, tensor in zip(INPUTS, moved, inputs, strict=True):
        require_array(f"direction of {name}", direction, tuple(tensor.shape))
    rate = torch.empty_like(inputs[0])
    core.water_force_tangent(**call, directions=_addresses(moved), rate=rate.data_ptr())
    return rate


@water_force_jvp.register_fake
def _(inputs, directions, faces, **_options):
    return torch.empty_like(inputs[0])


def _setup(ctx, inputs, keyword_only_inputs, output):
    ctx.arguments = keyword_only_inputs
    ctx.save_for_backward(*inputs)


def _backward(ctx, grad):
    *inputs, faces = ctx.saved_tensors
    return *water_force_vjp_layer(grad, inputs, faces, **ctx.arguments), None


def _tangent(ctx, *moved):
    *inputs, faces = ctx.saved_tensors
    directions = directions_of(dict(zip(INPUTS, inputs, strict=True)), moved[: len(INPUTS)])
    return water_force_jvp_layer(inputs, list(directions.values()), faces, **ctx.arguments)


water_force_vjp_layer = make_first_order(water_force_vjp)
water_force_jvp_layer = make_first_order(water_force_jvp)
water_force_layer = make_layer(water_force, setup=_setup, backward=_backward, tangent=_tangent)
