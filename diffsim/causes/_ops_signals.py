"""Values of signals on their way by compiled loops; see ``csrc/kernels/signals``.

``follow`` and ``find_intervals`` know no derivatives: ``diffsim.causes.signals`` asks for them
where nobody differentiates.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array

_PARTS = 16  # of a step, in which what accelerates goes on; kParts of the kernel


def follow(how: Literal["play", "slowed"], targets: Tensor, room: Tensor, start: Tensor) -> Tensor:
    """State after each time of what follows a signal, (..., num_times).

    Args:
        how: "play" rests until the target is farther away than ``room``; "slowed" goes to it by at
            most ``room`` from one time to the next.
        targets: Signal that is followed, (..., num_times).
        room: Half of the gap or the longest way, (..., num_times - 1) or (..., 1).
        start: State at the first time, (...); leading axes broadcast.
    """
    lead = np.broadcast_shapes(targets.shape[:-1], room.shape[:-1], start.shape)
    rows = _numbers(targets.expand(*lead, targets.shape[-1]))
    rooms = _numbers(room.expand(*lead, room.shape[-1]))
    states = np.empty_like(rows)
    if states.size == 0:
        return torch.from_numpy(states)
    states[..., 0] = start.expand(lead).numpy()
    num_times = rows.shape[-1]
    sizes = rows.size // num_times, num_times
    given = rows.ctypes.data, rooms.ctypes.data, rooms.shape[-1]
    core.follow(how == "play", *sizes, *given, states.ctypes.data)
    return torch.from_numpy(states)


def _sizes(call: Call) -> dict[str, Any]:
    num_rows, num_times = call["targets"].shape
    return {"num_rows": num_rows, "num_times": num_times, "held": call.options["held"]}


def _accelerate(given: Given) -> Tensor:
    """``approach`` in PyTorch's own operations, for derivatives of derivatives."""
    most, fastest, targets = given["most"], given["fastest"], given["targets"].unbind(-1)
    place, speed = targets[0], torch.zeros_like(targets[0])
    out = [place]
    for k, step in enumerate(given["steps"]):
        h, change = step / _PARTS, most * (step / _PARTS)
        for i in range(1, _PARTS + 1):
            way = 0.0 if given["held"] else (targets[k + 1] - targets[k]) * (i / _PARTS)
            away = targets[k] + way - place
            root = (2.0 * most * away.abs() + 0.25 * change * change).sqrt()
            least = torch.minimum(torch.minimum(root - 0.5 * change, away.abs() / h), fastest)
            wanted = away.sign() * least
            speed = torch.minimum(torch.maximum(wanted, speed - change), speed + change)
            place = place + speed * h
        out.append(place)
    return torch.stack(out, -1)


_approach = Op(  # csrc/kernels/signals/approach.h
    "approach",
    inputs={
        "targets": array("num_rows", "num_times"),
        "steps": array("num_steps", smooth=False),
        "most": array("num_rows"),
        "fastest": array("num_rows"),
    },
    outputs={"places": array("num_rows", "num_times")},
    options="bool held",
    kernel=lambda call: core.approach(**_sizes(call), **call.addresses()),
    adjoint=lambda call: core.approach_vjp(**_sizes(call), **call.addresses()),
    tangent=lambda call: core.approach_tangent(**_sizes(call), **call.addresses()),
    in_torch=lambda given: (_accelerate(given),),
)


def approach(
    targets: Tensor, steps: Tensor, most: Tensor, fastest: Tensor, *, held: bool
) -> Tensor:
    """What goes to a signal with its acceleration limited, from rest, (..., num_times).

    Args:
        targets: Signal that is followed, (..., num_times).
        steps: Time between two times, (num_times - 1,) [s].
        most: Largest acceleration, (...); leading axes broadcast.
        fastest: Largest speed, (...).
        held: Whether each target lasts until the next time.
    """
    lead = np.broadcast_shapes(targets.shape[:-1], most.shape, fastest.shape)
    rows = targets.expand(*lead, targets.shape[-1]).reshape(-1, targets.shape[-1])
    limits, speeds = (n.double().expand(lead).reshape(-1) for n in (most, fastest))
    return _approach(rows, steps, limits, speeds, held).reshape(*lead, targets.shape[-1])


def find_intervals(times: Tensor, places: Tensor, *, of_equal: Literal["left", "right"]) -> Tensor:
    """Index of the interval of times that holds each place, 0 to num_times - 2.

    Args:
        times: (num_times,) increasing, two at least.
        places: Any shape; quick where they go along with the times.
        of_equal: Whether a place that is a time belongs to the interval to its left or right.
    """
    t, wanted = _numbers(times), _numbers(places)
    found = np.empty(wanted.shape, dtype=np.int64)
    given = t.ctypes.data, wanted.size, wanted.ctypes.data
    core.find_intervals(len(t), *given, of_equal == "right", found.ctypes.data)
    return torch.from_numpy(found)


def _numbers(values: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(values.numpy(), dtype=np.float64)
