"""Fit positive parameters by the gradient through a simulation: bounded L-BFGS in log space."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """A positive parameter: where to start and what to believe possible, in its unit."""

    start: float
    low: float
    high: float
    unit: str

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
    residual: Callable[[Mapping[str, Tensor]], Tensor],
    unknowns: Mapping[str, Unknown],
    *,
    max_evaluations: int = 30,
    rtol: float = 1e-5,
    on_step: Callable[[dict[str, float]], None] | None = None,
) -> Fit:
    """Least squares over log parameters.

    Args:
        residual: Parameters (0-d float64 tensors) -> residuals of any shape, differentiable.
        unknowns: What to fit.
        max_evaluations: Of simulation and gradient.
        rtol: Stop when the cost falls by less than this share.
        on_step: Called after every evaluation, for a progress bar.
    """
    # L-BFGS's first step has length one at most: in units of 10 % it cannot leap to a bound,
    # from where an oscillation is out of phase and the cost is full of side minima.
    unit = 0.1
    names = list(unknowns)
    history: list[dict[str, float]] = []
    scale = 0.0

    def evaluate(scaled: Array) -> tuple[float, Array]:
        nonlocal scale
        leaf = torch.tensor(scaled, dtype=torch.float64, requires_grad=True)
        values = (unit * leaf).exp()
        r = residual({name: values[i] for i, name in enumerate(names)})
        cost = 0.5 * r.pow(2).mean()
        (gradient,) = torch.autograd.grad(cost, leaf)
        scale = scale or max(float(cost.detach()), 1e-300)  # of order one for L-BFGS
        step = {name: float(values[i].detach()) for i, name in enumerate(names)}
        history.append({**step, "rms": float(np.sqrt(2.0 * float(cost.detach())))})
        if on_step is not None:
            on_step(history[-1])
        return float(cost.detach()) / scale, gradient.numpy() / scale

    start = np.log([u.start for u in unknowns.values()]) / unit
    bounds = [(np.log(u.low) / unit, np.log(u.high) / unit) for u in unknowns.values()]
    optimize.minimize(
        evaluate,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxfun": max_evaluations, "ftol": rtol, "gtol": 1e-7},
    )
    best = min(history, key=lambda step: step["rms"])
    value = {name: best[name] for name in names}
    std, correlation = _uncertainty(residual, value)
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
    residual: Callable[[Mapping[str, Tensor]], Tensor], value: dict[str, float]
) -> tuple[dict[str, float], Array]:
    """From J'J; columns of J by central differences of 1 % in each parameter."""
    names, step = list(value), 0.01

    def at(changed: str, factor: float) -> Array:
        p = {n: value[n] * (factor if n == changed else 1.0) for n in names}
        with torch.no_grad():
            r = residual({n: torch.tensor(v, dtype=torch.float64) for n, v in p.items()})
        return r.numpy().ravel()

    columns = [(at(n, np.exp(step)) - at(n, np.exp(-step))) / (2 * step) for n in names]
    left = at(names[0], 1.0)
    jacobian = np.column_stack(columns)
    variance = float(left @ left) / max(len(left) - len(names), 1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / np.outer(sigma, sigma)
    return {n: float(value[n] * s) for n, s in zip(names, sigma, strict=True)}, correlation
