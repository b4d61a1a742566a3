"""Commands that make channels follow a course, found through the gradient of a diagnosed model.

::

    seconds: 1.6                 # of the command
    every: 0.02                  # between its samples [s]
    knots: 16                    # of each command, straight lines between
    commands: {moment_Nm: {least: -2, most: 2}}      # default: limits of the study's commands
    start: {z_m: 1.0}            # of a multicopter; default: at rest, level, at the origin
    wanted:
      angle_rad: {course: "0.8*(1 - cos(pi*min(t/1.2, 1)))/2", miss: 0.01, since: 0.0}
    calm: 0.001                  # price of a change over the whole range from knot to knot
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BeforeValidator, Field, model_validator
from torch import Tensor

from diffsim import optim
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.expression import parse_expression
from diffsim.core.schema import FinitePart, read_part
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.study import Study
from diffsim.systems.twin import Twin

TIME = "t"
EVALUATIONS = 300  # of each search
NUDGE = 0.02  # of a command's range: how far the first commands are from rest
_WALL = optim.Wall(failures=(DiffsimError, ValueError))


class Bounds(FinitePart):
    """Least and greatest value of a command."""

    least: float = Field(description="Least value")
    most: float = Field(description="Greatest value")
    rest: float | None = Field(None, description="At which it begins; default: 0, else the middle")

    @model_validator(mode="after")
    def _check_order(self) -> Bounds:
        rest = self.least if self.rest is None else self.rest
        if not self.least <= rest <= self.most:
            raise ValueError(
                f"least, rest, most must rise, got {self.least:g}, {self.rest}, {self.most:g}"
            )
        return self

    @property
    def rest_share(self) -> float:
        """Share of the range at which the command is at rest."""
        rest = self.rest
        if rest is None:
            rest = 0.0 if self.least <= 0.0 <= self.most else 0.5 * (self.least + self.most)
        span = self.most - self.least
        return (rest - self.least) / span if span else 0.0


class Course(FinitePart):
    """What a channel shall show."""

    course: Annotated[str, BeforeValidator(str)] = Field(description="Formula of the time t")
    miss: float = Field(gt=0, description="A miss that counts as one, in the channel's unit")
    since: float = Field(0.0, description="Time from which it counts, in s")


class Tracking(FinitePart):
    """A task: commands within bounds, channels that shall follow courses."""

    seconds: float = Field(gt=0, description="Length of the command, in s")
    every: float = Field(gt=0, description="Time between its samples, in s")
    knots: int = Field(16, ge=2, le=10_000, description="Knots of each command")
    commands: dict[str, Bounds] = Field({}, description="Bounds of commands, by name")
    wanted: dict[str, Course] = Field(min_length=1, description="Courses of channels, by name")
    calm: float = Field(1e-3, ge=0, description="Price of a change from knot to knot")
    setup: dict[str, Any] = Field({}, description="Facts of the run")
    start: dict[str, float] = Field(
        {}, description="What channels of a multicopter show at first; default: at rest, level, 0"
    )

    @classmethod
    @checked
    def read(cls, path: str | Path) -> Tracking:
        """Read a task from YAML.

        Raises:
            Mistakes: a line for each mistake in the file.
        """
        return read_part(cls, read_yaml_file(path), str(path))

    @property
    def time_s(self) -> Array:
        """Sample times, (num_samples,) [s]."""
        return self.every * np.arange(round(self.seconds / self.every) + 1.0)

    @checked
    def for_study(self, study: Study) -> TrackingTask:
        """The task with the study's channels and limits of commands.

        Raises:
            ValueError: a channel or command that the study does not have, or one without bounds.
        """
        channels = [c.name for c in study.channels]
        for name in self.wanted:
            require_choice("wanted: channel", name, channels)
        t = torch.from_numpy(self.time_s)
        miss = torch.full((len(channels),), math.inf, dtype=torch.float64)
        since, courses = torch.zeros_like(miss), torch.zeros(len(t), len(channels)).double()
        for name, course in self.wanted.items():
            at = channels.index(name)
            formula = parse_expression(course.course, (TIME,))
            courses[:, at] = formula({TIME: t}).expand(len(t))
            miss[at], since[at] = course.miss, course.since
        counts = (t[:, None] >= since) & miss.isfinite()
        bounds = {name: self._bounds_of(name, study) for name in study.runs[0].command}
        return TrackingTask(self, bounds, courses, counts / miss / counts.sum().sqrt())

    def _bounds_of(self, name: str, study: Study) -> Bounds:
        if name in self.commands:
            return self.commands[name]
        given = next((c for c in study.commands if c.name == name), None)
        if given is None or given.lower is None or given.upper is None:
            raise ValueError(
                f"command {name} has no bounds; give `commands: {{{name}: {{least: ..., most: "
                "...}}` in the task, or lower and upper in the study"
            )
        return Bounds(least=given.lower, most=given.upper)


@dataclass(frozen=True, eq=False)
class TrackingTask:
    """A task of a study.

    Attributes:
        given: The task as stated.
        bounds: Of every command of the study.
        courses: What channels shall show, (num_samples, num_channels).
        weights: Of misses, so that the sum of their squares is a mean, (num_samples, num_channels).
    """

    given: Tracking
    bounds: Mapping[str, Bounds]
    courses: Tensor
    weights: Tensor

    @property
    def num_knots(self) -> int:
        """Numbers that are sought."""
        return self.given.knots * len(self.bounds)

    @checked
    def commands(self, knots: Tensor) -> dict[str, Tensor]:
        """Commands by name, (num_samples,) each, from knots within 0 and 1, (num_knots,).

        The first knot of each command is at rest, as lags and delays have it before: at zero, or
        at the middle of bounds that leave zero out, if ``rest`` does not say where.
        """
        rows = torch.from_numpy(_lines(self.given.knots, len(self.given.time_s)))
        own = knots.reshape(len(self.bounds), -1)
        begin = torch.tensor(self._rest, dtype=torch.float64)[:, None]
        shares = torch.cat([begin, own[:, 1:]], 1) @ rows.mT
        return {
            name: b.least + (b.most - b.least) * share
            for (name, b), share in zip(self.bounds.items(), shares, strict=True)
        }

    @checked
    def misses(self, channels: Tensor) -> Tensor:
        """Weighted misses, (..., num_samples, num_channels): their squares add up to a mean."""
        return self.weights * (channels - self.courses)

    @checked
    def score(self, channels: Tensor) -> Tensor:
        """Root mean square of the misses, in units of ``miss``, (...)."""
        return self.misses(channels).square().sum((-2, -1)).sqrt()

    @checked
    def calm(self, knots: Tensor) -> Tensor:
        """Changes from knot to knot, weighted so that the sum of their squares is the price."""
        steps = knots.reshape(len(self.bounds), -1).diff(dim=-1)
        return math.sqrt(self.given.calm / steps.numel()) * steps.flatten()

    @property
    def _rest(self) -> list[float]:
        """Share of each command's range at which it is at rest."""
        return [bounds.rest_share for bounds in self.bounds.values()]

    @property
    def near_rest(self) -> Array:
        """Knots of commands about rest.

        They move a little: at rest in a play, or in dry friction, a command has no slope.
        """
        middle = np.repeat(self._rest, self.given.knots)
        return np.clip(middle + NUDGE * np.sin(np.arange(1.0, len(middle) + 1.0)), 0.0, 1.0)


def _lines(num_knots: int, num_samples: int) -> Array:
    """(num_samples, num_knots): straight lines between knots, the first and last at the ends."""
    place, knots = np.linspace(0.0, num_knots - 1.0, num_samples), np.arange(num_knots)
    return np.stack([np.interp(place, knots, hat) for hat in np.eye(num_knots)], axis=1)


@checked
@dataclass(frozen=True, eq=False)
class BestCommand:
    """Commands that a model finds best.

    Attributes:
        knots: Within 0 and 1, (num_knots,).
        score: Root mean square of the misses that the model promises, in units of ``miss``.
        num_evaluations: Simulations with gradient.
    """

    knots: Array
    score: float
    num_evaluations: int


@checked
def best_command(
    twin: Twin,
    task: TrackingTask,
    *,
    at: Tensor | None = None,
    starts: Sequence[Array] | None = None,
    evaluations: int = EVALUATIONS,
) -> BestCommand:
    """The commands with the least mean square of misses, by L-BFGS-B from each start.

    Causes such as play and friction leave commands without a slope here and there; the plain
    model's best commands are a start beyond that.

    Args:
        twin: Model, planned for the task's time and set-up.
        task: What is wanted.
        at: Standardized parameters to be good at in the mean, (K, num_base); None: the file's.
        starts: Knots to start at beside commands near rest; None: those that are best for the
            plain model.
        evaluations: Of each search.

    Raises:
        ArithmeticError: no start has a finite miss and slope.
    """

    def cost(x: Array) -> optim.Sample:
        knots = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        seen = twin.simulate(task.commands(knots), at)
        squares = task.misses(seen).square().sum((-2, -1)).mean()
        loss = squares + task.calm(knots).square().sum()
        (slope,) = torch.autograd.grad(loss, knots)
        return optim.Sample(loss.item(), slope.numpy(), {"score": math.sqrt(squares.item())})

    if starts is None:
        plain = twin.plain() if twin.causes else None
        starts = [] if plain is None else [best_command(plain, task, evaluations=evaluations).knots]
    lower, upper = np.zeros(task.num_knots), np.ones(task.num_knots)
    options = optim.Options(budget=optim.Budget(evaluations), wall=_WALL)
    found: list[optim.Result] = []
    failures: list[Exception] = []
    for start in (task.near_rest, *starts):
        try:
            found.append(optim.minimize(cost, start, (lower, upper), options))
        except (
            DiffsimError,
            ArithmeticError,
        ) as error:  # where dry friction holds all still, slopes are no numbers
            failures.append(error)
    if not found:
        raise failures[-1]
    best = min(found, key=lambda result: result.value)
    return BestCommand(best.x, best.best.notes["score"], sum(r.num_evaluations for r in found))
