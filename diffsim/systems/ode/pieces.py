"""Where a start state stops telling: runs of formulas are cut there, each piece with its own start.

Two starts that differ a little stay a straight image of each other in most recordings, however long
these are. Where a lever turns over, a body bounces or a motion is unstable they part: behind such a
place the record says nothing about the start any more, and a fit that insists invents constants.

The rule asks the plain model only. From the start of a piece each state is moved a little to either
side. Where the two paths bend (their mean leaves the path between them) after they have parted by
``GROWTH``, the piece ends at the last time at which they had not. The next one begins with what the
record shows: states fitted to the samples that follow, as far as these tell of them.

Behind such a place, and where paths part as those of an unstable motion, pieces end wherever paths
have parted so far, bent or not: the end of a run is as unstable as its middle, and slopes by
constants are no better there than those by starts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.progress import say_stage
from diffsim.data.study import Run
from diffsim.identify.model import SimModel
from diffsim.systems.ode.scene import OdeScene

GROWTH = 5.0  # times that two starts part, beyond which a piece must not go on
START_STEP_SHARE = 0.01  # of a state's usual motion: how far starts are moved
BENT = 0.2  # of half the distance: how far the mean of two paths may leave the one between
STRAIGHT = 1e-3  # of the distance of two starts, likewise: a linear system
MIN_PIECE_SAMPLES = 8  # samples of a piece
SEEN = 32  # samples that tell the start of a piece
MANY = 8  # states: of more, no path is asked for each
PLACES = 8  # of a piece from which the model is asked
MAX_PIECES = 64  # pieces of a run
AWAY_SPANS = 3.0  # spans of a channel's record from its middle, beyond which a model runs away
START_PRIOR_FACTOR = 10.0  # times that a start may differ from what the samples say of it
_TINY = 1e-9


@dataclass(frozen=True)
class Piece:
    """A piece of a run that begins with a start state of its own."""

    time: float  # when it begins [s]
    start: Mapping[str, float]  # state there as the record shows it, by state
    sd: Mapping[str, float]  # how far it may differ from that, by state
    parting: str  # how far two starts of the piece before part, in words


def start_name(state: str, piece: Piece, run: Run) -> str:
    """Name of the base parameter that a state begins a piece with."""
    return f"{state}_from_{1e3 * piece.time:.6g}_ms@{run.name}"


def cut_run(run: Run, model: SimModel) -> tuple[Piece, ...]:
    """Pieces of a run after the first one; none where two starts stay an image of each other.

    Args:
        model: Plain model, whose scenes are :class:`OdeScene`.
    """
    say_stage(f"asking how far the start of run {run.name} tells")
    scene = model.scene(run, model.at_prior())
    assert isinstance(scene, OdeScene)
    with torch.no_grad():
        names, begun = scene.begin()
        start, last = begun.numpy(), len(run.time_s) - 1
        readings, states = _simulate(scene, start[None], 0, last)
        if not names or not (np.isfinite(readings).all() and np.isfinite(states).all()):
            return ()
        with np.errstate(over="ignore"):
            kept = _count_near(readings[0], run.measured)
            usual = _Usual(_usual_motion(states[0, :kept]), _usual_motion(readings[0, :kept]))
        if not all(np.isfinite(motion).all() for motion in usual):
            return ()  # so far away that its squares leave the range of numbers
        return _Cutter(run, scene, names, usual).cut(start)


class _Usual(NamedTuple):
    """Usual motion of each state and each channel, (n,) and (num_channels,)."""

    states: Array
    channels: Array


class _Parting(NamedTuple):
    """Paths of moved starts beside a path, in usual motions."""

    states: Array  # of the path between, (samples, n) [unit of the state]
    change: Array  # from one of two starts moved along each state to the other, (n, samples, n)
    apart: Array  # its length, (n, samples)
    bend: Array  # distance of their sum from twice the path between, likewise
    seen: Array  # distance in each channel, (n, samples, num_channels)


class _End(NamedTuple):
    """Last sample of a piece, the plain model's state there, and how far two starts part."""

    sample: int
    state: Array
    parting: str


def _is_unstable(whole: _Parting) -> bool:
    """Whether starts part as those of an unstable motion, bent or not: in the later half of the run
    by more than what drifts does, whose distance doubles there, and along a way of their own.
    Warmth that comes through a wall has none, though its far side grows by any factor."""
    apart = whole.apart
    if not (apart[:, -1] > GROWTH * apart[:, : apart.shape[1] // 2].max(1)).any():
        return False
    last = whole.change[:, -1] / (2.0 * START_STEP_SHARE)  # (n, n): of the state by the start
    return not np.isfinite(last).all() or bool(np.abs(np.linalg.eigvals(last)).max() > GROWTH)


@dataclass(frozen=True)
class _Cutter:
    """Cuts a run by what its scene in the plain model does from other starts."""

    run: Run
    scene: OdeScene
    names: tuple[str, ...]
    usual: _Usual

    @property
    def last(self) -> int:
        """Last sample of the run."""
        return len(self.run.time_s) - 1

    def cut(self, start: Array) -> tuple[Piece, ...]:
        """Pieces after the first one, which begins with ``start``."""
        # of many states a path for each takes more than the answer
        whole = self._part(start, 0) if len(start) <= MANY else None
        is_unstable = whole is not None and _is_unstable(whole)
        if not is_unstable and self._is_straight(start, whole):
            return ()
        out: list[Piece] = []
        first = 0
        while len(out) < MAX_PIECES:
            end = self._find_first_end(start, first, bent=not (out or is_unstable))
            if end is None or end.sample + MIN_PIECE_SAMPLES > self.last:
                break
            if not np.isfinite(end.state).all():  # nowhere to begin the next piece
                break
            first = end.sample
            start, sd = self._fit_start(end.state, first)
            begun, wide = (dict(zip(self.names, v.tolist(), strict=True)) for v in (start, sd))
            out.append(Piece(float(self.run.time_s[first]), begun, wide, end.parting))
        return tuple(out)

    def _is_straight(self, start: Array, whole: _Parting | None) -> bool:
        """Whether the run is a straight image of its start, as those of linear systems are; without
        a path for each state all are moved at once, twice."""
        if whole is not None:
            return bool((whole.bend <= STRAIGHT * 2.0 * START_STEP_SHARE).all())
        signs = np.where(np.arange(len(start)) % 2 == 0, 1.0, -1.0)
        ways = START_STEP_SHARE * self.usual.states * np.stack([np.ones(len(start)), signs])
        points = np.concatenate([start[None], start + ways, start - ways])
        states = _simulate(self.scene, points, 0, self.last)[1] / self.usual.states
        middle, sides = states[0], zip(states[1:3], states[3:], strict=True)
        bends = [above + below - 2.0 * middle for above, below in sides]
        return all(
            bool((np.linalg.norm(b, axis=-1) <= STRAIGHT * 2.0 * START_STEP_SHARE).all())
            for b in bends
        )

    def _part(self, start: Array, first: int) -> _Parting:
        """Starts moved along each state, to either side, and what becomes of them."""
        n = len(start)
        points = _on_both_sides(start, self.usual.states)
        readings, states = _simulate(self.scene, points, first, self.last)
        scaled, shown = states / self.usual.states, readings / self.usual.channels
        above, below = scaled[1 : n + 1], scaled[n + 1 :]
        return _Parting(
            states[0],
            above - below,
            np.linalg.norm(above - below, axis=-1),
            np.linalg.norm(above + below - 2.0 * scaled[0], axis=-1),
            np.abs(shown[1 : n + 1] - shown[n + 1 :]),
        )

    def _find_first_end(self, start: Array, first: int, *, bent: bool) -> _End | None:
        """Where the piece from ``first`` must end; None: it may go on to the end of the run.

        The plain model may take another way than what was recorded. So it is asked from several
        places on, at each of them from the state that the record shows there.
        """
        places = np.unique(np.linspace(first, self.last, PLACES + 1).astype(int))
        ends = []
        for here, following in pairwise(places):
            if self.last - here < 2 * MIN_PIECE_SAMPLES:
                break
            if here > first:
                start, _ = self._fit_start(start, here)
            parted = self._part(start, here)
            if (end := self._find_end(parted, here, bent=bent)) is not None:
                ends.append(end)
            if ends and min(e.sample for e in ends) <= following:
                break
            start = parted.states[following - here]
            if not np.isfinite(start).all():  # the model runs away from here
                break
        return min(ends, key=lambda end: end.sample, default=None)

    def _find_end(self, parted: _Parting, first: int, *, bent: bool) -> _End | None:
        """Where a piece must end by one path, ``bent`` or wherever it is far; None: nowhere."""
        is_far = parted.apart > GROWTH * 2.0 * START_STEP_SHARE
        is_bent = (parted.bend > BENT * parted.apart) | (not bent)
        # what a control loop answers at once, and forgets, is no parting
        seen = np.linalg.norm(parted.seen, axis=-1)
        is_seen = seen > np.maximum(
            seen[:, :MIN_PIECE_SAMPLES].max(1, keepdims=True), 2.0 * START_STEP_SHARE
        )
        is_lost = ~np.isfinite(parted.apart) | (is_far & is_bent & is_seen)
        if not is_lost.any():
            return None
        lost = int(np.argmax(is_lost.any(0)))
        apart = np.nan_to_num(parted.apart[:, lost], nan=np.inf)
        along = int(np.argmax(np.where(is_lost[:, lost], apart, 0)))
        near = np.flatnonzero(~is_far[:, :lost].any(0))
        end = max(MIN_PIECE_SAMPLES, int(near.max(initial=0)))
        shown = int(np.argmax(parted.seen[along, lost]))
        far = float(parted.seen[along, lost, shown] * self.usual.channels[shown])
        moved = 2.0 * START_STEP_SHARE * self.usual.states[along]
        parting = (
            f"two starts {moved:.2g} apart in {self.names[along]} are {far:.2g} apart in "
            f"{self.scene.channels[shown]} at {self.run.time_s[first + lost]:.4g} s"
        )
        return _End(first + end, parted.states[end], parting)

    def _fit_start(self, guess: Array, first: int) -> tuple[Array, Array]:
        """State at the beginning of a piece as the samples show that follow, and its width, (n,)
        each: Gauss-Newton from a guess, with slopes by differences."""
        n, start, scale = len(guess), guess.copy(), self.usual.states
        sd, last = scale, first + min(SEEN, self.last - first)
        measured = self.run.measured[first : last + 1]
        for _ in range(4):
            readings, _ = _simulate(self.scene, _on_both_sides(start, scale), first, last)
            slopes = (readings[1 : n + 1] - readings[n + 1 :]) / (2.0 * START_STEP_SHARE)
            seen = np.isfinite(measured) & np.isfinite(readings).all(0)
            left, columns = (measured - readings[0])[seen], slopes[:, seen].T
            noise = max(float(np.sqrt(np.mean(left**2))) if left.size else 0.0, _TINY)
            columns, left = columns / noise, left / noise
            # what no sample tells stays at the guess
            normal = columns.T @ columns + np.eye(n)
            pull = (start - guess) / scale
            step = np.linalg.solve(normal, columns.T @ left - pull)
            sd = np.sqrt(np.diag(np.linalg.inv(normal))) * scale
            start = start + np.clip(step, -1.0, 1.0) * scale
        return start, np.minimum(START_PRIOR_FACTOR * sd, scale)


def _simulate(scene: OdeScene, starts: Array, first: int, last: int) -> tuple[Array, Array]:
    """Readings (K, samples, channels) and states of a part of a run from other starts (K, n)."""
    places = scene.grid.samples.numpy()[first : last + 1]
    given = torch.from_numpy(np.ascontiguousarray(starts))
    readings, states = scene.solved_from(given, int(places[0]), int(places[-1]))
    kept = places - places[0]
    return readings.numpy()[:, kept], states.numpy()[:, kept]


def _on_both_sides(start: Array, scale: Array) -> Array:
    """A start, and starts moved along each state to either side, (2 n + 1, n)."""
    nudge = START_STEP_SHARE * np.diag(scale)
    return np.concatenate([start[None], start + nudge, start - nudge])


def _count_near(readings: Array, measured: Array) -> int:
    """Samples before a path of the model has run away from the record, at least those of a piece:
    the motion of a lever that turns over without end is not that of the rig."""
    seen = np.isfinite(measured).any(0)
    low, high = np.nanmin(measured[:, seen], axis=0), np.nanmax(measured[:, seen], axis=0)
    off = np.abs(readings[:, seen] - (low + high) / 2.0)
    left = (off > AWAY_SPANS * (high - low)).any(1)
    return max(int(np.argmax(left)), MIN_PIECE_SAMPLES) if left.any() else len(left)


def _usual_motion(path: Array) -> Array:
    """Rms of each state's motion about its middle, (n,); of a state at rest its own size, or 1."""
    moved, size = path.std(0), np.sqrt(np.mean(path**2, axis=0))
    usual = np.where(moved > _TINY * size, moved, size)
    return np.asarray(np.where(usual > _TINY, usual, 1.0))
