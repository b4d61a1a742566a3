"""``model: {system: ode}``: states, rates and readings as formulas."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator
from torch import Tensor

from diffsim.core.expression import Expression
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    BaseParameters,
    Quantity,
    chosen_effects,
    settings_with,
)
from diffsim.systems.ode.effects import ode_effects
from diffsim.systems.ode.grid import Grid, delayed, held_delayed
from diffsim.systems.ode.keys import (
    AnyQuantity,
    Formula,
    FormulaKeys,
    Inputs,
    Place,
    Seconds,
    States,
    Store,
)
from diffsim.systems.ode.library import Library, magnitudes
from diffsim.systems.ode.names import (
    RUN_ORDER,
    Reader,
    data_names,
    data_values,
    fact_names,
    facts_of,
    longest,
    scalars,
)
from diffsim.systems.ode.network import TIME, Network, ordered
from diffsim.systems.ode.own_effects import own_effects
from diffsim.systems.ode.place_effects import sticking
from diffsim.systems.ode.scene import OdeScene
from diffsim.systems.ode.unknown import unknown_forces

SLOW_TIME = "slow_time"
_SLOW_SHARE = 0.1  # of the longest run: how long a slow share takes, if nobody says


class OdeDescription(FormulaKeys):
    """States with rates, driven by inputs, read by formulas; everything in SI units."""

    system: Literal["ode"] = Field("ode", description="Kind of system: `ode`")
    states: States = Field(
        description="Start value of every state: a number with unit, a formula of parameters and "
        "first_CHANNEL, or a quantity with a prior"
    )
    rates: dict[str, Formula] = Field(description="Rate of every state, its derivative in time")
    inputs: Inputs = Field((), description="What drives the system: commands, or formulas of them")
    limits: dict[str, tuple[float, float]] = Field(
        {}, description="Lower and upper limit of states that have some"
    )
    places: tuple[Place, ...] = Field((), description="Where forces may act; opens their effects")
    stores: tuple[Store, ...] = Field((), description="What fills and empties; opens leaks")
    time_step: Seconds | None = Field(  # type: ignore[valid-type]
        None, gt=0, description="Longest step of the integrator [s]; none: the sample interval"
    )
    slow_time: AnyQuantity | None = Field(
        None, description="Time in which slow shares of inputs and forces come; none: fitted"
    )

    @field_validator("states", "rates", mode="before")
    @classmethod
    def _names_as_text(cls, given: Any) -> Any:
        return {str(k): v for k, v in given.items()} if isinstance(given, Mapping) else given

    def problems(self, study: Study) -> list[Problem]:
        """Mistakes in names, formulas and units, found without a simulation."""
        reader = Reader(study)
        _Read(self, study, reader)
        return list(reader.problems)

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        reader = Reader(study)
        read = _Read(self, study, reader)
        reader.finish()
        model = read.model()
        usual = magnitudes(study, model, read.network, read.known, self.places, self.stores)
        library = Library(
            study=study,
            known=read.known,
            held=read.input_held,
            places=tuple((p, usual.places[p.name]) for p in self.places),
            stores=tuple((s, usual.stores[s.name]) for s in self.stores),
            inputs=usual.inputs,
        )
        effects = chosen_effects((*ode_effects(library), *read.own), self.effects)
        settings = settings_with(DiagnosisSettings(), self.effort)
        return DiagnosisSetup(model, effects, unknown_forces(library), settings=settings)


class _Read:
    """A description with its formulas parsed against a study."""

    def __init__(self, keys: OdeDescription, study: Study, reader: Reader):
        self.keys, self.study = keys, study
        runs, facts = study.runs, fact_names(study)
        self.input_held = {i.name: i.held for i in keys.inputs}
        commands = tuple(dict.fromkeys(c for run in runs for c in run.command))
        quantities = self._quantities()
        reader.require_channels(keys)
        reader.require_names(
            {
                "states": keys.states,
                "inputs": self.input_held,
                "parameters": keys.parameters,
                "define": keys.define,
                "setup of the runs": [f for f in facts if f != RUN_ORDER],
            }
        )
        for name, q in quantities.items():
            reader.require_per(f"parameters.{name}", q.per)
        for name in keys.rates:
            if name not in keys.states:
                reader.report(f"rates.{name}", "no such state; give its start value in states")
        for name in keys.states:
            if name not in keys.rates:
                reader.report("rates", f"state {name} has no rate; add `{name}: ...`")
        numbers = (*quantities, *facts, *data_names(study, keys.rest))
        self.known = (TIME, *keys.states, *self.input_held, *keys.define, *numbers)
        parse = reader.parse
        self.starts = {
            s: parse(f"states.{s}", v, (*numbers, *self.input_held))
            if isinstance(v, str)
            else parse(f"states.{s}", f"{s}_start", (f"{s}_start",))
            for s, v in keys.states.items()
        }
        definitions = {n: parse(f"define.{n}", f, self.known) for n, f in keys.define.items()}
        try:
            ordered(definitions)
        except ValueError as error:
            reader.report("define", str(error))
            definitions = {}
        self.inputs: dict[str, Expression] = {}
        for i, given in enumerate(keys.inputs):
            key = f"inputs[{i}]"
            if given.formula is None and given.name not in commands:
                reader.report(
                    key, f"no command {given.name!r}; the study has {', '.join(commands) or 'none'}"
                )
            self.inputs[given.name] = parse(
                f"{key}.formula" if given.formula else key,
                given.formula or given.name,
                (TIME, *commands, *numbers, given.name),
            )
        for run in runs:
            for name in {n for e in self.inputs.values() for n in e.names} & set(run.command):
                if not np.isfinite(run.command[name]).all():
                    reader.report("inputs", f"run {run.name}: command {name} has empty cells")
        rates = {s: parse(f"rates.{s}", f, self.known) for s, f in keys.rates.items()}
        readings = {c: parse(f"readings.{c}", f, self.known) for c, f in keys.readings.items()}
        for name in keys.limits:
            if name not in keys.states:
                reader.report(f"limits.{name}", "no such state")
        self._check_places(reader)
        self.own = own_effects(keys.effects.own, study, self.known, tuple(keys.states), reader)
        self.network = Network(rates, readings, definitions, self.input_held, dict(keys.limits))
        self.base = BaseParameters(quantities, runs) if not reader.problems else None

    def _quantities(self) -> dict[str, Quantity]:
        keys = self.keys
        starts = {f"{s}_start": q for s, q in keys.states.items() if isinstance(q, Quantity)}
        delays = {f"{i.name}_delay": i.delay for i in keys.inputs if i.delay is not None}
        slow = keys.slow_time or Quantity(
            value=_SLOW_SHARE * longest(self.study.runs), percent=100.0, unit="s"
        )
        sticky = {
            sticking(p): Quantity(value=1.0, percent=100.0, lower=0.2, upper=20.0)
            for p in keys.places
            if p.stick_velocity is None
        }
        has_slow = bool(keys.inputs or keys.places)
        return {
            **keys.parameters,
            **starts,
            **delays,
            **sticky,
            **({SLOW_TIME: slow} if has_slow and SLOW_TIME not in keys.parameters else {}),
        }

    def _check_places(self, reader: Reader) -> None:
        states, names = self.keys.states, [s.name for s in self.keys.stores]
        for i, place in enumerate(self.keys.places):
            for key in ("position", "velocity"):
                if getattr(place, key) not in states:
                    reader.report(f"places[{i}].{key}", f"no state {getattr(place, key)!r}")
            reader.parse(f"places[{i}].inertia", place.inertia, self.known)
        for i, store in enumerate(self.keys.stores):
            if store.level not in states:
                reader.report(f"stores[{i}].level", f"no state {store.level!r}")
            if store.spills_into is not None and store.spills_into not in names:
                reader.report(f"stores[{i}].spills_into", f"no store {store.spills_into!r}")
            reader.parse(f"stores[{i}].area", store.area, self.known)

    def model(self) -> SimModel:
        """The model without effects."""
        assert self.base is not None
        return SimModel(self._build, self.base.base, self.study.name, batched=True)

    def _build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> OdeScene:
        assert self.base is not None
        known = {
            **scalars(facts_of(run)),
            **scalars(data_values(self.study, run, self.keys.rest)),
            **self.base.in_run(values, run),
        }
        step = self.keys.time_step or float(np.median(np.diff(run.time_s)))
        grid = _grid(_Times(run), step * numerics.time_step)
        return OdeScene(
            run=run,
            network=self.network,
            grid=grid,
            values=known,
            starts=self.starts,
            inputs={name: self._input(name, run, grid, known) for name in self.inputs},
            channels=tuple(c.name for c in self.study.channels),
        )

    def _input(self, name: str, run: Run, grid: Grid, known: Mapping[str, Tensor]) -> Tensor:
        formula, held = self.inputs[name], self.input_held[name]
        columns = {
            c: grid.resampled(run.command[c], held=held) for c in formula.names if c in run.command
        }
        numbers = {n: known[n][..., None] for n in formula.names if n in known}
        u = formula({**numbers, **columns, TIME: grid.times})
        u = u.expand(*u.shape[:-1], len(grid.times)) if u.ndim else u.expand(len(grid.times))
        if (late := known.get(f"{name}_delay")) is not None:
            u = (held_delayed if held else delayed)(u, grid, late)
        return u


class _Times:
    """Sample times of a run as a key: compared by their object."""

    def __init__(self, run: Run):
        self.seconds = run.time_s

    def __hash__(self) -> int:
        return hash(self.seconds.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Times) and np.array_equal(self.seconds, other.seconds)


@lru_cache(maxsize=256)
def _grid(times: _Times, step: float) -> Grid:
    return Grid.of(times.seconds, step)


__all__ = ["OdeDescription"]
