"""Formulas of a user's rows: what they may name beside their own signal, run by run.

Beside u, size and t a formula may name what was recorded: commands and columns of the files, their
means over a run, facts of the runs that are numbers, the order of the runs. It may remember: a
memory follows another formula with a first-order lag. And it may have further numbers, its shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from diffsim.causes.scene import grid_of
from diffsim.causes.signals import Grid, lagged
from diffsim.core.arrays import Array
from diffsim.core.expression import FUNCTIONS, Expression, parse_expression
from diffsim.core.schema import Part
from diffsim.data.study import Run, Study
from diffsim.identify.law import Shape

MEAN = "mean_of_"  # before the name of a command or column: its mean over the run
ORDER = "run_order"
#: names that mean something else in formulas
RESERVED = ("u", "size", "t", "x", "v", "w", "pi", "e", *FUNCTIONS)


class MemoryKeys(Part):
    """What a formula remembers: another formula, followed with a first-order lag."""

    of: str = Field(description="Formula of what is remembered")
    lasts: str = Field(description="How long [s]: a number, or the name of one of `shapes`")
    start: Literal["zero", "same"] = Field(
        "same", description="Where it begins: at `zero`, as heat does, or the `same` as `of`"
    )


class ShapeKeys(Part):
    """A further number of a formula: known, or fitted where it has an `sd`."""

    value: float = Field(description="Best guess beforehand")
    sd: float | None = Field(None, gt=0, description="Standard deviation of the prior")
    lower: float = Field(-np.inf, description="Lower bound")
    upper: float = Field(np.inf, description="Upper bound")
    unit: str = Field("-", description="SI unit")


def signals_of(study: Study) -> tuple[str, ...]:
    """Commands and columns that formulas may name, in every run of a study finite somewhere."""
    runs = study.fit_runs or study.runs
    names = dict.fromkeys(n for run in runs for n in (*run.command, *run.columns))
    taken = {*RESERVED, *(c.name for c in study.channels)}
    return tuple(
        n
        for n in names
        if n not in taken
        and n.isidentifier()
        and all(_is_recorded(run.command.get(n, run.columns.get(n))) for run in runs)
    )


def _is_recorded(values: Array | None) -> bool:
    return values is not None and bool(np.isfinite(values).any())


def facts_of(study: Study) -> tuple[str, ...]:
    """Facts that are numbers in all runs, by names that formulas may use."""
    runs = study.fit_runs or study.runs
    names = [n for n in runs[0].setup if n.isidentifier() and n not in RESERVED] if runs else []
    return tuple(n for n in names if all(is_number(run.setup.get(n)) for run in runs))


def is_number(fact: object) -> bool:
    """Whether a fact of a run is a number, which formulas may use."""
    return isinstance(fact, (int, float)) and not isinstance(fact, bool)


def constants_of(study: Study) -> tuple[str, ...]:
    """Names of what is constant over a run."""
    return (*facts_of(study), ORDER, *(MEAN + n for n in signals_of(study)))


def constant_in(run: Run, name: str) -> float:
    """Value of a fact, a mean or the order in a run.

    Raises:
        ValueError: the run does not have it.
    """
    if name == ORDER:
        return float(run.order)
    if name.startswith(MEAN) and name not in run.setup:
        return float(_samples(run, name.removeprefix(MEAN)).mean())
    fact = run.setup.get(name)
    if not is_number(fact):
        raise ValueError(f"run {run.name} has no number {name!r} in its setup, nor in its files")
    assert isinstance(fact, (int, float))
    return float(fact)


def _samples(run: Run, name: str) -> Array:
    """A recorded signal at the samples, empty cells filled in by straight lines."""
    values = np.asarray(run.command.get(name, run.columns.get(name, ())), dtype=np.float64)
    known = np.isfinite(values)
    if not known.any():
        raise ValueError(f"run {run.name} has no values of {name!r}")
    times = np.asarray(run.time_s, dtype=np.float64)
    return values if known.all() else np.interp(times, times[known], values[known])


@dataclass(frozen=True, eq=False)
class Memory:
    """What a formula remembers."""

    of: Expression
    lasts: str  # name of a shape, or a number [s]
    from_zero: bool  # whether it begins at zero, else as what it follows


@dataclass(frozen=True, eq=False)
class Formula:
    """A formula with what it remembers and its further numbers."""

    expression: Expression
    # known numbers by name: usual magnitudes, shapes without a prior
    numbers: Mapping[str, float] = field(default_factory=dict)
    memories: Mapping[str, Memory] = field(default_factory=dict)  # what it remembers, by name

    @property
    def names(self) -> frozenset[str]:
        """All names that it is made of, those of its memories too."""
        inner = (m.of.names for m in self.memories.values())
        return frozenset((*self.expression.names, *(n for names in inner for n in names)))

    def __call__(self, own: Mapping[str, Tensor], run: Run, grid: Grid | None = None) -> Tensor:
        """Its value in a run.

        Args:
            own: Signals (..., width, num_times), sizes and shapes that broadcast with them, by
                name; they come before what was recorded.
            grid: Times of the signals; None: nothing changes over the run.
        """
        known = {n: torch.tensor(v, dtype=torch.float64) for n, v in self.numbers.items()}
        known |= own
        for name, memory in self.memories.items():
            if name in self.expression.names:
                assert grid is not None
                known[name] = self._remember(memory, known, run, grid)
        return self.expression(self._fill_in(self.expression, known, run, grid))

    def _fill_in(
        self, expression: Expression, known: Mapping[str, Tensor], run: Run, grid: Grid | None
    ) -> dict[str, Tensor]:
        """Values of all names of a formula."""
        out = {}
        for name in expression.names:
            if name in known:
                out[name] = known[name]
            elif grid is not None and (name in run.command or name in run.columns):
                out[name] = _read_at(torch.from_numpy(_samples(run, name)), run, grid)
            else:
                out[name] = torch.tensor(constant_in(run, name), dtype=torch.float64)
        return out

    def _remember(
        self, memory: Memory, known: Mapping[str, Tensor], run: Run, grid: Grid
    ) -> Tensor:
        # a simulated signal is known where its grid is; what was recorded, over the whole run
        is_recorded = not any(n in known for n in memory.of.names)
        at = grid_of(run) if is_recorded else grid
        u = memory.of(self._fill_in(memory.of, known, run, at))
        lasts = known.get(memory.lasts)
        if lasts is None:
            lasts = torch.tensor(float(memory.lasts), dtype=torch.float64)
        lasts = lasts[..., 0] if lasts.ndim else lasts  # one for each row of signals
        out = _follow(u, at, lasts, from_zero=memory.from_zero)
        return _read_at(out, run, grid) if is_recorded else out


def _follow(u: Tensor, grid: Grid, lasts: Tensor, *, from_zero: bool) -> Tensor:
    out = lagged(u, grid, lasts)
    if not from_zero:
        return out
    since = grid.times - grid.times[0]
    return out - u[..., :1] * torch.exp(-since / lasts[..., None].clamp(min=1e-12))


def _read_at(values: Tensor, run: Run, grid: Grid) -> Tensor:
    """What is known at the samples of a run, (..., num_samples), at the times of a grid: straight
    in between, held beyond the ends."""
    times = torch.from_numpy(np.asarray(run.time_s, dtype=np.float64) - float(run.time_s[0]))
    place = grid.since_start
    if place.shape == times.shape and bool((place - times).abs().max() < 1e-9):
        return values
    flat = place.reshape(-1)
    if len(times) < 2:
        return values[..., [0] * len(flat)].reshape(*values.shape[:-1], *place.shape)
    left = (torch.searchsorted(times, flat.contiguous(), right=True) - 1).clamp(0, len(times) - 2)
    share = ((flat - times[left]) / (times[left + 1] - times[left])).clamp(0.0, 1.0)
    out = values[..., left] * (1.0 - share) + values[..., left + 1] * share
    if place.ndim == 1:
        return out
    out = out.unflatten(-1, (place.shape[0], -1)).movedim(-2, 0)  # windows come first
    return out.reshape(out.shape[0], *[1] * (place.ndim - out.ndim), *out.shape[1:])


def parse_formula(
    text: str,
    known: Sequence[str],
    scales: Mapping[str, float],
    memories: Mapping[str, MemoryKeys],
    shapes: Mapping[str, ShapeKeys],
) -> Formula:
    """A formula as a row states it.

    Args:
        known: Names that it may use beside the following.
        scales: Usual magnitudes by name.
        shapes: Its further numbers.

    Raises:
        ValueError: no formula, or a name that is not known; the message offers the closest.
    """
    inner = (*known, *scales, *shapes)
    made = {}
    for name, keys in memories.items():
        lasts = parse_expression(keys.lasts, tuple(shapes))
        if lasts.names != (keys.lasts.strip(),) and lasts.names:
            raise ValueError(f"lasts of {name} must be a number or the name of a shape")
        made[name] = Memory(parse_expression(keys.of, inner), keys.lasts, keys.start == "zero")
    expression = parse_expression(text, (*inner, *memories))
    used = {*expression.names, *(n for m in made.values() for n in m.of.names)}
    numbers = {n: v for n, v in scales.items() if n in used}
    numbers |= {n: s.value for n, s in shapes.items() if s.sd is None}
    return Formula(expression, numbers, made)


def fitted_shapes(shapes: Mapping[str, ShapeKeys], cause: str) -> dict[str, Shape]:
    """Shapes with a prior, by name of the base parameter that each is."""
    return {
        f"{name}_of_{cause}": Shape(s.value, s.sd, s.unit, s.lower, s.upper)
        for name, s in shapes.items()
        if s.sd is not None
    }
