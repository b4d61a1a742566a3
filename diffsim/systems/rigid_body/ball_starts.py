"""Where balls start: stated, or guessed from the first samples of a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.data.study import Run
from diffsim.identify.model import Parameter
from diffsim.systems.description import Quantity
from diffsim.systems.rigid_body.parts import AXES, Body, Starts

Seen = Callable[[Run, Body], Array]  # places of a ball, (num_samples, 3) [m], NaN where unseen

#: Standard deviations of what the data's first guess leaves open.
PLACE_SD, SPEED_SD, ROLL_SD, SPIN_SD = 0.02, 0.2, 0.3, 0.3
FILMED_SD, FILMED_SPEED_SD = 0.2, 1.0  # in flight, through one camera
_SAMPLES = 10


class BallStarts:
    """Base parameters of the starts of all balls, and their names in a run.

    Args:
        starts: Which runs share a start.
        runs: Runs of the study.
        seen: Places of a ball as a run shows them.
        gravity: Strength of gravity [m/s^2].
        filmed: Balls that a camera shows: in flight their distance is told by their fall alone.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        starts: Starts,
        runs: Sequence[Run],
        seen: Seen,
        gravity: float,
        filmed: frozenset[str] = frozenset(),
    ):
        self.starts, self.bodies = starts, bodies
        self.base: list[Parameter] = []
        self.known: dict[str, float] = {}
        self.names: dict[str, dict[str, str]] = {}  # by what follows a parameter's name
        first: dict[str, Run] = {}
        for run in sorted(runs, key=lambda r: (r.order, float(r.time_s[0]))):
            first.setdefault(self._label_run(run), run)
        for label, run in first.items():
            for body in bodies:
                is_rough = body.name in filmed and body.begins == "flying"
                made = _list_quantities(body, run, seen, gravity, self.at(run), is_rough)
                for key, quantity in made.items():
                    name = key + label
                    if quantity.is_fitted:
                        self.base.append(quantity.parameter(name))
                    else:
                        self.known[name] = quantity.value
                    self.names.setdefault(label, {})[key] = name

    def in_run(self, values: Mapping[str, Tensor], run: Run) -> dict[str, Tensor]:
        """Start of every ball in a run.

        Args:
            values: Values of the base parameters by name, () or (K,) each.
        """
        return {
            key: values[name]
            if name in values
            else torch.tensor(self.known[name], dtype=torch.float64)
            for key, name in self.names[self._label_run(run)].items()
        }

    def at(self, run: Run) -> float:
        """Time of a run's start [s]."""
        return float(run.time_s[0]) if self.starts.per == "run" else self.starts.at

    def _label_run(self, run: Run) -> str:
        """What follows a parameter's name: "@run_1" per run, "[throw=2]" per fact."""
        per = self.starts.per
        if per == "run":
            return f"@{run.name}"
        if per == "once":
            return ""
        if per not in run.setup:
            raise ValueError(
                f"starts.per: run {run.name} has no {per} in its setup"
                f"{did_you_mean(per, run.setup)}"
            )
        return f"[{per}={run.setup[per]}]"


def _list_quantities(
    body: Body, run: Run, seen: Seen, gravity: float, at: float, is_rough: bool
) -> Mapping[str, Quantity]:
    """Start of one ball: stated, else by its first places."""
    flies, moves = body.begins == "flying", body.begins != "at_rest"
    axes = AXES if flies else AXES[:2]
    place, speed = np.zeros(3), np.zeros(3)
    stated = body.start
    if len(stated.place) < len(axes) or (moves and len(stated.velocity) < len(axes)):
        place, speed = _guess_start(run, seen(run, body), gravity if flies else 0.0, at, moves)
    out: dict[str, Quantity] = {}
    n = body.name
    place_sd, speed_sd = (FILMED_SD, FILMED_SPEED_SD) if is_rough else (PLACE_SD, SPEED_SD)
    for i, axis in enumerate(axes):
        guess = Quantity(value=float(place[i]), sd=place_sd, unit="m")
        out[f"{n}_{axis}"] = stated.place[i] if i < len(stated.place) else guess
        if moves:
            guess = Quantity(value=float(speed[i]), sd=speed_sd, unit="m/s")
            out[f"{n}_v{axis}"] = stated.velocity[i] if i < len(stated.velocity) else guess
    if moves:
        for i, axis in enumerate(AXES[:2]):
            rolls = 0.0 if flies else out[f"{n}_v{axis}"].value
            guess = Quantity(value=rolls, sd=ROLL_SD, unit="m/s")
            out[f"{n}_roll_{axis}"] = stated.roll[i] if i < len(stated.roll) else guess
    return out


def _guess_start(
    run: Run, places: Array, gravity: float, at: float, moves: bool
) -> tuple[Array, Array]:
    """Place and velocity at time ``at``: lines through the first samples, the fall taken out."""
    few = slice(0, _SAMPLES)
    if gravity > 0.0:
        few = slice(0, max(3, min(_SAMPLES, _count_falling(places[:, 2]))))
    time = run.time_s[few] - at
    place, speed = np.zeros(3), np.zeros(3)
    for i in range(3):
        column = places[few, i] + (0.5 * gravity * time**2 if i == 2 else 0.0)
        seen = np.isfinite(column)
        if not seen.any():
            continue
        if not moves or seen.sum() < 3:
            place[i] = column[seen][0]
            continue
        bend = 2 if seen.sum() > 5 and gravity == 0.0 else 1  # on the ground it slows down
        found = np.polyfit(time[seen], column[seen], bend)
        place[i], speed[i] = found[-1], found[-2]
    return place, speed


def _count_falling(height: Array) -> int:
    """Number of samples before the first bounce: until the height rises after it fell."""
    steps = np.diff(height)
    fell = False
    for i, step in enumerate(steps):
        fell = fell or step < 0.0
        if fell and step > 0.0:
            return i
    return len(height)
