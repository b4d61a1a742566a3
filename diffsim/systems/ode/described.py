"""A description with its formulas parsed against a study, and the scenes that these make."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.readings import with_play_start
from diffsim.causes.scene import PLAY_START, Commands
from diffsim.causes.signals import Grid, late_by
from diffsim.core.arrays import Array
from diffsim.core.checked import checked_methods
from diffsim.core.expression import Expression
from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.model import RunPoints, SimModel, joined
from diffsim.identify.numerics import NumericalEffect, Numerics
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.first_commands import FEWEST_READINGS, LATE, is_heard_at_once
from diffsim.systems.ode.gaps import Gap
from diffsim.systems.ode.keys import Events, FormulaKeys, Place, Store, Swing
from diffsim.systems.ode.names import data_values, facts_of, scalars
from diffsim.systems.ode.network import TIME, Network
from diffsim.systems.ode.pieces import Piece, start_name
from diffsim.systems.ode.scene import OdeScene, simulate_together


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

    @classmethod
    def of(cls, description: Any, study: Study) -> DescribedMotion:
        """What moves in a description that has these keys; a place that does not state its units
        turns where a channel reads its position, or how fast that changes, as an angle's, or where
        a rate has its sine; what no inertia divides is an acceleration."""
        read = {c.name: c.unit for c in study.channels}
        read_as = {text.strip(): read.get(name) for name, text in description.readings.items()}
        given = {key.name: getattr(description, key.name) for key in fields(cls)}
        places = []
        for place in description.places:
            position, velocity = read_as.get(place.position), read_as.get(place.velocity)
            turns = position in ("rad", "rad/s") or place.position_unit in ("rad", "deg")
            turns |= position is None and velocity == "rad/s"
            if not turns and position is None and not place.position_unit:
                angle = re.compile(rf"\b(sin|cos|tan)\(\s*{re.escape(place.position)}\s*\)")
                every = (description.rates, description.readings, description.define)
                texts = [text for of in every for text in of.values()]
                turns = any(angle.search(text) for text in texts)
            # a speed may stand as the position: of a motor of which no more was measured
            usual = "m" if not turns else "rad/s" if position == "rad/s" else "rad"
            usual = place.position_unit or usual
            force = place.unit or ("N m" if turns else "N")
            if not place.unit and place.force is None and place.inertia == "1":
                force = f"{usual}/s^2"
            units = {"unit": force, "position_unit": usual}
            places.append(place.model_copy(update=units))
        given["places"] = tuple(places)
        return cls(**given)


@dataclass(frozen=True, kw_only=True, eq=False)
class FormulaSystem:
    """A description with its formulas parsed against a study."""

    keys: FormulaKeys
    motion: DescribedMotion
    study: Study
    held: Mapping[str, bool]  # inputs, with whether they are held between samples
    unsure: frozenset[str]  # inputs of which nobody knows whether they are held between samples
    assumed: frozenset[str]  # inputs that are taken to be held though some run does not show it
    # channels that are late together, by the parameter that says how much
    clocks: Mapping[str, tuple[str, ...]]
    known: tuple[str, ...]  # names that formulas may use
    # what was recorded beside inputs and channels, for formulas of own causes and laws: its name,
    # and whether it is a command that is held between samples
    columns: Mapping[str, bool]
    starts: Mapping[str, Expression]  # start value of every state, a formula of numbers and inputs
    inputs: Mapping[str, Expression]  # formula of every input, of commands, facts and parameters
    network: Network  # formulas of rates, readings and definitions
    own: tuple[Effect, ...]  # the user's own causes
    base: BaseParameters  # parameters, and what states, inputs and effects ask for beside them
    parts: int = 1  # steps of the integrator per sample, where the description leaves that open
    # gaps of the runs in which held commands changed, by name of the run
    gaps: Mapping[str, tuple[Gap, ...]] = field(default_factory=dict)
    # pieces of the runs in which start states stop telling, by name of the run
    pieces: Mapping[str, tuple[Piece, ...]] = field(default_factory=dict)
    from_zero: Memo[bool] = memo_field()  # whether inputs were zero before a run, by the run
    # facts of a run and what is taken from its samples, by the run
    known_of: Memo[dict[str, Tensor]] = memo_field()

    @property
    def priors(self) -> dict[str, Tensor]:
        """Base parameters as they are stated."""
        return {p.name: torch.tensor(p.value, dtype=torch.float64) for p in self.base.base}

    @cached_property
    def heard_before(self) -> frozenset[str]:
        """Inputs whose first values had been heard before fitted runs that start at rest."""
        sd = np.array([np.nan if c.sd is None else c.sd for c in self.study.channels])
        delays, every = torch.tensor(LATE, dtype=torch.float64), frozenset(self.inputs)
        records: dict[str, list[tuple[Array, Array]]] = {name: [] for name in self.inputs}
        for run in self.study.fit_runs:
            if len(run.time_s) < FEWEST_READINGS:
                continue
            if not _make_scene(self, self.priors, run, Numerics()).rests_without_inputs():
                continue
            scene = _make_scene(self, self.priors, run, Numerics(), zero=every)
            delay = (delays * float(np.median(np.diff(run.time_s))))[:, None]
            with torch.no_grad():
                at_once = scene.simulate()[None]
                for name in self.inputs:
                    comes, moved = late_by(delay, held=self.held[name]), [at_once]
                    for zero in (every - {name}, every):
                        begun = _make_scene(self, self.priors, run, Numerics(), zero=zero)
                        late = begun.commands.changed((name,), comes)
                        # an input that no formula reads moves nothing, nor makes a batch
                        seen = begun.changed(commands=late).simulate()
                        moved.append(seen.expand(len(LATE), *at_once.shape[1:]))
                    records[name].append((torch.cat(moved).numpy(), run.measured))
        return frozenset(name for name in self.inputs if is_heard_at_once(records[name], sd))

    @property
    def step(self) -> float:
        """Longest step of the integrator [s]."""
        return self.motion.time_step or self.usual_interval / self.parts

    @property
    def usual_interval(self) -> float:
        """Time between two samples of the run with the fewest a second [s]."""
        usual = (float(np.median(np.diff(r.time_s))) for r in self.study.runs if len(r.time_s) > 1)
        return max(usual, default=math.inf)

    @cached_property
    def formulas(self) -> str:
        """What the model is made of, in text."""
        return repr((self.keys, self.parts, self.held))


@checked_methods
class OdeModel(SimModel):
    """A model whose scenes are systems of formulas, of several runs at once."""

    leaves_zeros = True
    joins_runs = True

    def predict_each(
        self, asked: Sequence[RunPoints], numerics: Numerics | None = None
    ) -> list[Tensor]:
        """Predictions as of ``SimModel``, with the same bits, those of few points together."""
        every = (pair for a in asked for pair in a.sizes.items())
        is_refined = any(isinstance(e, NumericalEffect) and bool(s.any()) for e, s in every)
        if torch.is_grad_enabled() or is_refined:
            return super().predict_each(asked, numerics)
        made: list[tuple[list[list[int]], list[Any]]] = []
        for run, q, sizes in asked:
            self.note_simulations(run, 1 if q.ndim == 1 else len(q), numerics)
            if q.ndim == 1:
                made.append(([], [self.scene(run, q, sizes, numerics)]))
            else:
                made.append(self._group_scenes(run, q, sizes, numerics))
        found = iter(simulate_together([scene for _, scenes in made for scene in scenes]))
        parts = [(rows, [next(found) for _ in scenes]) for rows, scenes in made]
        return [joined(rows, own) if rows else own[0] for rows, own in parts]


def model_of(system: FormulaSystem) -> SimModel:
    """The model of a system without effects."""
    build = partial(_build_scene, system)
    made = OdeModel(build, system.base.base, system.study.name, batched=True)
    made.moves = bool(system.motion.states and system.motion.places)
    stated = system.motion.time_step
    num_steps = max(system.usual_interval / stated, 1.0) if stated else system.parts
    # a sample costs as much as a step of the integrator (``benchmarks.step_costs``)
    made.step_cost = 1.0 + num_steps
    made.cuts = {
        run: tuple((p.time, p.parting) for p in pieces) for run, pieces in system.pieces.items()
    }
    return made


def _build_scene(
    system: FormulaSystem, values: Mapping[str, Tensor], run: Run, numerics: Numerics
) -> OdeScene:
    """A scene whose inputs were zero before the run if it rests so where the run starts, and not
    with their first values, unless such runs move with these at once; this is asked at the priors,
    so that no fit changes it."""

    def ask() -> bool:
        return _make_scene(system, system.priors, run, numerics).rests_without_inputs()

    is_from_zero = bool(system.motion.states and system.inputs) and system.from_zero(run, ask)
    zero = frozenset(system.inputs) - system.heard_before if is_from_zero else frozenset()
    return _make_scene(system, values, run, numerics, zero=zero)


def _make_scene(
    system: FormulaSystem,
    values: Mapping[str, Tensor],
    run: Run,
    numerics: Numerics,
    *,
    zero: frozenset[str] = frozenset(),
) -> OdeScene:
    keys, motion, study = system.keys, system.motion, system.study
    if PLAY_START in system.base.quantities:
        values = with_play_start(values, run)
    found = system.known_of(
        run, lambda: scalars({**facts_of(run), **data_values(study, run, keys.rest)})
    )
    known = {**found, **system.base.in_run(values, run)}
    step = math.inf  # what does not move is at its samples only
    if motion.states:
        step = motion.time_step or float(np.median(np.diff(run.time_s))) / system.parts
    grid = _grid(np.asarray(run.time_s, dtype=np.float64).tobytes(), step * numerics.time_step)
    scene = OdeScene(
        run=run,
        network=system.network,
        grid=grid,
        numbers=known,
        starts=system.starts,
        commands=_evaluate_inputs(system, run, grid, known, values, zero),
        channels=tuple(c.name for c in study.channels),
        ranges=keys.ranges,
        columns={
            n: grid.resampled(v, held=system.columns[n])
            for n, v in {**run.command, **run.columns}.items()
            if n in system.columns
        },
        restarts=tuple(
            (p.time, {s: values[start_name(s, p, run)] for s in p.start})
            for p in system.pieces.get(run.name, ())
        ),
    )
    for name, channels in system.clocks.items():
        places = tuple(scene.channels.index(c) for c in channels)
        scene = scene.with_clock(places, known[name])
    return scene


def _evaluate_inputs(
    system: FormulaSystem,
    run: Run,
    grid: Grid,
    known: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
    zero: frozenset[str],
) -> Commands:
    """Inputs (..., num_inputs, num_times), with points in front where any of them has some."""
    found = [_evaluate_input(system, n, run, grid, known, values) for n in system.inputs]
    lead = np.broadcast_shapes(*(u.shape for u in found)) if found else (len(grid.times),)
    none = torch.zeros(0, len(grid.times), dtype=torch.float64)
    stacked = torch.stack([u.expand(lead) for u in found], -2) if found else none
    commands = Commands.named(
        tuple(system.inputs), stacked, system.study.commands, dict.fromkeys(zero, 0.0)
    )
    for name in system.inputs:
        if (late := known.get(f"{name}_delay")) is not None:
            commands = commands.changed((name,), late_by(late[..., None], held=system.held[name]))
    return commands


def _evaluate_input(
    system: FormulaSystem,
    name: str,
    run: Run,
    grid: Grid,
    known: Mapping[str, Tensor],
    values: Mapping[str, Tensor],
) -> Tensor:
    formula, held = system.inputs[name], system.held[name]
    columns = {
        c: grid.resampled(run.command[c], held=held) for c in formula.names if c in run.command
    }
    for gap in system.gaps.get(run.name, ()) if held else ():
        columns = {c: gap.change(u, grid, values) for c, u in columns.items()}
    numbers = {n: known[n][..., None] for n in formula.names if n in known}
    u = formula({**numbers, **columns, TIME: grid.times})
    return u.expand(*u.shape[:-1], len(grid.times)) if u.ndim else u.expand(len(grid.times))


@lru_cache(maxsize=256)
def _grid(times: bytes, step: float) -> Grid:
    return Grid.of(np.frombuffer(times).copy(), step)
