"""Values of signals on their way by compiled loops; see ``csrc/kernels/signals/follow.h``.

Only ``approach`` knows derivatives: ``diffsim.causes.signals`` asks for the others where nobody
differentiates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

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
    """What goes to a signal with its acceleration limited, from rest, (..., num_times); with first
    derivatives.

    Args:
        targets: Signal that is followed, (..., num_times).
        steps: Time between two times, (num_times - 1,) [s].
        most: Largest acceleration, (...); leading axes broadcast.
        fastest: Largest speed, (...).
        held: Whether each target lasts until the next time.
    """
    lead = np.broadcast_shapes(targets.shape[:-1], most.shape, fastest.shape)
    rows = targets.expand(*lead, targets.shape[-1])
    place: Tensor = _Approach.apply(rows, most.expand(lead), fastest.expand(lead), steps, held)
    return place


class _Approach(Function):
    @staticmethod
    def forward(
        ctx: Any, targets: Tensor, most: Tensor, fastest: Tensor, steps: Tensor, held: bool
    ) -> Tensor:
        given = [_numbers(signal) for signal in (targets, steps, most, fastest)]
        ctx.given, ctx.held = given, held
        out = np.empty_like(given[0])
        if out.size:
            core.approach(*_Approach.sizes(out), *_addresses(given), held, out.ctypes.data)
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, slope: Tensor
    ) -> tuple[Tensor | None, Tensor | None, Tensor | None, None, None]:
        rows, _, most, fastest = ctx.given
        found = [np.zeros_like(signal) for signal in (rows, most, fastest)]
        if rows.size:
            seen = _numbers(slope)
            given = *_addresses(ctx.given), ctx.held, *_addresses([seen, *found])
            core.approach_adjoint(*_Approach.sizes(rows), *given)
        of_rows, of_most, of_fastest = (torch.from_numpy(values) for values in found)
        return of_rows, of_most, of_fastest, None, None

    @staticmethod
    def sizes(rows: NDArray[np.float64]) -> tuple[int, int]:
        """Number of rows, and of times."""
        return rows.size // rows.shape[-1], rows.shape[-1]


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
    return np.ascontiguousarray(values.detach().numpy(), dtype=np.float64)


def _addresses(arrays: Sequence[NDArray[np.float64]]) -> list[int]:
    return [array.ctypes.data for array in arrays]
