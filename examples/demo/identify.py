"""Fit positive parameters by the gradient through a simulation: bounded L-BFGS in log space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import optim

Array = NDArray[np.float64]
Residual = Callable[[Mapping[str, Tensor]], Tensor]
Run = Callable[[Sequence[Callable[[], Any]]], list[Any]]


def in_turn(jobs: Sequence[Callable[[], Any]]) -> list[Any]:
    """Results of the jobs, one after the other."""
    return [job() for job in jobs]


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """A positive parameter: where to start and what to believe possible, in its unit.

    Attributes:
        start, low, high: In its unit.
        unit: For reports.
        step: Relative change that moves the simulation about as much as a ``step`` of the other
            unknowns does; also the largest first step. An oscillation is ten times as sensitive
            to stiffness (a phase, which grows with time) as to damping.
    """

    start: float
    low: float
    high: float
    unit: str
    step: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.low <= self.start <= self.high:
            raise ValueError(
                f"need 0 < low <= start <= high, got {self.low:g}, {self.start:g}, {self.high:g}"
            )


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes:
        value: By parameter.
        std: One standard deviation each, from the curvature J'J of the residuals; it takes what
            is left as white noise, so it is a lower bound where the model is wrong.
        correlation: (n, n) of the logarithms.
        undetermined: Parameters the data do not determine: on a bound, or with a standard
            deviation above half their value.
        history: Every evaluation: parameters and root mean square residual.
        num_evaluations: Simulations with gradient.
    """

    value: dict[str, float]
    std: dict[str, float]
    correlation: Array
    undetermined: tuple[str, ...]
    history: list[dict[str, float]]
    num_evaluations: int


def fit(
    residuals: Residual | Sequence[Residual],
    unknowns: Mapping[str, Unknown],
    *,
    max_evaluations: int = 30,
    rtol: float = 1e-5,
    on_step: Callable[[dict[str, float]], None] | None = None,
    run: Run = in_turn,
) -> Fit:
    """Least squares over log parameters.

    Args:
        residuals: Parameters (0-d float64 tensors) -> residuals of any shape, differentiable; or
            several such functions, one per trial: the cost is the mean of their mean squares.
        unknowns: What to fit.
        max_evaluations: Of simulation and gradient.
        rtol: Stop when the cost falls by less than this share.
        on_step: Called after every evaluation, for a progress bar.
        run: Runs independent jobs, perhaps side by side; their order does not matter.
    """
    # L-BFGS's first step has length one at most: in units of a few per cent it cannot leap to a
    # bound, from where an oscillation is out of phase and the cost is full of side minima.
    unit = np.array([unknown.step for unknown in unknowns.values()])
    trials = [residuals] if callable(residuals) else list(residuals)
    names = list(unknowns)

    def one(residual: Residual, scaled: Array) -> tuple[float, Array]:
        leaf = torch.tensor(scaled, dtype=torch.float64, requires_grad=True)
        values = (torch.from_numpy(unit) * leaf).exp()
        r = residual({name: values[i] for i, name in enumerate(names)})
        cost = 0.5 * r.pow(2).mean() / len(trials)
        (gradient,) = torch.autograd.grad(cost, leaf)
        return float(cost.detach()), gradient.numpy()

    def cost(scaled: Array) -> optim.Sample:
        parts = run([partial(one, residual, scaled.copy()) for residual in trials])
        value = sum(part[0] for part in parts)
        step = {name: float(np.exp(unit[i] * scaled[i])) for i, name in enumerate(names)}
        step["rms"] = float(np.sqrt(2.0 * value))
        return optim.Sample(value, np.sum([part[1] for part in parts], axis=0), step)

    def tell(progress: optim.Progress) -> None:
        if on_step is not None:
            on_step(dict(progress.evaluation.notes))

    bounds = [(np.log(u.low) / u.step, np.log(u.high) / u.step) for u in unknowns.values()]
    found = optim.minimize(
        cost,
        np.log([u.start for u in unknowns.values()]) / unit,
        (np.array([low for low, _ in bounds]), np.array([high for _, high in bounds])),
        optim.Options(
            budget=optim.Budget(max_evaluations),
            # a line search that needs more than a few trials is down in the solver's tolerance
            tolerances=optim.Tolerances(ftol=rtol, gtol=1e-7, line_search=4),
            wall=None,
            unit=None,
        ),
        callback=tell,
    )
    history = [dict(e.notes) for e in found.history]
    best = min(history, key=lambda step: step["rms"])
    value = {name: best[name] for name in names}
    std, correlation = _uncertainty(trials, value, run)
    return Fit(
        value=value,
        std=std,
        correlation=correlation,
        undetermined=tuple(
            name
            for name, u in unknowns.items()
            if min(value[name] / u.low, u.high / value[name]) < 1.0 + 1e-6
            or not std[name] < 0.5 * value[name]
        ),
        history=history,
        num_evaluations=len(history),
    )


def _uncertainty(
    trials: Sequence[Residual], value: dict[str, float], run: Run
) -> tuple[dict[str, float], Array]:
    """From J'J; columns of J by central differences of 1 % in each parameter."""
    names, step = list(value), 0.01

    def at(residual: Residual, changed: str, factor: float) -> Array:
        p = {n: value[n] * (factor if n == changed else 1.0) for n in names}
        with torch.no_grad():
            r = residual({n: torch.tensor(v, dtype=torch.float64) for n, v in p.items()})
        return r.numpy().ravel()

    points = [(names[0], 1.0)] + [(n, np.exp(sign * step)) for n in names for sign in (1, -1)]
    parts = run([partial(at, residual, *point) for point in points for residual in trials])
    count = len(trials)
    rows = [np.concatenate(parts[i * count : (i + 1) * count]) for i in range(len(points))]
    left = rows[0]
    columns = [(rows[1 + 2 * i] - rows[2 + 2 * i]) / (2 * step) for i in range(len(names))]
    jacobian = np.column_stack(columns)
    variance = float(left @ left) / max(len(left) - len(names), 1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / np.outer(sigma, sigma)
    return {n: float(value[n] * s) for n, s in zip(names, sigma, strict=True)}, correlation
