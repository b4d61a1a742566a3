"""What one would do without a diagnosis: randomize the plain model, or learn what it lacks.

Both have the recordings that the diagnosis has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import optim
from diffsim.causes.signals import delayed
from diffsim.core.expression import parse_expression
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.extended import ExtendedModel, extended_at
from diffsim.identify.model_file import rebuilt, without_effects
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.registry import setup_of
from diffsim.systems.twin import Twin

Array = NDArray[np.float64]
WIDE = 0.2  # of every number of the data sheet: what is drawn around the plain fit
HIDDEN = 12  # tanh units of the network
BEFORE = 3  # samples of every command that it remembers
DECAY = 1e-4  # of its weights
EVALUATIONS = 150  # of each of its searches, the best of which the run for selection chooses
RESTARTS = 2


def randomized(plain: Twin, count: int, rng: np.random.Generator) -> Tensor:
    """Standardized parameters around the plain fit, (count, num_base), each within 20 %."""
    sheet = (plain.study.model or {})["parameters"]
    rows = np.zeros((count, len(plain.model.base)))
    for i, p in enumerate(plain.model.base):
        if p.name in sheet:
            factors = rng.uniform(1.0 - WIDE, 1.0 + WIDE, count)
            rows[:, i] = [p.coordinate_of(p.value * f) for f in factors]
    return torch.from_numpy(rows)


@dataclass(frozen=True, eq=False)
class Residual:
    """Accelerations that a network adds to the plain model, trained through the simulation.

    It sees all states, the commands, and what these were in the last samples.
    """

    effect: Effect  # the network as a cause, whose sizes are the weights
    weights: Tensor  # (num_weights,)
    # misfit_before, misfit_after: root mean squares of what is left of the run for selection, in
    # its sensors' noise
    misfit_before: float
    misfit_after: float

    def put_in(self, plain: Twin) -> Twin:
        """The plain twin with the network."""
        names = [f"network.{c}" for c in self.effect.components]
        sizes = dict(zip(names, self.weights.tolist(), strict=True))
        own = {p.name: p.value for p in plain.model.base}
        sd = {p.name: p.sd * (p.value if p.log else 1.0) for p in plain.model.base}
        model = extended_at(
            plain.model, (self.effect,), {**own, **sizes}, {**sd, **dict.fromkeys(names, 1.0)}
        )
        return replace(plain, model=model)


def learn_residual(twin: Twin, study: Study, rng: np.random.Generator) -> Residual:
    """Train the network on the runs that the diagnosis was fitted to.

    Args:
        twin: Of the diagnosis; only its plain model is used.
        study: The recordings.
        rng: Of the first weights.
    """
    setup = setup_of(twin.saved.framed(study))
    model = rebuilt(without_effects(twin.saved), setup)
    effect = _network(study, model)
    q, sd = model.at_prior(), torch.tensor([c.sd for c in study.channels], dtype=torch.float64)

    def left(runs: tuple[Run, ...], weights: Tensor) -> Tensor:
        squares = [
            ((model.predict(run, q, {effect: weights}) - torch.from_numpy(run.measured)) / sd)
            .square()
            .mean()
            for run in runs
        ]
        return torch.stack(squares).mean()

    none = torch.zeros(len(effect.components), dtype=torch.float64)
    with torch.no_grad():
        unit, before = left(study.fit_runs, none).item(), left(study.select_runs, none).item()

    def cost(x: Array) -> optim.Sample:
        weights = torch.tensor(x, dtype=torch.float64, requires_grad=True)
        loss = left(study.fit_runs, weights) / unit + DECAY * weights.square().sum()
        (slope,) = torch.autograd.grad(loss, weights)
        with torch.no_grad():
            unseen = left(study.select_runs, weights)
        return optim.Sample(loss.item(), slope.numpy(), {"unseen": unseen.item()})

    options = optim.Options(budget=optim.Budget(EVALUATIONS))
    tried: list[Any] = []
    for _ in range(RESTARTS):
        start = 0.3 * rng.standard_normal(len(none))
        start[-_num_outputs(study) * (HIDDEN + 1) :] = 0.0  # begins as the plain model
        tried += optim.minimize(cost, start, None, options).history
    best = min(tried, key=lambda e: e.notes.get("unseen", np.inf))
    return Residual(
        effect, torch.from_numpy(best.x), before**0.5, float(best.notes["unseen"]) ** 0.5
    )


def _num_outputs(study: Study) -> int:
    return len((study.model or {})["places"])


def _network(study: Study, model: ExtendedModel) -> Effect:
    """tanh units of states and commands, as formulas; inputs and outputs in usual magnitudes."""
    places = (study.model or {})["places"]
    scene: Any = model.scene(study.fit_runs[0], model.at_prior())
    with torch.no_grad():
        states = scene.solved()[1].abs().amax(-2)
    names = scene.begin()[0]
    seen = {n: float(s) or 1.0 for n, s in zip(names, states, strict=True)}
    rates = {p["velocity"]: seen[p["velocity"]] / 0.1 for p in places}
    for name, u in scene.inputs.items():
        reach = float(u.abs().max())
        seen |= {name: reach} | {f"{name} {k} before": reach for k in range(1, BEFORE + 1)}
    weights = iter(range(10**6))
    new = lambda: named(f"weight {next(weights)}")  # noqa: E731
    units = [_unit(seen, new) for _ in range(HIDDEN)]
    terms = {}
    for state, scale in rates.items():
        total = new()
        for unit in units:
            parts = {"a": total, "w": new(), "h": unit}
            total = filled(parse_expression("a + w*h"), parts)
        terms[state] = filled(parse_expression(f"{scale!r}*a"), {"a": total})
    count = next(weights)
    earlier = tuple(n for n in seen if n.endswith(" before"))
    return Effect(
        name="network",
        family="network",
        kind="force",
        unit="-",
        typical=1.0,
        components=tuple(f"weight_{k}" for k in range(count)),
        apply=partial(_apply, change=Change(rates=terms, inputs=earlier), count=count),
    )


def _unit(seen: dict[str, float], new: Any) -> Any:
    total = new()
    for name, scale in seen.items():
        parts = {"a": total, "w": new(), "z": named(name)}
        total = filled(parse_expression(f"a + w*z/{scale!r}"), parts)
    return filled(parse_expression("tanh(a)"), {"a": total})


def _apply(scene: Any, size: Tensor, run: Run, *, change: Change, count: int) -> Any:
    step = float(np.median(np.diff(run.time_s)))
    late = {
        f"{name} {k} before": delayed(u, scene.grid, torch.tensor(k * step, dtype=torch.float64))
        for name, u in scene.inputs.items()
        for k in range(1, BEFORE + 1)
    }
    known = replace(scene, inputs={**scene.inputs, **late})
    return known.with_change(change, {f"weight {k}": size[..., k] for k in range(count)})
