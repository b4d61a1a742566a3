"""Sizes of a named model fitted by the benchmark's rule itself, on flights of use fit.

A diagnosis fits windows of a tenth of a second whose start states are fitted, too. The rule asks
for half a second from the recorded state. Here the same parameters and sizes are moved until the
summed errors are least, each over that of holding everything in the same flight, so that a wild
flight counts no more than a calm one. Causes are neither added nor dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import yaml
from torch import Tensor

from benchmarks.ahead import AHEAD, Record, errors_ahead, flown, naive
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.identify.extended import ExtendedModel

_COMPARED = torch.arange(4, AHEAD, 5)  # samples ahead that count
_STEP = 0.05  # of difference quotients, in prior sd
_ROUNDS = 10
_FLOOR = 0.02  # of an error's length, over its mean: below it squares are minimized
_ENOUGH = 2e-3  # relative gain of a round


@dataclass(frozen=True, eq=False)
class Flights:
    """Starts of recorded flights."""

    runs: Sequence[Run]  # recorded runs, whole
    every: int  # samples from start to start
    # samples of a run that may be started from; None: all
    starts_of: Callable[[Run], Tensor] | None = None

    def errors(self, model: ExtendedModel, q: Tensor) -> Tensor:
        """Error vectors over the mean error of holding everything in the same flight.

        Returns:
            (num_starts, num_compared, 4, 3); attitude as a rotation vector.
        """
        out = []
        for run in self.runs:
            truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
            starts = torch.arange(self.every, len(truth.position) - AHEAD, self.every)
            counted = None
            if self.starts_of is not None:
                counted = self.starts_of(run)
                starts = counted[torch.isin(counted, starts)]
            got, want = flown(model, run, q)(starts), truth.after(starts)
            product = _relative(want.quaternion, got.quaternion)
            parts = (
                got.position - want.position,
                got.velocity - want.velocity,
                2.0 * product[..., 1:] * product[..., :1].sign(),
                got.rates - want.rates,
            )
            held = errors_ahead(naive(truth), truth, starts=counted).mean(0)
            out.append(torch.stack(parts, -2)[:, _COMPARED] / held[:, None])
        return torch.cat(out)


def _relative(a: Tensor, b: Tensor) -> Tensor:
    """Quaternion a^-1 b, (..., 4)."""
    scalar = (a * b).sum(-1, keepdim=True)
    v = (
        a[..., :1] * b[..., 1:]
        - b[..., :1] * a[..., 1:]
        - torch.linalg.cross(a[..., 1:], b[..., 1:])
    )
    return torch.cat([scalar, v], -1)


def objective(errors: Tensor) -> float:
    """Mean over the four columns of the error over that of holding everything."""
    return float(errors.norm(dim=-1).mean())


def fitted(
    model: ExtendedModel, free: Sequence[str], flights: Flights, rounds: int = _ROUNDS
) -> Mapping[str, float]:
    """Values by name after Gauss-Newton steps on reweighted squares.

    Args:
        model: Model whose priors are centered where the fit starts.
        free: Names of the parameters and sizes that are moved.
        flights: Flights to fit.
        rounds: Largest number of steps.
    """
    names = [p.name for p in model.base]
    columns = [names.index(name) for name in free]
    q, damping = model.at_prior().clone(), 1e-3
    errors = flights.errors(model, q)
    best = objective(errors)
    for _ in range(rounds):
        weight = errors.norm(dim=-1, keepdim=True).clamp(min=_FLOOR).rsqrt()
        slopes = []
        for column in columns:
            moved = q.clone()
            moved[column] += _STEP
            slopes.append(((flights.errors(model, moved) - errors) * weight / _STEP).flatten())
        tangent, left = torch.stack(slopes, 1), (errors * weight).flatten()
        normal, pull = tangent.T @ tangent, tangent.T @ left
        before = best
        for _ in range(5):
            raised = normal + damping * torch.diag(normal.diagonal())
            trial = q.clone()
            trial[columns] -= torch.linalg.solve(raised, pull)
            try:
                there = flights.errors(model, trial)
            except DiffsimError:  # it flies too far for the forces to settle
                damping *= 10.0
                continue
            if objective(there) < best:
                q, errors, best, damping = trial, there, objective(there), 0.3 * damping
                break
            damping *= 10.0
        print(f"  objective {best:.4f}", flush=True)
        if before - best < _ENOUGH * before:
            break
    return {p.name: float(p.value_at(v)) for p, v in zip(model.base, q, strict=True)}


def free_names(model: ExtendedModel, held: Sequence[str]) -> list[str]:
    """What is moved: all but what belongs to one run, and what is held."""
    return [p.name for p in model.base if "@" not in p.name and p.name not in held]


def save(model: ExtendedModel, values: Mapping[str, float], study: str, path: Path) -> None:
    """Write values as an ``extended_model.yaml`` without nuisances of single runs."""
    count = len(model.inner.base)
    widths = {p.name: p.sd * p.value if p.log else p.sd for p in model.base}
    entries = {
        p.name: {"value": values[p.name], "sd": widths[p.name], "unit": p.unit}
        for p in model.base
        if "@" not in p.name
    }
    plain = {p.name for p in model.inner.base[:count]}
    content = {
        "model": model.inner.name,
        "study": study,
        "verdict": "sizes fitted by the rule of benchmarks.ahead",
        "prepared_at": None,
        "parameters": {k: v for k, v in entries.items() if k in plain},
        "effects": {k: v for k, v in entries.items() if k not in plain},
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False))
