"""Forms of what acts for a limited time, and where in time each could lie.

Forms have size one while they act. Edges are as long as ``edge``, so that a form moves smoothly
with its onset.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.identify.locate import Course

Timing = Mapping[str, Tensor]

ONSET, WIDTH, PERIOD = "onset", "width", "period"
TIMINGS = {
    "step": (ONSET,),
    "pulse": (ONSET, WIDTH),
    "ramp": (ONSET, WIDTH),
    "half_sine": (ONSET, WIDTH),
    "burst": (ONSET, WIDTH, PERIOD),
    "train": (ONSET, WIDTH, PERIOD),
}
"""What each form is placed by."""
SAID = {
    "step": "From ``onset`` on.",
    "pulse": "From ``onset`` on, for ``width``.",
    "ramp": "Grows from ``onset`` on for ``width``, then stays.",
    "half_sine": "Half a sine from ``onset`` on, ``width`` long.",
    "burst": "A sine of ``period`` from ``onset`` on, for ``width``.",
    "train": "Pulses of ``width`` each ``period``, the first at ``onset``.",
}
NUM_PLACED = 3  # proposals of a form


def shape_of(form: str, times: Tensor, timing: Timing, edge: float) -> Tensor:
    """A form in time.

    Args:
        form: One of ``TIMINGS``.
        times: Times of the samples, (num_times,) [s].
        timing: Onset, width, period as far as the form has them, () or (K,) [s].
        edge: Length of an edge [s].

    Returns:
        (num_times,) or (K, num_times), -1 to 1.
    """

    def begun(since: Tensor) -> Tensor:
        return (since / edge + 0.5).clamp(0.0, 1.0)

    since = times - timing[ONSET][..., None]
    if form == "step":
        return begun(since)
    width = timing[WIDTH][..., None]
    if form == "ramp":
        return (since / width).clamp(0.0, 1.0)
    window = begun(since) - begun(since - width)
    if form == "pulse":
        return window
    if form == "half_sine":
        return torch.sin(torch.pi * (since / width).clamp(0.0, 1.0))
    period = timing[PERIOD][..., None]
    if form == "burst":
        return window * torch.sin(2.0 * torch.pi * since / period)
    phase = torch.remainder(since + edge, period) - edge
    return (begun(phase) - begun(phase - width)) * begun(since)


def placed(form: str, course: Course, usual: float) -> list[tuple[float, dict[str, float]]]:
    """Where a form could lie: size and timing of the best places, best first.

    Args:
        form: One of ``TIMINGS``.
        course: What any course in time would gain.
        usual: Size that would be no surprise [unit].
    """
    step = float(course.times[1] - course.times[0])
    starts = _list_starts(form, course, usual, step)
    if not len(starts):
        return []
    found: list[tuple[float, Array]] = []
    for start in starts:
        best = _refine_place(form, course, start, step)
        if all(np.abs(best[1] - other).max() > 2.0 * step for _, other in found):
            found.append(best)
    names = TIMINGS[form]
    out = []
    for _, at in sorted(found, key=lambda f: -f[0])[:NUM_PLACED]:
        size = course.sizes(_evaluate_shapes(form, course.times, at[None], step))[0]
        out.append((float(size), dict(zip(names, at.tolist(), strict=True))))
    return out


def _evaluate_shapes(form: str, times: Array, places: Array, edge: float) -> Array:
    """(K, C) of places (C, num_timings)."""
    columns = torch.from_numpy(np.ascontiguousarray(places.T))
    timing = dict(zip(TIMINGS[form], columns, strict=True))
    return shape_of(form, torch.from_numpy(times), timing, edge).numpy().T


def _list_starts(form: str, course: Course, usual: float, step: float) -> Array:
    """Places to start from, (C, num_timings) [s]."""
    if form in ("step", "pulse"):
        return _find_boxes(course, form, step)
    if form == "train":
        return _find_trains(course, usual, step)
    t, span = course.times, float(np.ptp(course.times))
    onsets = np.linspace(t[0] - 0.05 * span, t[-1], 48)
    widths = np.geomspace(4.0 * step, span, 12)
    if form == "burst":
        periods = np.geomspace(6.0 * step, 0.5 * span, 16)
        places = np.array(
            [
                (o + quarter * p, w, p)
                for o, w, p in product(onsets[::4], widths[5::2], periods)
                for quarter in (0.0, 0.25)
                if w > p
            ]
        )
    else:
        places = np.array(list(product(onsets, widths)))
    gains = course.gains(_evaluate_shapes(form, t, places, step))
    return places[np.argsort(-gains)[:NUM_PLACED]]


def _find_boxes(course: Course, form: str, step: float) -> Array:
    """The best boxes among all that begin and end at knots, by integral images."""
    edges = np.concatenate([[0.0], np.cumsum(course.score)])
    power = np.zeros((len(edges), len(edges)))
    power[1:, 1:] = course.gram.cumsum(0).cumsum(1)
    own = np.diag(power)
    begin, end = np.arange(len(edges))[:, None], np.arange(len(edges))[None, :]
    allowed = end >= begin + 2 if form == "pulse" else (end == len(edges) - 1) & (begin < end)
    score = edges[None, :] - edges[:, None]
    total = own[None, :] + own[:, None] - 2.0 * power
    least = 1e-9 * max(float(np.diag(course.gram).max()), 1e-300)
    gains = np.where(allowed & (total > least), 0.5 * score**2 / np.maximum(total, least), -1.0)
    out: list[Array] = []
    for _ in range(NUM_PLACED):
        i, j = divmod(int(np.argmax(gains)), len(edges))
        if gains[i, j] <= 0.0:
            break
        onset = course.times[min(i, len(course.times) - 1)] - 0.5 * step
        out.append(np.array([onset, (j - i) * step][: len(TIMINGS[form])]))
        near = 3 + (j - i) // 4
        gains[max(i - near, 0) : i + near + 1, max(j - near, 0) : j + near + 1] = -1.0
    return np.array(out)


def _find_trains(course: Course, usual: float, step: float) -> Array:
    """Trains of pulses by folding the course that the data ask for (box least squares).

    Reference: Kovacs, Zucker, Mazeh 2002, "A box-fitting algorithm in the search for periodic
    transits".
    """
    t, weights = course.times, np.clip(np.diag(course.gram), 0.0, None)
    if not weights.any():
        return np.zeros((0, 3))
    force = course.force(usual)
    weights = weights / weights.sum()
    away = force - weights @ force
    span = float(np.ptp(t))
    periods = np.geomspace(6.0 * step, 0.6 * span, 4000)
    best = [_score_folded(t, weights, away, p, step) for p in periods]
    order = np.argsort([-b[0] for b in best])
    out: list[tuple[float, float, float]] = []
    for k in order:
        if len(out) == 8:  # folded courses that are looked at closely
            break
        _, phase, width = best[k]
        if all(abs(np.log(periods[k] / p)) > 0.01 for _, _, p in out):
            out.append((t[0] + phase, width, float(periods[k])))
    return np.array(out)


def _score_folded(
    t: Array, weights: Array, away: Array, period: float, step: float
) -> tuple[float, float, float]:
    """Score of the best pulse in a course folded by a period; its phase and width."""
    bins = int(min(max(period / step, 6), 48))
    place = ((t - t[0]) % period / period * bins).astype(int).clip(0, bins - 1)
    s = np.bincount(place, weights * away, bins)
    r = np.bincount(place, weights, bins)
    both = np.concatenate([[0.0], np.cumsum(np.tile(s, 2))])
    share = np.concatenate([[0.0], np.cumsum(np.tile(r, 2))])
    begin = np.arange(bins)[:, None]
    end = begin + np.arange(1, bins // 2 + 1)[None, :]
    inside, part = both[end] - both[begin], share[end] - share[begin]
    scores = inside**2 / np.maximum(part * (1.0 - part), 1e-12)
    i, j = np.unravel_index(int(np.argmax(scores)), scores.shape)
    width = (j + 1) / bins * period
    return float(scores[i, j]), float(i / bins * period), width


def _refine_place(form: str, course: Course, start: Array, step: float) -> tuple[float, Array]:
    """Pattern search from a place: gain and place at its end."""
    at, t = start.astype(float), course.times
    gain = float(course.gains(_evaluate_shapes(form, t, at[None], step))[0])
    reach = np.full(len(at), 4.0 * step)
    while reach[0] > 0.1 * step:
        moves = np.array([m for m in product((-1.0, 0.0, 1.0), repeat=len(at)) if any(m)])
        tried = at + moves * reach
        if len(at) > 1:
            tried[:, 1:] = np.maximum(tried[:, 1:], 2.0 * step)
        gains = course.gains(_evaluate_shapes(form, t, tried, step))
        k = int(np.argmax(gains))
        if gains[k] > gain * (1.0 + 1e-9):
            gain, at = float(gains[k]), tried[k]
        else:
            reach = 0.5 * reach
    return gain, at
