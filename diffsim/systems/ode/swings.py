"""What may swing in a run with a period of its own, such as a gust: read off the record and fitted.

A definition gains ``sine sin(2 pi f t) + cosine cos(2 pi f t)``. Amplitudes and frequency are
numbers of each run, so that a run that was never fitted has its own. A fit finds a frequency only
from nearby: with n periods in a run, misfit has a minimum every half a period more or less. So the
plain model is asked first which frequency takes most off what it leaves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.data.study import Run
from diffsim.identify.law import FEWEST_PERIODS
from diffsim.identify.model import SimModel
from diffsim.systems.description import Quantity
from diffsim.systems.ode.keys import Swing

PER_LENGTH = 4  # frequencies tried per inverse length of a run
MOST_TRIED = 600
SPREAD = 0.25  # of the inverse length of a run: how far off the best frequency tried may be
_STEP = 0.1  # of a prior standard deviation, in difference quotients


def swing_names(swing: Swing) -> tuple[str, str, str]:
    """Parameters of a swing: its sine and cosine, and its frequency."""
    return f"{swing.name}_sine", f"{swing.name}_cosine", f"{swing.name}_frequency"


def swing_quantities(swings: Sequence[Swing]) -> dict[str, Quantity]:
    """Base parameters of swings, one of each for every run."""
    given = {}
    for swing in swings:
        sine, cosine, frequency = swing_names(swing)
        for name in (sine, cosine):
            given[name] = swing.typical.model_copy(
                update={"value": 0.0, "sd": swing.typical.value, "per": "run"}
            )
        given[frequency] = Quantity(value=1.0, sd=1.0, lower=0.0, per="run", unit="Hz")
    return given


def with_swings(define: Mapping[str, str], swings: Sequence[Swing]) -> dict[str, str]:
    """Definitions with what swings in them."""
    out = dict(define)
    for swing in swings:
        if swing.of not in out:  # a mistake, which is reported
            continue
        sine, cosine, frequency = swing_names(swing)
        angle = f"2*pi*{frequency}*t"
        out[swing.of] = f"({out[swing.of]}) + {sine}*sin({angle}) + {cosine}*cos({angle})"
    return out


def frequencies_to_try(run: Run) -> Array:
    """Frequencies [Hz] from two periods in the run up to a quarter of its rate, evenly."""
    length = float(np.ptp(run.time_s)) if len(run.time_s) > 1 else 0.0
    if length == 0.0:
        return np.zeros(0)
    highest = 0.25 / float(np.median(np.diff(run.time_s)))
    return np.arange(FEWEST_PERIODS / length, highest, 1.0 / (PER_LENGTH * length))[:MOST_TRIED]


def strongest_frequency(model: SimModel, swing: Swing, run: Run, tried: Array) -> float:
    """The frequency [Hz] that takes most off what the plain model leaves of a run.

    Whatever the base parameters could take off alone counts for none.

    Args:
        model: Plain model, with swings of amplitude zero.
        tried: Frequencies [Hz].
    """
    names = [p.name for p in model.base]
    sine, cosine, frequency = (names.index(f"{n}@{run.name}") for n in swing_names(swing))
    own = {sine, cosine, frequency}
    others = [
        i for i, n in enumerate(names) if i not in own and n.partition("@")[2] in ("", run.name)
    ]

    def moved(points: Tensor) -> Array:
        """Weighted responses at points, (num_points, num_readings)."""
        with torch.no_grad():
            predicted = model.predict_many(run, points).numpy()
        return np.asarray(((predicted - plain) * weight).reshape(len(points), -1)[:, there])

    def at_rest(num: int) -> Tensor:
        return torch.zeros(num, len(names), dtype=torch.float64)

    with torch.no_grad():
        plain = model.predict_many(run, model.at_prior()[None]).numpy()[0]
    left = np.asarray(run.measured) - plain
    spread = np.nanstd(left, axis=0)
    weight = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > 0.0)
    there = np.isfinite(left).ravel()
    steps = at_rest(len(others))
    steps[torch.arange(len(others)), torch.tensor(others)] = _STEP
    known = np.linalg.qr(moved(steps).T)[0]
    left = (left * weight).ravel()[there]
    left = left - known @ (known.T @ left)

    def gains(some: Array) -> list[float]:
        """What each frequency takes off the sum of squares."""
        points = at_rest(2 * len(some))
        at = [model.base[frequency].coordinate_of(float(hz)) for hz in some]
        points[:, frequency] = torch.tensor(at).repeat_interleave(2)
        points[0::2, sine] = points[1::2, cosine] = _STEP
        waves = moved(points)
        waves = waves - (waves @ known) @ known.T
        bases = (np.linalg.qr(pair.T)[0] for pair in waves.reshape(len(some), 2, -1))
        return [float(np.sum((basis.T @ left) ** 2)) for basis in bases]

    # frequencies that are simulated at once
    together = [tried[i : i + 32] for i in range(0, len(tried), 32)]
    return float(tried[int(np.argmax([gain for some in together for gain in gains(some)]))])
