"""What happens to signals on their way, commands and readings alike: the one home of such maps.

Signals are (..., num_times), at the times of a grid that need not be evenly spaced. All changes are
the identity at size 0. Many sizes at once, (K,), give (K, num_times).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from diffsim.causes._ops_signals import approach, find_intervals, follow, read_lines
from diffsim.core.arrays import Array, IntArray

SHORTEST_LAG = 1e-3  # of the shortest step: below it exp(-dt / tau) is zero to the last digit
_SPRINT = 1e12  # unit/s^2: an acceleration above it is no limit
MOST_STEPS = 1e9  # of a run


@dataclass(frozen=True, eq=False)
class Grid:
    """Times of the integrator in a run.

    Attributes:
        times: (num_times,) increasing [s].
        samples: (num_samples,) indices of the times at which something was measured.
        seconds: (num_samples,) the run's own times [s].
    """

    times: Tensor
    samples: Tensor
    seconds: Array

    @classmethod
    def of(cls, seconds: Array, step: float) -> Grid:
        """Samples with as many equal steps between two of them that none is longer than ``step``.

        Args:
            seconds: (num_samples,) times of the samples [s].
            step: Longest step of the integrator [s].

        Raises:
            ValueError: steps without end.
        """
        gaps = np.diff(seconds)
        needed = np.maximum(np.ceil(gaps / step - 1e-6), 1.0)
        if not needed.sum() < MOST_STEPS:
            raise ValueError(
                f"{gaps.max():g} s lie between two samples: {needed.max():.3g} steps of {step:g} "
                f"s, where a run may have {MOST_STEPS:g}"
            )
        counts = needed.astype(int)
        samples = np.concatenate([[0], np.cumsum(counts)])
        at = np.arange(samples[-1]) - np.repeat(samples[:-1], counts)
        parts = np.repeat(seconds[:-1], counts) + np.repeat(gaps, counts) * at / np.repeat(
            counts, counts
        )
        times = np.concatenate([parts, seconds[-1:]])
        times[samples] = seconds
        return cls(torch.from_numpy(times), torch.from_numpy(samples), seconds)

    @classmethod
    def even(cls, num_times: int, dt: float) -> Grid:
        """Samples every ``dt`` [s] and nothing in between."""
        return _space_evenly(num_times, dt)

    @property
    def since_start(self) -> Tensor:
        """Time since the run's first sample; 0 before it, where a grid begins earlier [s]."""
        return (self.times - float(self.seconds[0])).clamp(min=0.0)

    def resampled(self, values: Array | Tensor, *, held: bool) -> Tensor:
        """Values at the samples, (..., num_samples), at the times of the integrator.

        Gradient: values, where they are a tensor.
        """
        if isinstance(values, Tensor):
            return self._read_tensor(values, held)
        if held:
            return torch.from_numpy(np.ascontiguousarray(values[self._last_sample]))
        return torch.from_numpy(np.interp(self.times.numpy(), self.seconds, values))

    @cached_property
    def _last_sample(self) -> IntArray:
        """Index of the sample at or before each time."""
        return np.searchsorted(self.seconds, self.times.numpy(), side="right") - 1

    def _read_tensor(self, values: Tensor, held: bool) -> Tensor:
        left = torch.from_numpy(self._last_sample)
        if held:
            return values[..., left]
        left = left.clamp(max=max(len(self.seconds) - 2, 0))
        right = (left + 1).clamp(max=len(self.seconds) - 1)
        seconds = torch.from_numpy(self.seconds)
        gap = (seconds[right] - seconds[left]).clamp(min=torch.finfo(torch.float64).tiny)
        share = (self.times - seconds[left]) / gap
        return values[..., left] + share * (values[..., right] - values[..., left])

    @cached_property
    def begun_earlier(self) -> Grid:
        """The grid with one more time in front, as far as the next step reaches."""
        first = 2.0 * self.times[:1] - self.times[1:2]
        return Grid(torch.cat([first, self.times]), self.samples + 1, self.seconds)


@lru_cache(maxsize=64)
def _space_evenly(num_times: int, dt: float) -> Grid:
    seconds = dt * np.arange(num_times, dtype=np.float64)
    return Grid(torch.from_numpy(seconds), torch.arange(num_times), seconds)


#: (signals (..., width, num_times), grid) -> the same signals, changed
SignalMap = Callable[[Tensor, "Grid"], Tensor]
#: (signal on the grid, grid, size () or (K,)) -> the same signal, changed
SizedMap = Callable[[Tensor, "Grid", Tensor], Tensor]


def change_rows(signals: Tensor, which: Sequence[int], change: SignalMap, grid: Grid) -> Tensor:
    """Some signals changed, the others as they are.

    Args:
        signals: (..., num_signals, num_times).
        which: Indices of those that change; empty: all.
        change: Function of them (..., width, num_times) and of the grid.
    """
    places = torch.tensor(list(which) or list(range(signals.shape[-2])))
    changed = change(signals[..., places, :], grid)
    lead = np.broadcast_shapes(signals.shape[:-2], changed.shape[:-2])
    every = signals.expand(*lead, *signals.shape[-2:])
    return every.index_copy(-2, places, changed.expand(*lead, *changed.shape[-2:]))


def _is_alone(grid: Grid) -> bool:
    """Whether there is a single time: nothing happened before, and maps leave it as it is."""
    return len(grid.times) < 2


def _alone(u: Tensor, size: Tensor) -> Tensor:
    """A signal at a single time, at each of the sizes () or (K,)."""
    return u + torch.zeros_like(size)[..., None]


def after(u: Tensor, grid: Grid, change: SignalMap, before: Tensor) -> Tensor:
    """A change of signals that had other values until a step before their first time.

    Args:
        u: Signals, (..., num_times).
        change: What happens to them on their way; alone it takes them to have had their first
            values before.
        before: These values, (...) or fewer axes that broadcast; NaN: the first one.
    """
    if _is_alone(grid):
        return change(u, grid)
    first = u[..., :1]
    earlier = torch.where(before.isnan()[..., None], first, before[..., None])
    longer = torch.cat([earlier.expand(first.shape), u], -1)
    return change(longer, grid.begun_earlier)[..., 1:]


def delayed(u: Tensor, grid: Grid, delay: Tensor, *, signed: bool = True) -> Tensor:
    """u(t - delay) of straight lines between times, so that a step comes as late as it should.

    Args:
        u: Signal, (..., num_times); held beyond the ends.
        delay: () or (K,) [s].
        signed: As of ``held_delayed``.
    """
    if _is_alone(grid):
        return _alone(u, delay)
    t = grid.times
    ends = u[..., :1], u[..., -1:]
    values = torch.cat([ends[0], u, ends[1]], -1)
    return _read_at(values, t, t - delay[..., None], both_sides=signed)


def smoothly_delayed(u: Tensor, grid: Grid, delay: Tensor) -> Tensor:
    """u(t - delay) by monotone cubics, smooth in the delay; for signals without steps.

    Args:
        u: Signal, (..., num_times); held beyond the ends.
        delay: () or (K,) [s].
    """
    if _is_alone(grid):
        return _alone(u, delay)
    t = grid.times
    place = (t - delay[..., None]).clamp(float(t[0]), float(t[-1]))
    left = find_intervals(t, place.detach(), of_equal="right")
    h = t.diff()[left]
    s = (place - t[left]) / h
    slopes = _monotone_slopes(u, t)
    y0, y1 = _take_at(u, left), _take_at(u, left + 1)
    d0, d1 = _take_at(slopes, left), _take_at(slopes, left + 1)
    d0, d1, rise = d0 * h, d1 * h, y1 - y0
    return y0 + s * (d0 + s * (3.0 * rise - 2.0 * d0 - d1 + s * (d0 + d1 - 2.0 * rise)))


def held_delayed(u: Tensor, grid: Grid, delay: Tensor, *, signed: bool = True) -> Tensor:
    """A command that is held over each step, late by ``delay``: mean over the step.

    Args:
        u: Command, (..., num_times); each value lasts until the next time.
        delay: () or (K,) [s].
        signed: Whether it may be early: then slopes at whole steps are central.
    """
    if _is_alone(grid):
        return _alone(u, delay)
    late = _held_late(u, grid, delay, signed)
    if bool((delay != 0.0).all()):
        return late
    # to the last digit the command itself at zero, with the slope by the delay there; that by the
    # command is in the command
    slope = _held_late(u.detach(), grid, delay, signed)
    return torch.where(delay[..., None] != 0.0, late, u + (slope - slope.detach()))


def _held_late(u: Tensor, grid: Grid, delay: Tensor, signed: bool) -> Tensor:
    t = grid.times
    t = torch.cat([t, 2.0 * t[-1:] - t[-2:-1]])  # the last sample is held for a step, too
    steps = t.diff()
    area = torch.cat([torch.zeros_like(u[..., :1]), (u * steps).cumsum(-1)], -1)
    far = _measure_beyond(t)
    ends = -far * u[..., :1], area[..., -1:] + far * u[..., -1:]
    area = torch.cat([ends[0], area, ends[1]], -1)
    whole = _read_at(area, t, t - delay[..., None], both_sides=signed)
    return whole.diff(dim=-1) / steps


def lagged(u: Tensor, grid: Grid, time_constant: Tensor) -> Tensor:
    """First-order lag, exact for straight lines between times; at rest in the beginning.

    Args:
        u: Signal, (..., num_times).
        time_constant: () or (K,) [s].
    """
    if _is_alone(grid):
        return _alone(u, time_constant)
    steps, decay = _decay(grid, time_constant)
    target = time_constant[..., None] * u.diff(dim=-1) / steps
    # e = u - y: e' = u' - e / tau, from one time to the next target + (e - target) * decay
    error = affine_scan(decay, target * (1.0 - decay))
    return u - torch.cat([torch.zeros_like(error[..., :1]), error], -1)


def held_lagged(u: Tensor, grid: Grid, time_constant: Tensor) -> Tensor:
    """First-order lag of a command that is held over each step: mean over the step.

    Args:
        u: Command, (..., num_times); each value lasts until the next time.
        time_constant: () or (K,) [s].
    """
    if _is_alone(grid):
        return _alone(u, time_constant)
    steps, decay = _decay(grid, time_constant)
    fall = -u.diff(dim=-1)
    # e = y - u at the start of each step; it jumps where the command does
    error = affine_scan(decay, fall)
    error = torch.cat([torch.zeros_like(error[..., :1]), error], -1)
    share = time_constant[..., None] / steps * (1.0 - decay)
    share = torch.cat([share, share[..., -1:]], -1)
    return u + error * share


def in_steps(u: Tensor, grid: Grid, step: Tensor) -> Tensor:
    """A signal that is straight between times, rounded to whole ``step``, () or (K,).

    An actuator that counts steps passes all of them on the way: each value is the mean from half
    way to the time before to half way to the next. So what comes before it has its true slope,
    though that of the rounding is zero almost everywhere.
    """
    return _add_rounding_error(u, step, lambda s: _mean_rounding(u, grid, s))


def held_in_steps(u: Tensor, grid: Grid, step: Tensor) -> Tensor:
    """A command that is held over each step of time, rounded to whole ``step``, () or (K,).

    Values are exact. Slopes are those of ``in_steps``: what comes before it moves when values
    change to the next step, which no single value shows.
    """

    def error(s: Tensor) -> Tensor:
        slope = _mean_rounding(u, grid, s)
        return (_rounding(u, s).detach() - slope.detach()) + slope

    return _add_rounding_error(u, step, error)


def _add_rounding_error(u: Tensor, step: Tensor, error: Callable[[Tensor], Tensor]) -> Tensor:
    wide = step[..., None]
    return torch.where(wide > 0.0, u + error(torch.where(wide > 0.0, wide, 1.0)), u)


def _rounding(u: Tensor, step: Tensor) -> Tensor:
    """What rounding to the nearest step, counted from zero, adds."""
    return step * torch.round(u / step) - u


def _mean_rounding(u: Tensor, grid: Grid, step: Tensor) -> Tensor:
    """Mean of ``_rounding`` around each time along straight lines, exactly."""
    if u.shape[-1] < 2:  # on no way
        return _rounding(u, step)
    half_way = 0.5 * (u[..., 1:] + u[..., :-1])
    h = grid.times.diff()
    none = torch.zeros_like(h[:1])
    after = h * _mean_on_way(u[..., :-1], half_way, step)
    before = h * _mean_on_way(half_way, u[..., 1:], step)
    still = torch.zeros_like(after[..., :1])
    total = torch.cat([after, still], -1) + torch.cat([still, before], -1)
    return total / (torch.cat([h, none]) + torch.cat([none, h]))


def _mean_on_way(start: Tensor, end: Tensor, step: Tensor) -> Tensor:
    """Mean of the rounding e on a straight way: -e^2 / 2 is its integral, across steps, too."""
    first, last, far = _rounding(start, step), _rounding(end, step), end - start
    moves = far.abs() > 1e-6 * step  # steps of an actuator: on a shorter way the ends tell the mean
    mean = 0.5 * (first.square() - last.square()) / torch.where(moves, far, 1.0)
    return torch.where(moves, mean, 0.5 * (first + last))


def slowed(u: Tensor, grid: Grid, slowness: Tensor) -> Tensor:
    """Followed no faster than 1 / ``slowness``, () or (K,) [s per unit]; 0: the signal itself."""
    # [s per unit]: a slowness below it is none
    most = grid.times.diff() / slowness[..., None].clamp(min=1e-12)
    return follow("slowed", u, most, u[..., 0])


def accelerated(
    u: Tensor, grid: Grid, slowness: Tensor, cruise: Tensor | None = None, *, held: bool = False
) -> Tensor:
    """Followed with no more acceleration than 1 / ``slowness``, from rest, and no overshoot.

    It brakes in time to stop at what it follows, as the profile of a drive does.

    Args:
        u: Signal, (..., num_times).
        slowness: () or (K,) [s^2 per unit]; 0: the signal itself.
        cruise: Way above which a step is done at the greatest speed for a while, () or (K,) [unit];
            None: no speed is too great.
        held: Whether the signal is held over each step.

    Returns:
        Where it is at each time.
    """
    if _is_alone(grid):
        return _alone(u, slowness)
    steps, most = grid.times.diff(), 1.0 / slowness.clamp(min=1.0 / _SPRINT)
    fastest = torch.full_like(most, _SPRINT) if cruise is None else (cruise * most).sqrt()
    found = approach(u, steps, most, fastest, held=held)
    return torch.where(slowness[..., None] > 0.0, found, u)


def held_accelerated(
    u: Tensor, grid: Grid, slowness: Tensor, cruise: Tensor | None = None
) -> Tensor:
    """``accelerated`` of a command that is held over each step: the middle of the step's ends."""
    place = accelerated(u, grid, slowness, cruise, held=True)
    after = torch.cat([place[..., 1:], place[..., -1:]], -1)
    return torch.where(slowness[..., None] > 0.0, 0.5 * (place + after), u)


def exchanged(u: Tensor, grid: Grid, share: Tensor) -> Tensor:
    """Two signals (..., 2, num_times), a ``share`` () or (K,) of each come in the other's place."""
    return u + share[..., None] * (u.flip(-2) - u)


def with_play(u: Tensor, grid: Grid, half_gap: Tensor, start: Tensor | None = None) -> Tensor:
    """Play: rests until the signal has crossed the gap.

    Args:
        u: Signal, (..., num_times).
        half_gap: Half of the play, () or (K,).
        start: Where in the play it begins, -1 to 1, () or (K,); None: in the middle.
    """
    first = u[..., 0] if start is None else u[..., 0] + start * half_gap
    return follow("play", u, half_gap[..., None], first)


def affine_scan(factor: Tensor, term: Tensor) -> Tensor:
    """x_k = factor_k x_(k-1) + term_k from x = 0, along the last axis; log2(n) vectorized steps."""
    factor, term = torch.broadcast_tensors(factor, term)
    shift = 1
    while shift < term.shape[-1]:
        one = torch.ones_like(factor[..., :shift])
        earlier = torch.cat([torch.zeros_like(one), term[..., :-shift]], -1)
        term = term + factor * earlier
        factor = factor * torch.cat([one, factor[..., :-shift]], -1)
        shift *= 2
    return term


def decayed(factor: Tensor, term: Tensor) -> Tensor:
    """x_k = factor x_(k-1) + term_k from x = 0, along the last axis, one after the other.

    Args:
        factor: The same at all times, with the leading axes of ``term``, which broadcast.
        term: (..., num_times).
    """
    targets = torch.cat([torch.zeros_like(term[..., :1]), term], -1)
    return follow("decays", targets, factor[..., None], torch.zeros_like(term[..., 0]))[..., 1:]


def _decay(grid: Grid, time_constant: Tensor) -> tuple[Tensor, Tensor]:
    steps = grid.times.diff()
    shortest = SHORTEST_LAG * float(steps.min())
    return steps, torch.exp(-steps / time_constant[..., None].clamp(min=shortest))


def _take_at(values: Tensor, index: Tensor) -> Tensor:
    """values[..., index] with broadcast leading axes."""
    if index.ndim == 1:
        return values[..., index]
    lead = np.broadcast_shapes(values.shape[:-1], index.shape[:-1])
    index = index.expand(*lead, index.shape[-1])
    return values.expand(*lead, values.shape[-1]).gather(-1, index)


def _measure_beyond(times: Tensor) -> float:
    """How far a signal is continued beyond its ends [s]."""
    return 10.0 * float(times[-1] - times[0])


def _read_at(values: Tensor, times: Tensor, place: Tensor, *, both_sides: bool = True) -> Tensor:
    """Straight lines through values that begin and end ``_measure_beyond`` the times.

    At a time of the grid the slope is the mean of both sides, as it is for central differences, or
    that of the side before.
    """
    far = _measure_beyond(times)
    wide = torch.cat([times[:1] - far, times, times[-1:] + far])
    place = place.clamp(float(wide[0]), float(wide[-1]))
    return read_lines(values, wide, place, both_sides=both_sides)


def _monotone_slopes(u: Tensor, times: Tensor) -> Tensor:
    """Slopes of Fritsch and Carlson (1980): no overshoot; flat at the ends."""
    h = times.diff()
    slope = u.diff(dim=-1) / h
    before, after = slope[..., :-1], slope[..., 1:]
    w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    alike = before * after > 0.0
    safe_before, safe_after = torch.where(alike, before, 1.0), torch.where(alike, after, 1.0)
    inner = torch.where(alike, (w1 + w2) / (w1 / safe_before + w2 / safe_after), 0.0)
    flat = torch.zeros_like(u[..., :1])
    return torch.cat([flat, inner, flat], -1)


def late_by(delay: Tensor, *, held: bool, signed: bool = True) -> SignalMap:
    """A delay of commands that are held, or straight, between times.

    Args:
        delay: () or (K,) [s].
        held: Whether they are held.
        signed: As of ``held_delayed``.
    """
    return partial(held_delayed if held else delayed, delay=delay, signed=signed)


#: What a command does between samples: it is held, goes straight, or is known at samples alone.
Between = Literal["held", "straight", "smooth"]


def _held_late_only(u: Tensor, grid: Grid, delay: Tensor) -> Tensor:
    return held_delayed(u, grid, delay, signed=False)


def _late_only(u: Tensor, grid: Grid, delay: Tensor) -> Tensor:
    return delayed(u, grid, delay, signed=False)


#: Maps that do nothing but bring a signal late.
DELAYS = frozenset({delayed, held_delayed, _late_only, _held_late_only})
#: Maps that remember what came before, by the names that rows of causes use.
MAPS: Mapping[str, Mapping[Between, SizedMap]] = MappingProxyType(
    {
        "delayed": {"held": held_delayed, "straight": delayed, "smooth": smoothly_delayed},
        "delayed_only": {
            "held": _held_late_only,
            "straight": _late_only,
            "smooth": smoothly_delayed,
        },
        "smoothly_delayed": dict.fromkeys(("held", "straight", "smooth"), smoothly_delayed),
        "lagged": {"held": held_lagged, "straight": lagged, "smooth": lagged},
        "in_steps": {"held": held_in_steps, "straight": in_steps, "smooth": in_steps},
        "accelerated": {
            "held": held_accelerated,
            "straight": accelerated,
            "smooth": accelerated,
        },
        "exchanged": dict.fromkeys(("held", "straight", "smooth"), exchanged),
        "slowed": dict.fromkeys(("held", "straight", "smooth"), slowed),
        "with_play": dict.fromkeys(("held", "straight", "smooth"), with_play),
    }
)
JOINT = ("exchanged",)  # maps of several signals together
