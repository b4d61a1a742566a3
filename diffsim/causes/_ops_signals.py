"""Signals on their way as ops; see ``csrc/kernels/signals/follow.h``."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array

RULES = ("play", "slowed", "decays")
"""How a state keeps to its target, in the order of the kernel."""
PARTS: int = core.APPROACH_PARTS
"""Of a step, in which what accelerates goes on."""


def follow(
    how: Literal["play", "slowed", "decays"], targets: Tensor, room: Tensor, start: Tensor
) -> Tensor:
    """State after each time of what follows a signal, (..., num_times).

    Args:
        how: "play" rests until the target is farther away than ``room``; "slowed" goes to it by at
            most ``room`` from one time to the next; "decays" keeps the share ``room`` of what it
            was and adds the target.
        targets: Signal that is followed, (..., num_times).
        room: Half of the gap, the longest way or the share, (..., num_times - 1) or (..., 1).
        start: State at the first time, (...); leading axes broadcast.
    """
    lead = np.broadcast_shapes(targets.shape[:-1], room.shape[:-1], start.shape)
    u, rooms = _rows(targets, lead), _rows(room, lead)
    states = _follow(u, rooms, start.expand(lead).reshape(-1), RULES.index(how))
    return states.view(*lead, targets.shape[-1])


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
    numbers = (number.expand(lead).reshape(-1) for number in (most, fastest))
    return _approach(_rows(targets, lead), steps, *numbers, held).view(*lead, targets.shape[-1])


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


def read_lines(
    values: Tensor, times: Tensor, places: Tensor, *, both_sides: bool = False
) -> Tensor:
    """Straight lines through values, read anywhere; the first and last go on beyond the ends.

    Args:
        values: (..., num_times).
        times: (num_times,) increasing, two at least.
        places: (..., num_places); leading axes broadcast; quick where they go along with the times.
        both_sides: Whether the slope at a time is the mean of both sides, not that before it.

    Returns:
        (..., num_places).
    """
    lead = np.broadcast_shapes(values.shape[:-1], places.shape[:-1])
    alone = [math.prod(given.shape[:-1]) == 1 for given in (values, places)]
    rows = [
        _rows(given, (1,) * len(lead) if is_one else lead)
        for given, is_one in zip((values, places), alone, strict=True)
    ]
    found = _read_lines(rows[0], times.contiguous(), rows[1], both_sides)
    return found.view(*lead, places.shape[-1])


def _numbers(values: Tensor) -> Array:
    return np.ascontiguousarray(values.numpy(), dtype=np.float64)


def _rows(values: Tensor, lead: tuple[int, ...]) -> Tensor:
    return values.expand(*lead, values.shape[-1]).reshape(math.prod(lead), values.shape[-1])


def _kernel_of(kernel: str, describe: Callable[[Call], Any], *names: str) -> Callable[[Call], None]:
    """A kernel of what a call describes, and of its tensors of these names."""

    def run(call: Call) -> None:
        getattr(core, kernel)(describe(call), *call.addresses(*names).values())

    return run


def _followers(call: Call) -> Any:
    sizes = {name: call.sizes[name] for name in ("num_rows", "num_times", "num_rooms", "how")}
    return core.Followers(**sizes, **call.addresses("targets", "room"))


def _follow_rows(call: Call) -> None:
    call["states"][:, 0] = call["start"]
    _fill_states(call)


def _push_followed(call: Call) -> None:
    call["d_states"][:, 0] = call["d_start"]
    _fill_directions(call)


_fill_states = _kernel_of("follow", _followers, "states")
_fill_directions = _kernel_of(
    "follow_tangent", _followers, "states", "d_targets", "d_room", "d_states"
)
_pull_followed = _kernel_of(
    "follow_vjp", _followers, "states", "grad_states", "grad_targets", "grad_room", "grad_start"
)


def _follow_in_torch(given: Given) -> tuple[Tensor, ...]:
    """``follow`` by PyTorch's own operations."""
    now, targets, rule = given["start"], given["targets"], RULES[given["how"]]
    rooms = given["room"].expand(len(targets), targets.shape[-1] - 1)
    out = [now]
    for target, room in zip(targets.unbind(-1)[1:], rooms.unbind(-1), strict=True):
        if rule == "decays":
            now = room * now + target
        elif rule == "play":
            now = _clip(now, target - room, target + room)
        else:
            now = _clip(target, now - room, now + room)
        out.append(now)
    return (torch.stack(out, -1),)


def _clip(value: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(value, low), high)


_follow = Op(
    "follow",
    inputs={
        "targets": array("num_rows", "num_times"),
        "room": array("num_rows", "num_rooms"),
        "start": array("num_rows"),
    },
    outputs={"states": array("num_rows", "num_times")},
    options="int how",
    reads=("targets", "room", "start", "states"),
    kernel=_follow_rows,
    adjoint=_pull_followed,
    tangent=_push_followed,
    in_torch=_follow_in_torch,
)


def _describe_approach(call: Call) -> Any:
    sizes = {name: call.sizes[name] for name in ("num_rows", "num_times", "held")}
    return core.Approach(**sizes, **call.addresses("targets", "steps", "most", "fastest"))


def _approach_in_torch(given: Given) -> tuple[Tensor, ...]:
    """``approach`` by PyTorch's own operations."""
    targets, most, fastest = given["targets"].unbind(-1), given["most"], given["fastest"]
    place, speed = targets[0], torch.zeros_like(targets[0])
    out = [place]
    for k, step in enumerate(given["steps"]):
        h, change = step / PARTS, most * (step / PARTS)
        for i in range(1, PARTS + 1):
            way = 0.0 if given["held"] else (targets[k + 1] - targets[k]) * (i / PARTS)
            away = targets[k] + way - place
            straight = away / h
            # speed from which it stops there in whole parts
            stopping = (2.0 * most * away.abs() + 0.25 * change * change).sqrt() - 0.5 * change
            wish = torch.where(straight.abs() <= stopping, straight, away.sign() * stopping)
            wanted = _clip(wish, -fastest, fastest)
            speed = _clip(wanted, speed - change, speed + change)
            place = place + speed * h
        out.append(place)
    return (torch.stack(out, -1),)


_approach = Op(
    "approach",
    inputs={
        "targets": array("num_rows", "num_times"),
        "steps": array("num_steps", smooth=False),
        "most": array("num_rows"),
        "fastest": array("num_rows"),
    },
    outputs={"places": array("num_rows", "num_times")},
    options="bool held",
    kernel=_kernel_of("approach", _describe_approach, "places"),
    adjoint=_kernel_of(
        "approach_vjp",
        _describe_approach,
        *("grad_places", "grad_targets", "grad_most", "grad_fastest"),
    ),
    tangent=_kernel_of(
        "approach_tangent", _describe_approach, "d_targets", "d_most", "d_fastest", "d_places"
    ),
    in_torch=_approach_in_torch,
)


def _describe_lines(call: Call) -> Any:
    names = ("num_rows", "num_times", "num_places", "num_signals", "num_ways", "both_sides")
    sizes = {name: call.sizes[name] for name in names}
    return core.Lines(**sizes, **call.addresses("values", "times", "places"))


def _count_rows(call: Call) -> dict[str, int]:
    counts = {len(call["values"]), len(call["places"])}
    if len(counts | {1}) > 2:
        raise ValueError(f"values and places must have as many rows, or one: got {counts}")
    return {"num_rows": max(counts)}


def _read_in_torch(given: Given) -> tuple[Tensor, ...]:
    """``read_lines`` by PyTorch's own operations."""
    values, times, places = given["values"], given["times"], given["places"]
    rows = max(len(values), len(places))
    values, places = values.expand(rows, -1), places.expand(rows, -1).contiguous()

    def line(right: bool) -> Tensor:
        left = (torch.searchsorted(times, places.detach(), right=right) - 1).clamp(
            0, len(times) - 2
        )
        share = (places - times[left]) / (times[left + 1] - times[left])
        low = values.gather(-1, left)
        return low + share * (values.gather(-1, left + 1) - low)

    below = line(False)
    return (0.5 * (below + line(True)) if given["both_sides"] else below,)


_read_lines = Op(
    "read_lines",
    inputs={
        "values": array("num_signals", "num_times"),
        "times": array("num_times", smooth=False),
        "places": array("num_ways", "num_places"),
    },
    outputs={"readings": array("num_rows", "num_places")},
    options="bool both_sides",
    sizes=_count_rows,
    kernel=_kernel_of("read_lines", _describe_lines, "readings"),
    adjoint=_kernel_of(
        "read_lines_vjp", _describe_lines, "grad_readings", "grad_values", "grad_places"
    ),
    tangent=_kernel_of("read_lines_tangent", _describe_lines, "d_values", "d_places", "d_readings"),
    in_torch=_read_in_torch,
)
