"""A simulator that diffsim knows nothing about, as a model with hooks for causes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from threading import Lock
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.causes.ports import SignalChange
from diffsim.causes.readings import PLAY_START
from diffsim.causes.scene import ForceLaw
from diffsim.causes.signals import Grid, SignalMap, change_rows, smoothly_delayed
from diffsim.data.study import Run
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.problem import PredictionError
from diffsim.systems.outside.forces import ForceKnots, PlaceForces, Term
from diffsim.systems.outside.source import Predict, Source, offers_of

Array = NDArray[np.float64]
MAX_KEPT = 64  # records


class SimulatorError(PredictionError):
    """A user's simulator failed; the message names the run and the parameters that caused it."""


@dataclass(frozen=True, eq=False)
class Job:
    """One call of a simulator, ready to be sent to another process.

    Attributes:
        run: Run with the commands as the actuators hear them.
        values: Value of every parameter, by name.
        forces: Forces that the simulator is asked to add; None: it takes none.
        numerics: Factors on its own settings.
        channels: Names of the channels.
    """

    run: Run
    values: Mapping[str, float]
    forces: PlaceForces | None
    numerics: Numerics
    channels: tuple[str, ...]


def call(predict: Predict, label: str, job: Job) -> Array:
    """Channels that a simulator predicts, (num_samples, num_channels).

    Raises:
        SimulatorError: the simulator failed.
        ValueError: it returned something else than the channels.
    """
    offers = offers_of(predict)
    more: dict[str, Any] = {}
    if "force" in offers and job.forces is not None:
        more["force"] = job.forces
    if "time_step" in offers:
        more["time_step"] = job.numerics.time_step
    try:
        given = predict(dict(job.values), job.run, **more)
    except Exception as error:
        at = ", ".join(f"{k} = {v:.6g}" for k, v in job.values.items()) or "no parameters"
        raise SimulatorError(
            f"simulator {label} failed in run {job.run.name} at {at}: "
            f"{type(error).__name__}: {error}"
        ) from error
    return _shape_channels(given, label, job)


def _shape_channels(given: Any, label: str, job: Job) -> Array:
    """What was returned as an array, refused where it cannot be the channels."""
    where = f"simulator {label} returned"
    names, count = job.channels, len(job.run.time_s)
    if isinstance(given, Mapping):
        if missing := [n for n in names if n not in given]:
            raise ValueError(
                f"{where} a mapping without {', '.join(missing)} for run {job.run.name}; "
                f"it has {', '.join(map(str, given))}"
            )
        given = np.column_stack([np.asarray(given[n], dtype=np.float64) for n in names])
    out = np.asarray(given, dtype=np.float64)
    out = out[:, None] if out.ndim == 1 and len(names) == 1 else out
    if out.shape != (count, len(names)):
        raise ValueError(
            f"{where} the shape {out.shape} for run {job.run.name}; it must return "
            f"({count}, {len(names)}): a row for each of the run's time_s, a column for each of "
            f"{', '.join(names)}"
        )
    return out


class Records:
    """The last records of a simulator, by everything that it was given: what happens behind it
    (sensors, clocks) needs no further call."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Array] = OrderedDict()

    @staticmethod
    def key(job: Job) -> Hashable | None:
        """What the record depends on; None for forces, which are functions."""
        if job.forces is not None and job.forces.acts:
            return None
        run = job.run
        command = tuple((n, np.asarray(u).tobytes()) for n, u in run.command.items())
        seen = (run.name, run.time_s.tobytes(), run.measured.tobytes(), command)
        return *seen, *job.values.items(), job.numerics

    def get(self, job: Job) -> Array | None:
        """The record of a job, if it is among the last."""
        return self._kept.get(self.key(job))

    def keep(self, job: Job, record: Array) -> Array:
        """The record, remembered."""
        if (key := self.key(job)) is not None:
            self._kept[key] = record
            while len(self._kept) > MAX_KEPT:
                self._kept.popitem(last=False)
        return record


@dataclass(frozen=True, eq=False)
class OutsideScene:
    """One run of an outside simulator; effects change commands, forces and channels.

    Attributes:
        model: Model that the scene belongs to.
        values: Value of each parameter in this run, () each.
        run: Run as recorded.
        numerics: Factors on the simulator's own settings.
        command_maps: Names of commands, and what happens to them on their way.
        terms: Forces by law.
        knots: Forces over time.
        output_maps: Indices of channels, and what happens to them.
    """

    model: OutsideModel
    values: Mapping[str, Tensor]
    run: Run
    numerics: Numerics
    command_maps: tuple[tuple[tuple[str, ...], SignalMap], ...] = ()
    terms: tuple[Term, ...] = ()
    knots: tuple[ForceKnots, ...] = ()
    output_maps: tuple[tuple[tuple[int, ...], SignalMap], ...] = ()

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> OutsideScene:
        """A copy with one more map f(commands (width, num_samples), grid) of some commands.

        Args:
            names: Names of the commands; empty: all.
            change: The function; one that leaves all as it is is left out.
        """
        if isinstance(change, SignalChange) and change.is_none:
            return self
        names = names or tuple(self.run.command)
        return replace(self, command_maps=(*self.command_maps, (names, change)))

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> OutsideScene:
        """A copy with one more map f(channels (width, num_samples), grid) of some channels.

        Args:
            channels: Their indices.
            change: The function; one that leaves all as it is is left out.
        """
        if isinstance(change, SignalChange) and change.is_none:
            return self
        return replace(self, output_maps=(*self.output_maps, (channels, change)))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> OutsideScene:
        """A copy in which channels show what was ``delay`` ago [s]."""
        if not bool(delay.detach().any()):
            return self
        return self.with_reading(channels, lambda y, grid: smoothly_delayed(y, grid, delay))

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> OutsideScene:
        """A copy in which a parameter of the simulator is f(parameter)."""
        return replace(self, values={**self.values, name: change(self.values[name])})

    def with_force(self, place: str, law: ForceLaw) -> OutsideScene:
        """A copy with one more force at a place.

        Args:
            place: Name of the place.
            law: Formula and size.
        """
        size = float(law.size.detach())
        if size == 0.0:
            return self
        at = self.model.places.index(place)
        term = Term(at, law.formula, size, self.model.speeds[at])
        return replace(self, terms=(*self.terms, term))

    def with_knots(self, knots: ForceKnots) -> OutsideScene:
        """A copy with one more force over time."""
        return replace(self, knots=(*self.knots, knots))

    @property
    def play_start(self) -> Tensor | None:
        """Where in a play the run starts, -1 to 1; None: not known to the model."""
        return self.values.get(PLAY_START)

    def simulate(self) -> Tensor:
        """(num_samples, num_channels) predicted channels."""
        job, model = self.job(), self.model
        with model.one_at_a_time:  # most simulators hold state, and threads share this one
            record = model.made.get(job)
            if record is None:
                record = model.made.keep(job, call(model.predict_run, model.source.label, job))
        return self.read(record)

    def job(self) -> Job:
        """The call of the simulator that this scene asks for."""
        model = self.model
        forces = PlaceForces(model.places, self.terms, self.knots) if model.places else None
        own = (PLAY_START, *self.model.clocks)  # what happens behind the simulator
        values = {name: float(v.detach()) for name, v in self.values.items() if name not in own}
        run = replace(self.run, command=self._map_commands())
        return Job(run, values, forces, self.numerics, model.channels)

    def read(self, predicted: Array) -> Tensor:
        """Channels as the sensors show them.

        Args:
            predicted: What the simulator returned, (num_samples, num_channels).
        """
        out, grid = torch.from_numpy(predicted), self._make_grid()
        for name, idx in self.model.clocks.items():
            late = partial(smoothly_delayed, delay=self.values[name].detach())
            out = change_rows(out.mT, idx, late, grid).mT
        for channels, change in self.output_maps:
            out = change_rows(out.mT, channels, change, grid).mT
        return out.detach().contiguous()

    def _make_grid(self) -> Grid:
        return Grid.of(np.asarray(self.run.time_s, dtype=np.float64), np.inf)

    def _map_commands(self) -> dict[str, Array]:
        """Commands as the actuators hear them, at the run's times."""
        commands = {name: np.asarray(v, dtype=np.float64) for name, v in self.run.command.items()}
        for names, change in self.command_maps:
            held = [n for n in names if n in commands]
            if not held:
                continue
            rows = torch.from_numpy(np.stack([commands[n] for n in held]))
            changed = change(rows, self._make_grid()).detach().numpy()
            commands |= dict(zip(held, changed, strict=True))
        return commands


SAMPLE = 20.0  # weighted steps of a sample: simulators take some of their own


class OutsideModel(SimModel):
    """A simulator from outside, with base parameters.

    Args:
        source: Place of the simulator.
        base: Base parameters.
        in_run: Function (values of the base parameters, run) -> values that the simulator gets.
        channels: Names of the channels.
        places: Names of the places where the simulator can add forces.
        speeds: Usual speed of each place.
        clocks: Indices of the channels that are late by a base parameter of that name.
        workers: Processes that simulate side by side; each makes a simulator of its own.
    """

    def __init__(
        self,
        source: Source,
        base: Sequence[Parameter],
        in_run: Callable[[Mapping[str, Tensor], Run], Mapping[str, Tensor]],
        *,
        channels: Sequence[str],
        places: Sequence[str] = (),
        speeds: Sequence[float] = (),
        clocks: Mapping[str, tuple[int, ...]] | None = None,
        workers: int = 1,
    ):
        super().__init__(self._build_scene, base, source.label)
        self.step_cost = SAMPLE
        self.clocks, self.made = dict(clocks or {}), Records()
        self.source, self.in_run = source, in_run
        self.channels, self.places, self.workers = tuple(channels), tuple(places), workers
        self.speeds = tuple(speeds)
        self.predict_run, self.one_at_a_time = source.make(), Lock()
        if places and "force" not in offers_of(self.predict_run):
            raise ValueError(
                f"hooks.force names {', '.join(places)}, but predict of simulator {source.label} "
                "takes no force; write predict(parameters, run, force) and call "
                "force(time, positions, velocities) at each step"
            )
        self._pool: ProcessPoolExecutor | None = None

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes, side by side where there are workers."""
        jobs = [scene.job() for scene in scenes]
        # jobs that are alike are one; forces, which have no key, are each their own
        keys = [Records.key(job) or index for index, job in enumerate(jobs)]
        todo = {k: j for k, j in zip(keys, jobs, strict=True) if self.made.get(j) is None}
        if self.workers < 2 or len(todo) < 2:
            return [scene.simulate() for scene in scenes]
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self.workers,
                get_context("spawn"),
                initializer=_begin_process,
                initargs=(self.source,),
            )
        done = dict(zip(todo, self._pool.map(_run_job, todo.values()), strict=True))
        out = []
        for scene, key, job in zip(scenes, keys, jobs, strict=True):
            record = done[key] if key in done else self.made.get(job)
            out.append(scene.simulate() if record is None else scene.read(record))
        for key, job in todo.items():
            self.made.keep(job, done[key])
        return out

    def _build_scene(
        self, values: Mapping[str, Tensor], run: Run, numerics: Numerics
    ) -> OutsideScene:
        return OutsideScene(self, self.in_run(values, run), run, numerics)


_OWN: dict[str, Any] = {}


def _begin_process(source: Source) -> None:
    """Make the simulator of this process."""
    _OWN["predict"], _OWN["label"] = source.make(), source.label


def _run_job(job: Job) -> Array:
    return call(_OWN["predict"], _OWN["label"], job)
