"""Where a law that nobody listed may enter a system that offers ports to causes of a user.

An entry is a port, and a law that was found is a row as a user could have written it. Systems of
formulas have more entries, in ``systems/ode/law_port``. Numbers stay the same over a run, so that
their laws are of what differs from run to run. A force knows position and speed of its place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.acting import ByFormula
from diffsim.causes.formulas import (
    ORDER,
    RESERVED,
    Formula,
    MemoryKeys,
    ShapeKeys,
    constant_in,
    constants_of,
    parse_formula,
    signals_of,
)
from diffsim.causes.plant import Plant
from diffsim.causes.ports import OF_FORCES
from diffsim.causes.scene import ForceLaw, grid_of
from diffsim.causes.signals import Grid
from diffsim.core.arrays import Array
from diffsim.data.study import Run
from diffsim.identify.effect import PRIOR_WIDTH, Effect
from diffsim.identify.law import (
    FEWEST_VALUES,
    LASTING,
    Entry,
    Gains,
    Law,
    Variable,
    put_variable,
    reading_entries,
)
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model import SimModel
from diffsim.identify.problem import Problem
from diffsim.identify.setup import LawPort, law_effect

_HIDDEN, _LASTING = "hidden", "lasting"
_USUAL = 0.1  # factor of a number, of which slopes are asked


@dataclass(frozen=True, eq=False, kw_only=True)
class PortLaws(LawPort):
    """Entries and variables of a system by its ports."""

    # makes the ports; asked for when laws are looked for, and not before
    offered: Callable[[], Plant | None]

    @cached_property
    def plant(self) -> Plant:
        """What the system offers."""
        found = self.offered()
        assert found is not None
        return found

    @cached_property
    def entries(self) -> Sequence[Entry]:
        """Channels, numbers where something differs from run to run, commands, places."""
        return tuple(self._list_entries())

    def _list_entries(self) -> Iterator[Entry]:
        plant = self.plant
        yield from reading_entries(self.study)
        if self._list_constants():
            for name in plant.numbers:
                yield Entry("number", name, "-", 1.0)
        for name in plant.commands:
            reach = plant.scales.of_commands((name,))["reach"]
            yield Entry("input", name, self._units.get(name, "-"), reach)
        for name, place in plant.places.items():
            yield Entry("force", name, place.unit, place.magnitudes["push"])

    @cached_property
    def _formula_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Signals, and what is constant over a run, that formulas may name."""
        return signals_of(self.study), constants_of(self.study)

    @cached_property
    def _units(self) -> dict[str, str]:
        kinds = (self.study.channels, self.study.commands, self.study.columns)
        return {c.name: c.unit for kind in kinds for c in kind if c.unit}

    def variables(self) -> Sequence[Variable]:
        """Channels, what was recorded, what differs between runs, and memories of these."""
        return tuple(self._list_variables())

    def _list_variables(self) -> Iterator[Variable]:
        of_kind = {e.target: e.words for e in self.entries if e.kind == "reading"}
        inputs = {e.target: e.words for e in self.entries if e.kind == "input"}
        numbers = [e.words for e in self.entries if e.kind == "number"]
        readings = list(of_kind.values())
        for name, words in (*of_kind.items(), *inputs.items()):
            yield from self._list_of(name, "u", (words,), is_turn=name in of_kind)
        for name in of_kind:
            # a system may add channels of its own, which formulas do not know
            if name in self.plant.channel_names and name.isidentifier() and name not in RESERVED:
                others = tuple(w for n, w in of_kind.items() if n != name)
                if others:
                    yield Variable(name, name, self._units.get(name, "-"), at=others)
        for name in self._formula_names[0]:
            at = (*readings, *(w for n, w in inputs.items() if n != name))
            yield from self._list_of(name, name, at)
        if self.plant.is_in_time and (readings or inputs):
            yield Variable("time", "t", "s", at=(*readings, *inputs.values()))
        for name in self._list_constants():
            said = "order of the runs" if name == ORDER else name.replace("_", " ")
            unit = self._units.get(name.removeprefix("mean_of_"), "-")
            yield Variable(said, name, unit, at=(*numbers, *readings))
        for place in (e for e in self.entries if e.kind == "force"):
            unit = "rad" if place.unit == "N m" else "m"
            yield Variable(f"position at {place.target}", "x", unit, at=(place.words,))
            yield Variable(f"speed at {place.target}", "v", f"{unit}/s", at=(place.words,))

    def _list_of(
        self, name: str, formula: str, at: tuple[str, ...], *, is_turn: bool = False
    ) -> Iterator[Variable]:
        """A signal and its memories."""
        if not at:
            return
        is_timed = self.plant.is_in_time
        unit = self._units.get(name, "-")
        yield Variable(name, formula, unit, at=at, is_turn=is_turn and is_timed)
        if not is_timed:
            return
        heat = MemoryKeys(of=f"{formula}**2", lasts=_LASTING, start="zero")
        lag = MemoryKeys(of=formula, lasts=_LASTING)
        for share in LASTING:
            kept: dict[str, Any] = {
                "of": name,
                "numbers": {_LASTING: share * self.plant.scales.longest_s},
                "number_units": {_LASTING: "s"},
                "at": at,
            }
            said = f"heat of {name}^2"
            yield Remembering(said, _HIDDEN, memory="heat", memories={_HIDDEN: heat}, **kept)
            said, behind = f"memory of {name}", f"{formula} - {_HIDDEN}"
            yield Remembering(said, behind, memory="relaxation", memories={_HIDDEN: lag}, **kept)

    def _list_constants(self) -> list[str]:
        """Names of what differs from run to run."""
        runs = self.study.fit_runs
        out = []
        for name in self._formula_names[1]:
            values = {constant_in(run, name) for run in runs}
            if len(values) >= FEWEST_VALUES:
                out.append(name)
        return out

    def gains(self, problem: Problem, x: Array, entry: Entry) -> Gains | None:
        """What a unit at an entry does along a run; None where only a simulation tells."""
        (run,) = problem.runs
        count, width = run.measured.shape
        readings = np.zeros((count, width))
        if entry.kind == "reading":
            readings[:, entry.channel] = 1.0
            model, (q, sizes) = problem.model, _point_of(problem, x)
            scene = partial(model.scene, run, q, sizes, problem.numerics)
            left = partial(model.left_of_readings, scene)
            return Gains(np.zeros((count, 0)), readings, left)
        if entry.kind == "number":
            effect = self.terms(entry, Variable("one", "1"), ("1",), "law", _USUAL)
            wide = replace(problem, effects=(*problem.effects, effect))
            at = linearization_at(wide, np.append(x, 0.0), [len(x)])
            readings = (at.columns / (PRIOR_WIDTH * effect.typical)).reshape(count, width)
        else:
            return None
        return Gains(np.zeros((count, 0)), readings)

    def courses(self, problem: Problem, x: Array, variables: Sequence[Variable]) -> list[Array]:
        """Variables as a problem simulates them, (num_samples, num_variables) for each run; of
        places their range alone, which their samples are spread over."""
        return [self._follow(problem, x, run, variables) for run in problem.runs]

    def _follow(self, problem: Problem, x: Array, run: Run, variables: Sequence[Variable]) -> Array:
        watched = self._watch(problem, x, run)
        count, grid = len(run.time_s), grid_of(run)
        shown = {c.name: watched.record[:, k] for k, c in enumerate(self.study.channels)}
        unknown = torch.full((count,), torch.nan, dtype=torch.float64)
        out = np.zeros((count, len(variables)))
        for k, variable in enumerate(variables):
            if variable.formula in ("x", "v"):
                seen = watched.forces[variable.name.partition(" at ")[2]].seen
                low, high = np.percentile(seen[variable.formula], [1.0, 99.0])
                out[:, k] = np.linspace(float(low), float(high), count)
                continue
            formula = self._read(variable.formula, variable)
            signal = variable.of or variable.name
            own = {"t": grid.since_start, **shown}
            own["u"] = shown.get(signal, watched.commands.get(signal, unknown))
            used = {n: v for n, v in own.items() if n in formula.names}
            out[:, k] = formula(used, run, grid).expand(count).numpy()
        return out

    def _watch(self, problem: Problem, x: Array, run: Run) -> _WatchedRun:
        """One simulation that is listened to at commands and places."""
        q, sizes = _point_of(problem, x)
        forces = {place: WatchedForce() for place in self.plant.places}
        signals = {name: _WatchedSignal() for name in self.plant.commands}
        with torch.no_grad():
            # of the base class: a scene that is known again would not be simulated
            scene: Any = SimModel.scene(problem.model, run, q, sizes, problem.numerics)
            for name, signal in signals.items():
                scene = scene.with_command((name,), signal)
            for place, force in forces.items():
                scene = scene.with_force(place, ForceLaw(force, torch.ones((), dtype=q.dtype)))
            problem.model.note_simulations(run, 1, problem.numerics)
            record = scene.simulate()
        commands = {n: s.at_samples(run) for n, s in signals.items() if s.seen}
        return _WatchedRun(record, commands, forces)

    def terms(
        self, entry: Entry, variable: Variable, terms: Sequence[str], name: str, typical: float
    ) -> Effect:
        """An effect whose components are the factors of terms of a variable."""
        factors = tuple(f"factor_{k}" for k in range(len(terms)))
        written = [put_variable(term, variable) for term in terms]
        total = " + ".join(f"{f}*{term}" for f, term in zip(factors, written, strict=True))
        text = f"u + {total}" if entry.kind in ("reading", "input") else total
        by = ByFormula(self._read(text, variable, factors), factors, num_sizes=0)
        acts = {
            "reading": lambda: by.at_readings((entry.channel,), self.plant.channel_names),
            "input": lambda: by.at_commands((entry.target,)),
            "number": lambda: by.at_numbers((entry.target,), is_factor=True),
            "force": lambda: by.at_place(entry.target),
        }
        return law_effect(name, entry, len(terms), typical, acts[entry.kind]())

    def _read(self, text: str, variable: Variable, more: Sequence[str] = ()) -> Formula:
        signals, constants = self._formula_names
        known = (*OF_FORCES, "u", "t", *more, *constants)
        names = (*known, *signals, *self.plant.channel_names)
        shapes = {n: ShapeKeys(value=v) for n, v in variable.numbers.items()}
        return parse_formula(text, names, {}, _memories_of(variable), shapes)

    def action(self, law: Law) -> Mapping[str, Any]:
        """Where a law acts and how, in the keys of a row."""
        entry, variable = law.entry, law.variable
        term = put_variable(law.term, variable)
        acts: dict[str, Any] = {
            "reading": {"at": "reading", "of": [entry.target], "map": f"u + {term}"},
            "input": {"at": "command", "of": [entry.target], "map": f"u + {term}"},
            "number": {"at": "number", "scale": [entry.target], "map": term},
            "force": {"at": "force", "of": [entry.target], "law": term},
        }[entry.kind]
        memories = {n: m.model_dump() for n, m in _memories_of(variable).items()}
        return {**acts, **({"memories": memories} if memories else {}), "tries": [-1.0, 1.0]}


def _point_of(problem: Problem, x: Array) -> tuple[Tensor, dict[Effect, Tensor]]:
    """Base parameters and sizes at standardized coordinates."""
    at = torch.from_numpy(np.array(x))
    return at[: problem.num_base], problem.sizes_at(at)


@dataclass(frozen=True)
class Remembering(Variable):
    """A variable with a memory."""

    # what its formula remembers, as rows state it
    memories: Mapping[str, MemoryKeys] = field(default_factory=dict)


def _memories_of(variable: Variable) -> dict[str, MemoryKeys]:
    """What a variable remembers, as a row states it."""
    return dict(variable.memories) if isinstance(variable, Remembering) else {}


@dataclass(frozen=True, eq=False)
class _WatchedRun:
    """What a simulation did."""

    record: Tensor  # channels, (num_samples, num_channels)
    commands: Mapping[str, Tensor]  # each command on its way, (num_samples,)
    forces: Mapping[str, WatchedForce]  # what each place did


@dataclass(frozen=True, eq=False)
class WatchedForce:
    """No force; notes position and speed wherever it is asked."""

    # values by name
    seen: dict[str, list[float]] = field(default_factory=lambda: {"x": [], "v": []})

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        """Zero, of the shape of the position."""
        for name, seen in self.seen.items():
            seen.extend(values[name].detach().numpy().ravel().tolist())
        return torch.zeros_like(values["x"] + values["v"])

    def on_floats(self, *names: str) -> Callable[..., float]:
        """The same on plain numbers."""

        def note(*given: float) -> float:
            for name, seen in self.seen.items():
                seen.append(given[names.index(name)])
            return 0.0

        return note


@dataclass(frozen=True, eq=False)
class _WatchedSignal:
    """Leaves signals as they are, and notes them."""

    seen: list[tuple[Tensor, Grid]] = field(default_factory=list)

    def __call__(self, u: Tensor, grid: Grid) -> Tensor:
        self.seen.append((u.detach(), grid))
        return u

    def at_samples(self, run: Run) -> Tensor:
        """The first of the signals at a run's samples."""
        u, grid = self.seen[-1]
        since = np.asarray(run.time_s, dtype=np.float64) - float(run.time_s[0])
        row = u.reshape(-1, u.shape[-1])[0].numpy()
        return torch.from_numpy(np.interp(since, grid.since_start.numpy(), row))
