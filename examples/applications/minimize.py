"""L-BFGS-B on an application, every evaluation kept, so that an interrupted one goes on."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffsim import optim
from diffsim.core import ConvergenceError, DiffsimError
from examples.applications.application import Application, Array

_TIMES = ("forward_s", "backward_s", "forward_cpu_s", "backward_cpu_s")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Loss and gradient at a point (in the parameters' own units), and what they cost.

    ``loss`` is infinite where a step's solver did not converge; ``failure`` then says how.
    """

    values: list[float]
    loss: float
    gradient: list[float]
    forward_s: float
    backward_s: float
    forward_cpu_s: float
    backward_cpu_s: float
    failure: str = ""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Where an optimization ended."""

    best: Evaluation  # the evaluation of the smallest loss
    # all of them, in order; those of the starts that were only tried come first
    evaluations: list[Evaluation]
    num_starts: int  # how many of them were tries of a start
    converged: bool  # the optimizer ended by its own criteria, not by the limit of evaluations
    message: str  # the optimizer's reason to stop
    # how many evaluations of the application's warm-up came before (not listed)
    num_warm_up: int = 0


def evaluate(application: Application, values: Array, *, gradient: bool = True) -> Evaluation:
    """One loss and (unless told not to) its gradient, timed."""
    p = torch.tensor(values, dtype=torch.float64, requires_grad=gradient)
    wall, cpu = [time.perf_counter()], [time.process_time()]

    def tick() -> None:
        wall.append(time.perf_counter())
        cpu.append(time.process_time())

    loss, slope, failure = float("inf"), np.zeros(len(values)), ""
    try:
        with torch.set_grad_enabled(gradient):
            value = application.loss(p, application.simulate(p))
        tick()
        if gradient:
            slope = torch.autograd.grad(value, p)[0].numpy()
        loss = float(value.detach())
    except ConvergenceError as err:
        failure = " ".join(str(err).split())
    while len(wall) < 3:
        tick()
    if not np.isfinite(slope).all():
        loss, slope, failure = float("inf"), np.zeros(len(values)), "gradient is not finite"
    return Evaluation(
        values=np.asarray(values, float).tolist(),
        loss=loss,
        gradient=slope.tolist(),
        forward_s=wall[1] - wall[0],
        backward_s=wall[2] - wall[1],
        forward_cpu_s=cpu[1] - cpu[0],
        backward_cpu_s=cpu[2] - cpu[1],
        failure=failure,
    )


def log_of(application: Application, path: Path | None) -> optim.Log:
    """The log of an application's evaluations; it refuses a file of other parameters.

    Raises:
        LogError: the file is of another application, other bounds or an older version.
    """
    parameters = application.parameters
    return optim.Log(
        path,
        {
            "application": application.name,
            "parameters": list(parameters.names),
            "lower": parameters.lower,
            "upper": parameters.upper,
        },
    )


def minimize(
    application: Application,
    *,
    max_evaluations: int = 100,
    record: Path | None = None,
    seed: int = 0,
    ftol: float = 1e-9,
    gtol: float = 1e-9,
    progress: bool = False,
) -> Outcome:
    """Minimize the loss over the parameters by L-BFGS-B from the first guess.

    With ``num_starts`` above 1, the best of that many random points is the first guess (thesis
    4.1.6, "Torus"); with a ``warm_up``, what minimizes that one.

    Args:
        application: What to minimize.
        max_evaluations: Largest number of evaluations of loss and gradient, starts not counted.
        record: File of the evaluations (see ``optim.Log``); what it holds is not computed again.
        seed: Seed of the random starts.
        ftol: Ends when the loss falls by less, relative to its size.
        gtol: Ends when the largest slope of the loss, relative to the application's scale (None:
            the first loss) and in the scaled parameters, is below.
        progress: Show a bar.

    Returns:
        :class:`Outcome`. A point whose simulation fails counts as a wall: the line search steps
        back.

    Raises:
        DiffsimError: the simulation of the first guess fails.
        LogError: ``record`` is of another application, other bounds or an older version.
    """
    num_warm_up = 0
    if application.warm_up is not None:
        before = minimize(
            application.warm_up,
            max_evaluations=max_evaluations,
            record=None if record is None else record.with_name(f"warm_up_{record.name}"),
            seed=seed,
            ftol=1e3 * ftol,
            gtol=1e3 * gtol,
            progress=progress,
        )
        num_warm_up, begin_at = len(before.evaluations), np.array(before.best.values)
        application = replace(
            application, parameters=replace(application.parameters, first=begin_at)
        )
    parameters, log = application.parameters, log_of(application, record)
    tried = _try_random_starts(application, log, seed, progress)
    first = parameters.first
    if tried:
        first = np.array(min(tried, key=lambda e: e.loss).values)
    options = optim.Options(
        budget=optim.Budget(max_evaluations),
        tolerances=optim.Tolerances(ftol=ftol, gtol=gtol),
        unit=application.scale or None,
    )
    zeros = np.zeros(len(parameters.names))
    with optim.progress_bar(application.name, max_evaluations, show=progress, leave=False) as bar:
        try:
            found = optim.minimize(
                lambda scaled: _sample(application, scaled),
                parameters.scaled(first),
                (zeros, zeros + 1.0),
                options,
                log=log,
                callback=bar,
            )
        except DiffsimError as err:
            raise DiffsimError(f"{application.name}: the first guess fails: {err}") from err
    made = [_as_evaluation(e, parameters.values(e.x)) for e in found.history]
    return Outcome(
        best=min(made, key=lambda e: e.loss),
        evaluations=tried + made,
        num_starts=len(tried),
        converged=found.converged,
        message=found.message,
        num_warm_up=num_warm_up,
    )


def losses_of(
    application: Application,
    points: Iterable[Array],
    log: optim.Log,
    name: str,
    *,
    progress: bool = False,
) -> list[Evaluation]:
    """Losses without gradient at points (num_parameters,) in the parameters' own units.

    Args:
        application: What is evaluated.
        points: Points at which the loss is asked for.
        log: What it holds is not computed again.
        name: Name of the list in the log.
        progress: Show a bar.
    """
    points = list(points)
    label = f"{application.name}, {name}"

    def loss(values: Array) -> optim.Sample:
        made = _successful(evaluate(application, values, gradient=False))
        return optim.Sample(made.loss, None, _collect_times(made))

    with optim.progress_bar(label, len(points), show=progress, leave=False) as bar:
        found = optim.screen(loss, points, log=log, name=name, callback=bar)
    return [_as_evaluation(e, e.x) for e in found]


def _try_random_starts(
    application: Application, log: optim.Log, seed: int, progress: bool
) -> list[Evaluation]:
    """Tries of random starts; none for a single start."""
    if application.num_starts <= 1:
        return []
    rng = np.random.default_rng(seed)
    points = [application.parameters.random(rng) for _ in range(application.num_starts)]
    return losses_of(application, points, log, "starts", progress=progress)


def _sample(application: Application, scaled: Array) -> optim.Sample:
    """Loss and its gradient in the parameters scaled to [0, 1]."""
    parameters = application.parameters
    made = _successful(evaluate(application, parameters.values(scaled)))
    slope = np.array(made.gradient) * (parameters.upper - parameters.lower)
    return optim.Sample(made.loss, slope, {"slope": made.gradient, **_collect_times(made)})


def _successful(made: Evaluation) -> Evaluation:
    if made.failure:
        raise DiffsimError(made.failure)
    return made


def _collect_times(made: Evaluation) -> dict[str, Any]:
    return {name: getattr(made, name) for name in _TIMES}


def _as_evaluation(e: optim.Evaluation, values: Array) -> Evaluation:
    """In the parameters' own units; a failed simulation costs its forward time."""
    times = {"forward_s": e.wall_s, "forward_cpu_s": e.cpu_s, "backward_s": 0.0}
    times = {**times, "backward_cpu_s": 0.0, **{n: e.notes[n] for n in _TIMES if n in e.notes}}
    return Evaluation(
        values=values.tolist(),
        loss=e.value,
        gradient=e.notes.get("slope", [0.0] * len(values)),
        failure=e.failure,
        **times,
    )
