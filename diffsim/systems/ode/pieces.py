"""Where a start state stops telling: runs of formulas are cut there, each piece with its own start.

Two starts that differ a little stay a straight image of each other in most recordings, however long
these are. Where a lever turns over, a body bounces or a motion is unstable they part: behind such a
place the record says nothing about the start any more, and a fit that insists invents constants.

The rule asks the plain model only. From the start of a piece each state is moved a little to either
side. Where the two paths bend (their mean leaves the path between them) after they have parted by
``GROWTH``, the piece ends at the last time at which they had not. The next one begins with what the
record shows: states fitted to the samples that follow, as far as these tell of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.memo import Memo
from diffsim.data.study import Run
from diffsim.identify.model import SimModel
from diffsim.systems.ode.scene import OdeScene

Array = NDArray[np.float64]
#: (start states (K, n), first and last sample) -> readings (K, samples, channels) and states
Path = Callable[[Array, int, int], tuple[Array, Array]]

GROWTH = 5.0  # times that two starts part, beyond which a piece must not go on
NEAR = 0.01  # of a state's usual motion: how far starts are moved
BENT = 0.2  # of half the distance: how far the mean of two paths may leave the one between
STRAIGHT = 1e-3  # of the distance of two starts, likewise: a linear system
MANY = 8  # states, from which on they are moved together
FEWEST = 8  # samples of a piece
SEEN = 32  # samples that tell the start of a piece
PLACES = 8  # of a piece from which the model is asked
MOST = 64  # pieces of a run
WIDE = 10.0  # times that a start may differ from what the samples say of it
_STEPS = 4  # of the fit of a start state
_TINY = 1e-9
_MOST_RUNS = 256  # whose pieces are remembered
_KNOWN: Memo[tuple[Piece, ...]] = Memo(_MOST_RUNS)


@dataclass(frozen=True)
class Piece:
    """A piece of a run that begins with a start state of its own.

    Attributes:
        time: When it begins [s].
        start: State there as the record shows it, by state.
        sd: How far it may differ from that, by state.
        parting: How far two starts of the piece before part, in words.
    """

    time: float
    start: Mapping[str, float]
    sd: Mapping[str, float]
    parting: str


def pieces_of(run: Run, model: SimModel, formulas: str) -> tuple[Piece, ...]:
    """Pieces of a run after the first one; none where two starts stay an image of each other.

    Args:
        run: Recorded run.
        model: Plain model, whose scenes are :class:`OdeScene`.
        formulas: What the model is made of, in text: a check and the set-ups of one command ask
            for the same runs.
    """
    return _KNOWN((run, formulas), lambda: _cut_run(run, model))


def _cut_run(run: Run, model: SimModel) -> tuple[Piece, ...]:
    scene = model.scene(run, model.at_prior())
    assert isinstance(scene, OdeScene)
    with torch.no_grad():
        states, start = scene.begin()
        return find_pieces(run, states, scene.channels, start.numpy(), _PathOf(scene))


class _PathOf:
    """Simulates a scene from other starts, and parts of it.

    Args:
        scene: The run in the plain model.
    """

    def __init__(self, scene: OdeScene):
        self._scene, self._places = scene, scene.grid.samples.numpy()

    def __call__(self, starts: Array, first: int, last: int) -> tuple[Array, Array]:
        places = self._places[first : last + 1]
        given = torch.from_numpy(np.ascontiguousarray(starts))
        readings, states = self._scene.solved_from(given, int(places[0]), int(places[-1]))
        kept = places - places[0]
        return readings.numpy()[:, kept], states.numpy()[:, kept]


def find_pieces(
    run: Run, states: Sequence[str], channels: Sequence[str], start: Array, path: Path
) -> tuple[Piece, ...]:
    """Pieces after the first one.

    Args:
        run: Recorded run.
        states, channels: Names of the states and of what is read.
        start: Start state of the run, (n,).
        path: Simulates the plain model.
    """
    last = len(run.time_s) - 1
    readings, moved = path(start[None], 0, last)
    if not len(states) or not (np.isfinite(readings).all() and np.isfinite(moved).all()):
        return ()
    with np.errstate(over="ignore"):
        usual = Usual(_usual_motion(moved[0]), _usual_motion(readings[0]))
    if not (np.isfinite(usual.states).all() and np.isfinite(usual.channels).all()):
        return ()  # so far away that its squares leave the range of numbers
    if _is_straight(path, start, usual, last):
        return ()
    out: list[Piece] = []
    first = 0
    while len(out) < MOST:
        found = _find_first_end(path, run, start, usual, first)
        if found is None or found.end + FEWEST > last:
            break
        if not np.isfinite(found.state_at_end).all():  # nowhere to begin the next piece
            break
        first = found.end
        start, sd = _fit_start(path, run, found.state_at_end, usual.states, first)
        apart = 2.0 * NEAR * usual.states[found.along]
        out.append(
            Piece(
                float(run.time_s[first]),
                dict(zip(states, start.tolist(), strict=True)),
                dict(zip(states, sd.tolist(), strict=True)),
                f"two starts {apart:.2g} apart in {states[found.along]} are {found.apart:.2g} "
                f"apart in {channels[found.shown]} at {run.time_s[found.lost]:.4g} s",
            )
        )
    return tuple(out)


@dataclass(frozen=True)
class Usual:
    """Usual motion of each state and each channel, (n,) and (num_channels,)."""

    states: Array
    channels: Array


@dataclass(frozen=True)
class _End:
    """Where a piece must end.

    Attributes:
        end: Its last sample.
        state_at_end: State of the plain model there.
        along: State that two starts differ in.
        lost: Sample at which their paths are no image of each other any more.
        shown: Channel that shows it.
        apart: How far apart they are there, in that channel's unit.
    """

    end: int
    state_at_end: Array
    along: int
    lost: int
    shown: int
    apart: float


@dataclass(frozen=True)
class _Parting:
    """Paths beside a path, in usual motions.

    Attributes:
        states: Of the path between, (samples, n).
        apart: Distance of two starts moved along each state, in states, (n, samples).
        bend: Distance of their sum from twice the path between, likewise.
        seen: Distance in each channel, (n, samples, num_channels).
    """

    states: Array
    apart: Array
    bend: Array
    seen: Array


def _usual_motion(path: Array) -> Array:
    """Rms of each state's motion about its middle, (n,); of a state at rest its own size, or 1."""
    moved, size = path.std(0), np.sqrt(np.mean(path**2, axis=0))
    usual = np.where(moved > _TINY * size, moved, size)
    return np.asarray(np.where(usual > _TINY, usual, 1.0))


def _part(path: Path, start: Array, usual: Usual, first: int, last: int) -> _Parting:
    """Starts moved along each state, to either side, and what becomes of them."""
    n = len(start)
    nudge = NEAR * np.diag(usual.states)
    points = np.concatenate([start[None], start + nudge, start - nudge])
    readings, states = path(points, first, last)
    scaled, shown = states / usual.states, readings / usual.channels
    above, below = scaled[1 : n + 1], scaled[n + 1 :]
    return _Parting(
        states[0],
        np.linalg.norm(above - below, axis=-1),
        np.linalg.norm(above + below - 2.0 * scaled[0], axis=-1),
        np.abs(shown[1 : n + 1] - shown[n + 1 :]),
    )


def _is_straight(path: Path, start: Array, usual: Usual, last: int) -> bool:
    """Whether a run is a straight image of its start, as those of linear systems are.

    Of many states all are moved at once, twice: a path for each would take more than the answer.
    """
    if len(start) <= MANY:
        return bool((_part(path, start, usual, 0, last).bend <= STRAIGHT * 2.0 * NEAR).all())
    signs = np.where(np.arange(len(start)) % 2 == 0, 1.0, -1.0)
    ways = NEAR * usual.states * np.stack([np.ones(len(start)), signs])
    points = np.concatenate([start[None], start + ways, start - ways])
    middle, *sides = path(points, 0, last)[1] / usual.states
    bends = [
        above + below - 2.0 * middle for above, below in zip(sides[:2], sides[2:], strict=True)
    ]
    return all(bool((np.linalg.norm(b, axis=-1) <= STRAIGHT * 2.0 * NEAR).all()) for b in bends)


def _find_first_end(path: Path, run: Run, start: Array, usual: Usual, first: int) -> _End | None:
    """Where the piece from ``first`` must end; None: it may go on to the end of the run.

    The plain model may take another way than what was recorded. So it is asked from several places
    on, at each of them from the state that the record shows there.
    """
    last = len(run.time_s) - 1
    places = np.unique(np.linspace(first, last, PLACES + 1).astype(int))[:-1]
    ends = []
    for here, following in zip(places, [*places[1:], last], strict=True):
        if last - here < 2 * FEWEST:
            break
        if here > first:
            start, _ = _fit_start(path, run, start, usual.states, here)
        parted = _part(path, start, usual, here, last)
        if (end := _find_end(parted, usual, here)) is not None:
            ends.append(end)
        if ends and min(e.end for e in ends) <= following:
            break
        start = parted.states[following - here]
        if not np.isfinite(start).all():  # the model runs away from here
            break
    return min(ends, key=lambda end: end.end, default=None)


def _find_end(parted: _Parting, usual: Usual, first: int) -> _End | None:
    """Where a piece must end by one path; None: nowhere."""
    is_far = parted.apart > GROWTH * 2.0 * NEAR
    is_bent = parted.bend > BENT * parted.apart
    # what a control loop answers at once, and forgets, is no parting
    seen = np.linalg.norm(parted.seen, axis=-1)
    is_seen = seen > np.maximum(seen[:, :FEWEST].max(1, keepdims=True), 2.0 * NEAR)
    is_lost = ~np.isfinite(parted.apart) | (is_far & is_bent & is_seen)
    if not is_lost.any():
        return None
    lost = int(np.argmax(is_lost.any(0)))
    along = int(
        np.argmax(np.where(is_lost[:, lost], np.nan_to_num(parted.apart[:, lost], nan=np.inf), 0))
    )
    near = np.flatnonzero(~is_far[:, :lost].any(0))
    end = max(FEWEST, int(near.max(initial=0)))
    shown = int(np.argmax(parted.seen[along, lost]))
    far = float(parted.seen[along, lost, shown] * usual.channels[shown])
    return _End(first + end, parted.states[end], along, first + lost, shown, far)


def _fit_start(path: Path, run: Run, guess: Array, scale: Array, first: int) -> tuple[Array, Array]:
    """State at the beginning of a piece as the samples show that follow, and its width, (n,) each.

    Gauss-Newton from a guess, with slopes by differences.
    """
    n, start = len(guess), guess.copy()
    nudge = NEAR * np.diag(scale)
    count, sd = min(SEEN, len(run.time_s) - 1 - first), scale
    for _ in range(_STEPS):
        points = np.concatenate([start[None], start + nudge, start - nudge])
        readings, _ = path(points, first, first + count)
        slopes = (readings[1 : n + 1] - readings[n + 1 :]) / (2.0 * NEAR)
        measured = run.measured[first : first + count + 1]
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
    return start, np.minimum(WIDE * sd, scale)
