"""Values of signals on their way by compiled loops; see ``csrc/kernels/signals/follow.h``.

They know no derivatives: ``diffsim.causes.signals`` asks for them where nobody differentiates.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.compiled import core


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
    rows = _numbers(targets.expand(*lead, targets.shape[-1]))
    limits, speeds = (_numbers(number.expand(lead)) for number in (most, fastest))
    h, out, num_times = _numbers(steps), np.empty_like(rows), rows.shape[-1]
    if out.size:
        given = (numbers.ctypes.data for numbers in (rows, h, limits, speeds))
        core.approach(rows.size // num_times, num_times, *given, held, out.ctypes.data)
    return torch.from_numpy(out)


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
