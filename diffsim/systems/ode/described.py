"""A description with its formulas parsed against a study: model, names, the user's own causes."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from torch import Tensor

from diffsim.causes.channel_groups import channels_of, clock_of
from diffsim.causes.readings import PLAY_START, with_play_start
from diffsim.causes.signals import Grid, delayed, held_delayed
from diffsim.core.check import did_you_mean
from diffsim.core.expression import Expression
from diffsim.data.steps import looks_held, moves_on
from diffsim.data.study import Run, Study
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.ode.applying import labels_of
from diffsim.systems.ode.gaps import Gap, find_gaps
from diffsim.systems.ode.keys import Events, FormulaKeys, Input, Place, Store, Swing
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
from diffsim.systems.ode.network import TIME, Network, named, ordered, piecewise
from diffsim.systems.ode.own_effects import own_effects, shape_name
from diffsim.systems.ode.pieces import Piece, pieces_of
from diffsim.systems.ode.scene import OdeScene
from diffsim.systems.quantities import START_IN_PLAY

SLOW_TIME = "slow_time"
HELD, LONGEST, PARTS = "held", "longest", "steps_per_sample"  # places in a study's frame
_WORDS = re.compile(r"\w+")
_SLOW_SHARE = 0.1  # of the longest run: how long a slow share takes, if nobody says
#: weighted steps (``SimModel.cost``) of a sample and of a step of the integrator: about the same
#: (``benchmarks.step_costs``)
_READ_COST, _STEP_COST = 1.0, 1.0


@dataclass(frozen=True, kw_only=True)
class DescribedMotion:
    """What moves in a described system; nothing on a bench."""

    states: Mapping[str, str | Quantity] = field(default_factory=dict)
    rates: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    places: tuple[Place, ...] = ()
    stores: tuple[Store, ...] = ()
    events: tuple[Events, ...] = ()
    swings: tuple[Swing, ...] = ()
    time_step: float | None = None
    slow_time: Quantity | None = None
    clocks: Mapping[str, Quantity] = field(default_factory=dict)


class FormulaSystem:
    """A description with its formulas parsed against a study.

    Args:
        keys: Keys that all systems of formulas share.
        inputs: What drives the system.
        motion: States and what goes with them.
        study: Study with the recordings.
        reader: Receives the mistakes.
    """

    def __init__(
        self,
        keys: FormulaKeys,
        inputs: tuple[Input, ...],
        motion: DescribedMotion,
        study: Study,
        reader: Reader,
    ):
        self.keys, self.motion, self.study = keys, motion, study
        self._reader, self._given = reader, inputs
        open_ = (i for i in inputs if i.held is None)
        moving = {i.name for i in open_ if moves_on(study.runs, self._list_commands_of(i))}
        self.input_held = self._find_held_inputs(moving)
        self.unsure = frozenset(
            i.name for i in inputs if i.held is None and self._list_commands_of(i)
        )
        taken = {name for name, held in self.input_held.items() if held}
        self.assumed = self.unsure & taken & moving
        self.unsure -= taken
        self.clocks = self._list_clocks()
        self.quantities = self._list_quantities()
        facts = fact_names(study)
        self._check_names(facts)
        numbers = (*self.quantities, *facts, *data_names(study, keys.rest))
        between = (*keys.define, *keys.tables)
        self.known = (TIME, *motion.states, *self.input_held, *between, *numbers)
        self.columns = columns_of(study, self.known)
        self.starts = {s: self._parse_start(s, v, numbers) for s, v in motion.states.items()}
        self.inputs = self._list_inputs(numbers)
        rates = self._parse_formulas("rates", motion.rates)
        readings = self._parse_formulas("readings", keys.readings)
        if motion != DescribedMotion():
            self._check_places()
            self._check_events()
            self._check_swings()
        states = tuple(motion.states)
        own = keys.effects.formulas
        every = (*self.known, *self.columns)
        self.own = own_effects(own, study, every, states, reader) if own else ()
        limits = dict(motion.limits)
        self.network = Network(rates, readings, self._parse_definitions(), self.input_held, limits)
        self.base = BaseParameters({} if reader.has_errors else self.quantities, study.runs)
        self.gaps = self._find_gaps()
        self.base = self.base.with_further([g.parameter for gs in self.gaps.values() for g in gs])
        self.pieces: dict[str, tuple[Piece, ...]] = {}
        self.parts = self._count_parts()
        self.base = self._with_frequencies_seen()
        self.pieces = self._cut_runs()
        if self.pieces:
            self.base = self.base.with_further(self._list_starts_of_pieces())

    def _parse_formulas(self, key: str, formulas: Mapping[str, str]) -> dict[str, Expression]:
        return {n: self._reader.parse(f"{key}.{n}", f, self.known) for n, f in formulas.items()}

    def _check_names(self, facts: Iterable[str]) -> None:
        keys, states, rates = self.keys, self.motion.states, self.motion.rates
        reader = self._reader
        reader.require_channels(keys)
        reader.require_names(
            {
                "states": states,
                "inputs": self.input_held,
                "parameters": keys.parameters,
                "define": keys.define,
                "tables": keys.tables,
                "setup of the runs": [f for f in facts if f != RUN_ORDER],
            }
        )
        for name, q in self.quantities.items():
            reader.require_per(f"parameters.{name}", q.per)
        for name in rates:
            if name not in states:
                reader.report(f"rates.{name}", "no such state; give its start value in states")
        for name in states:
            if name not in rates:
                reader.report("rates", f"state {name} has no rate; add `{name}: ...`")
        for name in self.motion.limits:
            if name not in states:
                reader.report(f"limits.{name}", "no such state")

    def _parse_start(
        self, state: str, given: str | Quantity, numbers: tuple[str, ...]
    ) -> Expression:
        if isinstance(given, Quantity):
            return named(f"{state}_start")
        return self._reader.parse(f"states.{state}", given, (*numbers, *self.input_held))

    def _parse_definitions(self) -> dict[str, Expression]:
        from diffsim.systems.ode.swings import with_swings

        swings = [s for s in self.motion.swings if s.of in self.keys.define]
        made = self._parse_formulas("define", with_swings(self.keys.define, swings))
        for name, table in self.keys.tables.items():
            made[name] = piecewise(
                self._reader.parse(f"tables.{name}.of", table.of, self.known),
                table.at,
                table.values,
            )
        try:
            ordered(made)
        except ValueError as error:
            self._reader.report("define", str(error))
            return {}
        return made

    def _list_commands_of(self, given: Input) -> list[str]:
        """Commands that an input is made of."""
        words = {given.name} if given.formula is None else set(_WORDS.findall(given.formula))
        return sorted(words & {c for run in self.study.runs for c in run.command})

    def _find_held_inputs(self, moving: Collection[str]) -> dict[str, bool]:
        """Inputs, with whether they keep their value until the next sample.

        Args:
            moving: Names of those that some run does not show to be held.
        """
        out = {}
        for i, given in enumerate(self._given):
            commands = self._list_commands_of(given)
            out[given.name] = given.held or False
            kept = self.study.frame.get(HELD, {}).get(given.name)
            if given.held is None and kept is not None:
                out[given.name] = bool(kept)
            elif given.held is None and looks_held(self.study.runs, commands):
                out[given.name] = True
                cause = "; straight_between_samples is a cause, as some runs do not show it"
                self._reader.note(
                    f"inputs[{i}].held",
                    f"{' and '.join(commands)} rests and jumps, so {given.name} is held between "
                    "samples; give `held: false` for straight lines"
                    + (cause if given.name in moving else ""),
                )
        return out

    def _list_inputs(self, numbers: tuple[str, ...]) -> dict[str, Expression]:
        """Formula of every input, in commands, facts and parameters."""
        reader, runs = self._reader, self.study.runs
        commands = tuple(dict.fromkeys(c for run in runs for c in run.command))
        out = {}
        for i, given in enumerate(self._given):
            key, names = f"inputs[{i}]", (TIME, *commands, *numbers)
            if given.formula is not None:
                out[given.name] = reader.parse(f"{key}.formula", given.formula, names)
                continue
            out[given.name] = named(given.name)
            if given.name not in commands:
                known = ", ".join(commands) or "none"
                hint = did_you_mean(given.name, commands)
                reader.report(key, f"no command {given.name!r}{hint}; the study has {known}")
        for run in runs:
            for name in dict.fromkeys(n for e in out.values() for n in e.names):
                if not np.isfinite(run.command.get(name, np.zeros(1))).all():
                    reader.report(
                        "inputs",
                        f"run {run.name}: command {name} has empty cells; say what they mean by "
                        "`fill` under commands",
                    )
        return out

    def _list_quantities(self) -> dict[str, Quantity]:
        """Parameters, then what states, inputs and effects ask for beside them."""
        motion, given = self.motion, dict(self.keys.parameters)
        given |= {f"{s}_start": q for s, q in motion.states.items() if isinstance(q, Quantity)}
        given |= {f"{i.name}_delay": i.delay for i in self._given if i.delay is not None}
        if motion != DescribedMotion():
            given |= self._list_quantities_of_motion()
        given |= {clock_of(name): q for name, q in motion.clocks.items()}
        for block in self.keys.effects.formulas:
            given |= {shape_name(block, s): q for s, q in block.shapes.items()}
        if motion.states and self._may_have_play():
            given[PLAY_START] = START_IN_PLAY
        if motion.states and (self._given or motion.places):
            kept = self.study.frame.get(LONGEST)
            value = _SLOW_SHARE * (kept or longest(self.study.runs))
            given.setdefault(
                SLOW_TIME, motion.slow_time or Quantity(value=value, percent=100.0, unit="s")
            )
        return given

    def _list_quantities_of_motion(self) -> dict[str, Quantity]:
        """Parameters of events, stores and places; what they need is loaded only for motion."""
        from diffsim.systems.ode.event_effects import timings
        from diffsim.systems.ode.place_effects import shapes
        from diffsim.systems.ode.store_effects import spilled
        from diffsim.systems.ode.swings import swing_quantities

        motion, given = self.motion, dict[str, Quantity]()
        for events in motion.events:
            given |= timings(events, self.study)
        given |= swing_quantities(motion.swings)
        given |= {spilled(s): s.spill_share for s in motion.stores if s.spill_share is not None}
        for place in motion.places:
            given |= shapes(place)
        return given

    def _list_clocks(self) -> dict[str, tuple[str, ...]]:
        """Channels that are late together, by the parameter that says how much."""
        out = {}
        for name in self.motion.clocks:
            try:
                out[clock_of(name)] = channels_of(self.study.channels, name)
            except ValueError as error:
                self._reader.report(f"clocks.{name}", str(error))
        return out

    def _may_have_play(self) -> bool:
        """Whether a play is among the causes to be judged."""
        only = self.keys.effects.only
        return not only or any(n.startswith(("backlash", "sensor_backlash")) for n in only)

    def _check_places(self) -> None:
        reader, states = self._reader, self.motion.states
        names = [s.name for s in self.motion.stores]
        for i, place in enumerate(self.motion.places):
            for key in ("position", "velocity"):
                if getattr(place, key) not in states:
                    reader.report(f"places[{i}].{key}", f"no state {getattr(place, key)!r}")
            if place.position == place.velocity:
                reader.report(f"places[{i}].velocity", "is its position, too; name the other state")
            reader.parse(f"places[{i}].inertia", place.inertia, self.known)
            drives = (*self.keys.define, *self.input_held)
            if place.force is not None and place.force not in drives:
                close = did_you_mean(place.force, drives)
                reader.report(
                    f"places[{i}].force", f"no definition or input {place.force!r}{close}"
                )
        for i, store in enumerate(self.motion.stores):
            if store.level not in states:
                reader.report(f"stores[{i}].level", f"no state {store.level!r}")
            if store.into is not None and store.into not in names:
                reader.report(f"stores[{i}].into", f"no store {store.into!r}")
            reader.parse(f"stores[{i}].area", store.area, self.known)

    @property
    def labels(self) -> dict[str, list[str]]:
        """Values of the facts that the user's own causes are sized by."""
        pers = {block.per for block in self.keys.effects.formulas if block.per is not None}
        return {per: list(labels_of(per, self.study)) for per in sorted(pers)}

    def _check_events(self) -> None:
        from diffsim.systems.ode.event_effects import runs_of

        channels = [c.name for c in self.study.channels]
        places = [p.name for p in self.motion.places]
        between = (*self.input_held, *self.keys.define, *self.keys.tables)
        for i, events in enumerate(self.motion.events):
            if not runs_of(events, self.study):
                self._reader.warn(f"events[{i}].where", "no run has these facts")
            known = (*places, *between, *channels)
            for name in events.at:
                if name not in known:
                    self._reader.report(
                        f"events[{i}].at",
                        f"{name!r} is no place, input, definition or channel"
                        f"{did_you_mean(name, known)}",
                    )

    def _count_parts(self) -> int:
        """Steps of the integrator per sample, where the description leaves that open."""
        kept = self.study.frame.get(PARTS)
        if kept is not None or self._reader.has_errors:
            return int(kept or 1)
        self.parts = 1
        if self.motion.time_step is not None or not self.motion.states:
            return 1
        from diffsim.systems.ode.stepping import parts_needed

        formulas = repr((self.keys, self._given, self.motion))
        parts = parts_needed(self.study, self.model(), formulas)
        if parts > 1:
            self._reader.note(
                "time_step",
                f"the equations are too fast for one step per sample: {parts} are taken; "
                f"state `time_step` [s] to choose, such as {self.step / parts:.2g}",
            )
        return parts

    def _with_frequencies_seen(self) -> BaseParameters:
        """Base parameters, with frequencies of swings as the records suggest."""
        if self._reader.has_errors or not self.motion.swings:
            return self.base
        from diffsim.systems.ode.swings import with_frequencies_seen

        formulas = repr((self.keys, self._given, self.motion, self.parts, self.input_held))
        swings, runs = self.motion.swings, self.study.runs
        return self.base.with_priors(with_frequencies_seen(self.model(), swings, runs, formulas))

    def _check_swings(self) -> None:
        for i, swing in enumerate(self.motion.swings):
            if swing.of not in self.keys.define:
                close = did_you_mean(swing.of, self.keys.define)
                self._reader.report(f"swings[{i}].of", f"no definition {swing.of!r}{close}")

    def _find_gaps(self) -> dict[str, tuple[Gap, ...]]:
        """Gaps of the runs in which held commands changed, by name of the run."""
        if self._reader.has_errors or not self.motion.states:
            return {}
        given = [i for i in self._given if self.input_held[i.name]]
        held = sorted({c for i in given for c in self._list_commands_of(i)})
        found = {run.name: find_gaps(run, held) for run in self.study.runs}
        return {name: gaps for name, gaps in found.items() if gaps}

    def _cut_runs(self) -> dict[str, tuple[Piece, ...]]:
        """Pieces of the runs in which start states stop telling, by name of the run."""
        if self._reader.has_errors or not self.motion.states:
            return {}
        formulas = repr((self.keys, self._given, self.motion, self.parts, self.input_held))
        model = self.model()
        runs = [run for run in self.study.runs if np.isfinite(run.measured).any()]
        found = {run.name: pieces_of(run, model, formulas) for run in runs}
        return {name: pieces for name, pieces in found.items() if pieces}

    def _list_starts_of_pieces(self) -> list[Parameter]:
        """What states begin with where a run is cut: values of that run alone."""
        return [
            Parameter(_start_name(state, piece, run), value, piece.sd[state])
            for run, pieces in self.pieces.items()
            for piece in pieces
            for state, value in piece.start.items()
        ]

    @property
    def step(self) -> float:
        """Longest step of the integrator [s]."""
        return self.motion.time_step or self._usual_interval / self.parts

    @property
    def _usual_interval(self) -> float:
        """Time between two samples of the run with the fewest a second [s]."""
        usual = (float(np.median(np.diff(r.time_s))) for r in self.study.runs if len(r.time_s) > 1)
        return max(usual, default=math.inf)

    def model(self) -> SimModel:
        """The model without effects."""
        made = SimModel(self._build_scene, self.base.base, self.study.name, batched=True)
        stated = self.motion.time_step
        num_steps = max(self._usual_interval / stated, 1.0) if stated else self.parts
        made.step_cost = _READ_COST + _STEP_COST * num_steps
        made.cuts = {
            run: tuple((p.time, p.parting) for p in pieces) for run, pieces in self.pieces.items()
        }
        return made

    def _build_scene(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> OdeScene:
        if PLAY_START in self.quantities:
            values = with_play_start(values, run)
        known = {
            **scalars(facts_of(run)),
            **scalars(data_values(self.study, run, self.keys.rest)),
            **self.base.in_run(values, run),
        }
        step = math.inf  # what does not move is at its samples only
        if self.motion.states:
            step = self.motion.time_step or float(np.median(np.diff(run.time_s))) / self.parts
        grid = _grid(_Times(run), step * numerics.time_step)
        scene = OdeScene(
            run=run,
            network=self.network,
            grid=grid,
            values=known,
            starts=self.starts,
            inputs={n: self._evaluate_input(n, run, grid, known, values) for n in self.inputs},
            channels=tuple(c.name for c in self.study.channels),
            ranges=self.keys.ranges,
            columns={
                n: grid.resampled(v, held=False)
                for n, v in run.columns.items()
                if n in self.columns
            },
            restarts=tuple(
                (p.time, {s: values[_start_name(s, p, run.name)] for s in p.start})
                for p in self.pieces.get(run.name, ())
            ),
        )
        for name, channels in self.clocks.items():
            places = tuple(scene.channels.index(c) for c in channels)
            scene = scene.with_clock(places, known[name])
        return scene

    def _evaluate_input(
        self,
        name: str,
        run: Run,
        grid: Grid,
        known: Mapping[str, Tensor],
        values: Mapping[str, Tensor],
    ) -> Tensor:
        formula, held = self.inputs[name], self.input_held[name]
        columns = {
            c: grid.resampled(run.command[c], held=held) for c in formula.names if c in run.command
        }
        for gap in self.gaps.get(run.name, ()) if held else ():
            columns = {c: gap.change(u, grid, values[gap.name]) for c, u in columns.items()}
        numbers = {n: known[n][..., None] for n in formula.names if n in known}
        u = formula({**numbers, **columns, TIME: grid.times})
        u = u.expand(*u.shape[:-1], len(grid.times)) if u.ndim else u.expand(len(grid.times))
        if (late := known.get(f"{name}_delay")) is not None:
            u = (held_delayed if held else delayed)(u, grid, late)
        return u


def columns_of(study: Study, taken: Collection[str]) -> tuple[str, ...]:
    """What was recorded beside commands and channels and may stand in formulas of own causes.

    Args:
        study: Study with the recordings.
        taken: Names that mean something else.
    """
    names = {c.name for c in study.channels} | set(taken)
    return tuple(c.name for c in study.columns if c.name.isidentifier() and c.name not in names)


def _start_name(state: str, piece: Piece, run: str) -> str:
    """Name of the base parameter that a state begins a piece with."""
    return f"{state}_from_{1e3 * piece.time:.6g}_ms@{run}"


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
