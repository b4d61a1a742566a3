"""L-BFGS-B on an application, every evaluation kept, so that an interrupted one goes on.

The optimiser is deterministic: run again, it asks for the same points in the same order, and those
on record are answered from there.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from tqdm import tqdm

from diffsim.applications.application import Application, Array
from diffsim.core.errors import ConvergenceError, DiffsimError
from diffsim.core.files import write_text_atomic


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
    """Where an optimisation ended.

    Attributes:
        best: The evaluation of the smallest loss.
        evaluations: All of them, in order; those of the starts that were only tried come first.
        num_starts: How many of them were tries of a start.
        num_warm_up: How many evaluations of the application's warm-up came before (not listed).
        converged: The optimiser ended by its own criteria, not by the limit of evaluations.
        message: Its reason.
    """

    best: Evaluation
    evaluations: list[Evaluation]
    num_starts: int
    converged: bool
    message: str
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


class Record:
    """Evaluations on file, one JSON line each; none is made twice."""

    def __init__(self, path: Path | None):
        self.path = path
        self._known: dict[tuple[tuple[float, ...], bool], Evaluation] = {}
        if path is not None and path.is_file():
            text = path.read_text()
            whole = text[: text.rfind("\n") + 1]
            if whole != text:  # an interruption cut the last line off
                write_text_atomic(path, whole)
            for line in whole.splitlines():
                row = json.loads(line)
                with_gradient = row.pop("with_gradient")
                found = Evaluation(**row)
                self._known[tuple(found.values), with_gradient] = found

    def at(self, application: Application, values: Array, *, gradient: bool = True) -> Evaluation:
        """The evaluation at a point: from the record, or made now and put there."""
        key = tuple(np.asarray(values, float).tolist()), gradient
        if key not in self._known:
            self._known[key] = found = evaluate(application, values, gradient=gradient)
            if self.path is not None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with self.path.open("a") as file:
                    file.write(json.dumps({**asdict(found), "with_gradient": gradient}) + "\n")
        return self._known[key]


class _Spent(Exception):
    """The limit of evaluations is reached."""


def minimise(
    application: Application,
    *,
    max_evaluations: int = 100,
    record: Path | None = None,
    seed: int = 0,
    ftol: float = 1e-9,
    gtol: float = 1e-9,
    progress: bool = False,
) -> Outcome:
    """Minimise the loss over the parameters by L-BFGS-B from the first guess.

    With ``num_starts`` above 1, the best of that many random points is the first guess (thesis
    4.1.6, "Torus"); with a ``warm_up``, what minimises that one.

    Args:
        application: What to minimise.
        max_evaluations: Of loss and gradient, starts not counted.
        record: File of the evaluations (JSON lines); what it holds is not computed again.
        seed: Of the random starts.
        ftol: Ends when the loss falls by less, relative to its size.
        gtol: Ends when the largest slope of the loss, relative to the application's scale (None:
            the first loss) and in the scaled parameters, is below.
        progress: Show a bar.

    Returns:
        :class:`Outcome`. A point whose simulation fails counts as infinitely bad: the line search
        steps back.

    Raises:
        DiffsimError: the simulation of the first guess fails.
    """
    parameters, kept = application.parameters, Record(record)
    num_warm_up = 0
    if application.warm_up is not None:
        before = minimise(
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
    starts, first = _starts(application, kept, seed, progress)
    at = parameters.scaled(first)
    begin = kept.at(application, parameters.values(at))  # what the optimiser asks for first
    if begin.failure:
        raise DiffsimError(f"{application.name}: the first guess fails: {begin.failure}")
    scale = application.scale or abs(begin.loss) or 1.0
    span = parameters.upper - parameters.lower
    made: list[Evaluation] = []
    bar = tqdm(total=max_evaluations, desc=application.name, leave=False, disable=not progress)

    def objective(scaled: Array) -> tuple[float, Array]:
        if len(made) >= max_evaluations:
            raise _Spent
        made.append(kept.at(application, parameters.values(scaled)))
        bar.update()
        bar.set_postfix(loss=f"{min(e.loss for e in made):.4g}")
        found = made[-1]
        if found.failure:  # a wall that the line search backs off from
            return 1e3 * max(1.0, abs(begin.loss) / scale), np.zeros(len(scaled))
        return found.loss / scale, np.array(found.gradient) * span / scale

    converged, message = False, f"limit of {max_evaluations} evaluations"
    try:
        result = minimize(
            objective,
            at,
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0, 1.0)] * len(span),
            options={"ftol": ftol, "gtol": gtol, "maxfun": 10**6, "maxiter": 10**6},
        )
        converged, message = bool(result.success), str(result.message)
    except _Spent:
        pass  # said in the outcome
    finally:
        bar.close()
    best = min(made, key=lambda e: e.loss)
    return Outcome(
        best=best,
        evaluations=starts + made,
        num_starts=len(starts),
        converged=converged,
        message=message,
        num_warm_up=num_warm_up,
    )


def _starts(
    application: Application, kept: Record, seed: int, progress: bool
) -> tuple[list[Evaluation], Array]:
    """Tries of random starts (none for a single one), and the point to begin at."""
    parameters = application.parameters
    if application.num_starts <= 1:
        return [], parameters.first
    rng = np.random.default_rng(seed)
    points = [parameters.random(rng) for _ in range(application.num_starts)]
    tries = [
        kept.at(application, p, gradient=False)
        for p in tqdm(points, desc=f"{application.name}, starts", leave=False, disable=not progress)
    ]
    return tries, np.array(min(tries, key=lambda e: e.loss).values)
