"""Young's modulus and Poisson's ratio from a motion (thesis 4.1.6, "System Identification")."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from diffsim import soft
from diffsim.contact import Obstacle
from examples.applications.application import Application, Array, Parameters

TRUTH_RTOL = 1e-8
"""Tolerance of the truth's steps: its rounding is not that of the simulation fitted to it."""

Move = Callable[[soft.SoftBody, soft.Physics, int], Tensor]
"""Positions of all steps, (num_steps + 1, num_nodes, 3) [m], of a body, its parameters, and how
many steps there are."""


def identification(
    *,
    name: str,
    title: str,
    source: str,
    body: soft.SoftBody,
    truth_body: soft.SoftBody,
    move: Move,
    steps: int,
    truth: tuple[float, float],
    lower: tuple[float, float],
    upper: tuple[float, float],
    first: tuple[float, float],
    obstacles: Sequence[Obstacle] = (),
    warm_up_steps: int | None = None,
) -> Application:
    """The application that finds log E and log nu of the motion of ``truth_body``.

    The loss is the sum over steps, nodes and axes of the squared difference in position [m^2],
    as in the thesis.

    Args:
        name, title, source: The same as in :class:`Application`.
        body: What is fitted.
        truth_body: What made the data: the same mesh, another tolerance, perhaps another
            integrator. It moves when the first loss is asked for, once.
        move: Simulates either.
        steps: Number of steps of the motion.
        truth: E [Pa] and nu [-] of the data.
        lower, upper, first: Bounds of E and nu, and the first guess.
        obstacles: Obstacles for pictures.
        warm_up_steps: Fit so many first steps before all, None: not. Far from the truth a long
            motion is out of step with the data, and its loss has many minima.
    """

    if warm_up_steps is not None and not 0 < warm_up_steps < steps:
        raise ValueError(
            f"warm_up_steps must be positive and below steps = {steps}, got {warm_up_steps}"
        )

    def physics(of: soft.SoftBody, logarithms: Tensor) -> soft.Physics:
        return of.physics(youngs_modulus=logarithms[0].exp(), poissons_ratio=logarithms[1].exp())

    @cache
    def target() -> Tensor:
        with torch.no_grad():
            return move(truth_body, physics(truth_body, torch.tensor(np.log(truth))), steps)

    def loss(_logarithms: Tensor, x: Tensor) -> Tensor:
        return (x - target()[: len(x)]).square().sum()

    def numbers(values: Array, x: Tensor) -> Mapping[str, float]:
        off = (x.detach() - target()[: len(x)]).square().sum(-1).mean().sqrt()
        modulus, ratio = np.exp(values)
        return {"E MPa": modulus / 1e6, "nu": ratio, "off the data, RMS mm": 1e3 * float(off)}

    def of_steps(count: int, warm_up: Application | None) -> Application:
        return Application(
            name=name,
            title=title,
            source=source,
            body=body,
            parameters=Parameters(
                names=("log E", "log nu"),
                lower=np.log(lower),
                upper=np.log(upper),
                first=np.log(first),
            ),
            simulate=lambda logarithms: move(body, physics(body, logarithms), count),
            loss=loss,
            numbers=numbers,
            oracle_parameters=np.log(truth),
            obstacles=obstacles,
            warm_up=warm_up,
        )

    return of_steps(steps, None if warm_up_steps is None else of_steps(warm_up_steps, None))


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """What a motion shows of log E and log nu, linearized."""

    # (2, 2) [m^2]; ``p @ metric @ p`` is the mean square displacement of the nodes over the whole
    # motion when (log E, log nu) change by p. Half the Hessian of the loss at a perfect fit, per
    # node and step.
    metric: Array
    alone: Array  # RMS displacement per unit of log E and of log nu, the other held [m]
    together: Array  # the same with the other chosen to hide it as well as it can [m]
    # the combination of (log E, log nu), of length one, that shows least, and how much it moves the
    # nodes [m]
    weak: tuple[Array, float]

    def uncertainty(self, off: float) -> Array:
        """Errors of log E and log nu that an RMS error ``off`` [m] of the data can cause at worst:
        if it has the very shape of what the parameter does."""
        return off / self.together


def visibility(application: Application, values: Array, step: float = 0.01) -> Visibility:
    """Central differences of the motion by ``step`` in each logarithm: four simulations."""
    columns = []
    for k in range(2):
        shift = step * np.eye(2)[k]
        moved = application.simulate(torch.as_tensor(values + shift)) - application.simulate(
            torch.as_tensor(values - shift)
        )
        columns.append((moved / (2.0 * step)).reshape(-1, 3))
    metric = np.array([[float((a * b).sum(-1).mean()) for b in columns] for a in columns])
    sizes, directions = np.linalg.eigh(metric)
    return Visibility(
        metric=metric,
        alone=np.sqrt(np.diag(metric)),
        together=1.0 / np.sqrt(np.diag(np.linalg.inv(metric))),
        weak=(directions[:, 0], float(np.sqrt(sizes[0]))),
    )
