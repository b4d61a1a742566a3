"""Nodes that infinite friction would hold although they are pulled off: they slide."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from diffsim.core.errors import ContactWarning
from diffsim.core.record import warn
from diffsim.soft._arrays import ContactArrays

SLIDING_FRICTION = 5.0
"""Coefficient of a node that infinite friction would have to pull [-]; see docs/contact.md."""
_SLIP = 2


def let_slide(planes: ContactArrays, force: Tensor, tolerance: Tensor) -> ContactArrays | None:
    """Half spaces to solve a step with once more, because an obstacle pulls; None: none does.

    With infinite friction a touching node may have no answer: it is pulled off where it sticks,
    and slides into the obstacle where it is let go. A finite coefficient always has an answer.

    Args:
        planes: Half spaces that the step was solved with.
        force: Forces on the nodes, (batch, num_contacts, 3) [N].
        tolerance: Norm of the residual that the step had to reach, (batch,) [N].
    """
    endless = torch.isinf(planes.friction)
    if not bool(endless.any()):
        return None
    pressing = (planes.normal * force).sum(-1)
    pulling = endless & (pressing < -tolerance[:, None])
    count = int(pulling.sum())
    if not count:
        return None
    warn(
        f"friction=inf leaves {count} nodes without an answer: stuck they are pulled off, let go "
        f"they slide into the obstacle; they have friction {SLIDING_FRICTION:g} in this step",
        ContactWarning,
        stacklevel=3,
    )
    friction = torch.where(pulling, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)


def as_solved(planes: ContactArrays, status: Tensor) -> ContactArrays:
    """Half spaces of a solved step: what slides has no infinite friction (:func:`let_slide`)."""
    sliding = torch.isinf(planes.friction) & (status == _SLIP)
    if not bool(sliding.any()):
        return planes
    friction = torch.where(sliding, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)
