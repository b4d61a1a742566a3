"""Distance along a normal that is held fixed: exact first derivatives by the envelope theorem."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class SignedDistance(torch.autograd.Function):
    """phi = n.(p - q), q the closest point of the interface and n its unit normal into the fluid.

    The closest point moves along the interface when p or the shape changes, but n is perpendicular
    to that motion (at a corner |p - q| is what it is), so with the foot's parameter fixed
    d phi = n.(dp - dq), q differentiated through the control points only. Second derivatives would
    need the curvature: they raise.
    """

    generate_vmap_rule = True  # jacfwd and jacrev map gradients and tangents, not the shape

    @staticmethod
    def forward(p: Tensor, q: Tensor, normal: Tensor) -> Tensor:
        return ((p - q) * normal).sum(-1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(inputs[2])

    @staticmethod
    def backward(ctx: Any, grad_phi: Tensor) -> tuple[Tensor, Tensor, None]:
        p, q, normal = ctx.saved_tensors
        along = grad_phi[:, None] * normal
        if torch.is_grad_enabled():
            along = _FirstOrder.apply(along, p, q)
        return along, -along, None

    @staticmethod
    def jvp(ctx: Any, dp: Tensor | None, dq: Tensor | None, _: Tensor | None) -> Tensor:
        (normal,) = ctx.saved_tensors
        zero = torch.zeros_like(normal)
        motion = (zero if dp is None else dp) - (zero if dq is None else dq)
        return (motion * normal).sum(-1)


_SECOND = (
    "second derivatives of this level set are not available; differentiate it once, "
    "without create_graph=True"
)


class _FirstOrder(torch.autograd.Function):
    """The identity; differentiating its gradient raises an error."""

    generate_vmap_rule = True

    @staticmethod
    def forward(along: Tensor, p: Tensor, q: Tensor) -> Tensor:
        return along.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raise RuntimeError(_SECOND)

    @staticmethod
    def jvp(ctx: Any, *_: Tensor | None) -> Tensor:
        raise RuntimeError(_SECOND)


def signed_distance(p: Tensor, q: Tensor, normal: Tensor) -> Tensor:
    """phi (N,) of points p (N, d) with feet q (N, d), normals (N, d) without gradient."""
    return SignedDistance.apply(p, q, normal.detach())
