"""Steps that infinite friction leaves without an answer: its nodes may slide in them."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from diffsim.core.errors import ContactWarning
from diffsim.core.record import warn
from diffsim.soft._arrays import ContactArrays

SLIDING_FRICTION = 2.0
"""Coefficient in a step that infinite friction leaves without an answer [-]: in 300 landings no
such step failed with 1 to 3, with 5 two of 406."""
_SLIP = 2


def let_slide(planes: ContactArrays, force: Tensor, tolerance: Tensor) -> ContactArrays | None:
    """Half spaces to solve a step with once more, because an obstacle pulls; None: none does.

    With infinite friction a touching node may have no answer: it is pulled off where it sticks,
    and slides into the obstacle where it is let go. A finite coefficient always has an answer. All
    such contacts of the body take it: beside one that cannot slide there may again be none.

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
        f"they slide into the obstacle; this step is solved with friction {SLIDING_FRICTION:g}",
        ContactWarning,
        stacklevel=3,
    )
    again = endless & pulling.any(-1, keepdim=True)
    friction = torch.where(again, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)


def without_endless(planes: ContactArrays, by_friction: Tensor) -> Tensor:
    """Derivatives by friction, or its directions: zero where the coefficient is infinite."""
    return by_friction.masked_fill(torch.isinf(planes.friction), 0.0)


def as_solved(planes: ContactArrays, status: Tensor) -> ContactArrays:
    """Half spaces of a solved step: what slides has no infinite friction (:func:`let_slide`)."""
    sliding = torch.isinf(planes.friction) & (status == _SLIP)
    if not bool(sliding.any()):
        return planes
    friction = torch.where(sliding, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)
