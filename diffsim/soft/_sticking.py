"""Nodes that infinite friction holds although they are pulled off."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.errors import ContactWarning
from diffsim.core.record import warn


def report_pulling(normal: Tensor, friction: Tensor, force: Tensor, tolerance: Tensor) -> None:
    """Warn where an obstacle pulls.

    With infinite friction a touching node has no answer if it is pulled off where it sticks, and
    slides into the obstacle where it is let go (docs/contact.md). The solver holds it.

    Args:
        normal: Outward normals of the obstacles, (batch, num_contacts, 3) [-].
        friction: Coefficients, (batch, num_contacts) [-].
        force: Forces on the nodes, (batch, num_contacts, 3) [N].
        tolerance: Norm of the residual that the step had to reach, (batch,) [N].
    """
    endless = torch.isinf(friction)
    if not bool(endless.any()):
        return
    pressing = (normal * force).sum(-1)
    pulling = endless & (pressing < -tolerance[:, None])
    count = int(pulling.sum())
    if not count:
        return
    largest = -float(pressing[pulling].min())
    share = largest / max(float(pressing.max()), torch.finfo(torch.float64).tiny)
    warn(
        f"friction=inf holds {count} nodes that are pulled off, with up to {largest:.3g} N "
        f"({100.0 * share:.2g} % of the largest force that presses): let go they would slide into "
        "the obstacle; a finite friction, such as 2, has an answer",
        ContactWarning,
        stacklevel=3,
    )
