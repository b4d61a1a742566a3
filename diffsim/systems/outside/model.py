"""A simulator that diffsim knows nothing about, as a model with hooks for causes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import blake2b
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.ports import SignalChange
from diffsim.causes.scales import HELD
from diffsim.causes.scene import PLAY_START, Commands, Instruments, Scene
from diffsim.causes.signals import DELAYS, Grid, SignalMap
from diffsim.core.arrays import Array, IntArray
from diffsim.core.checked import checked, checked_methods
from diffsim.core.memo import Memo
from diffsim.core.runs import run_each
from diffsim.core.workers import Processes
from diffsim.data.run_samples import with_rows_back
from diffsim.data.signal import swept_rows
from diffsim.data.study import Command, Run
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.problem import PredictionError
from diffsim.systems.outside.before_runs import BeforeRuns
from diffsim.systems.outside.forces import ForceKnots, PlaceForces, Term
from diffsim.systems.outside.mjcf_payloads import Carrier
from diffsim.systems.outside.source import Call, Predict, PredictMany, Source, offers_of

Arrays = list[Array]
MAX_KEPT = 64e6  # bytes of records: slopes, scans and checks ask for some thousand again


class SimulatorError(PredictionError):
    """A user's simulator failed; the message names the run and the parameters that caused it."""


@dataclass(frozen=True, eq=False)
class Job:
    """One call of a simulator, ready to be sent to another process."""

    run: Run  # run with the commands as the actuators hear them
    values: Mapping[str, float]  # value of every parameter, by name
    forces: PlaceForces | None  # forces that the simulator is asked to add; None: it takes none
    numerics: Numerics  # factors on its own settings
    channels: tuple[str, ...]  # names of the channels
    # time by which the simulator hears a command late, by name [s]
    delays: Mapping[str, float] = field(default_factory=dict)
    # values of such commands before the run; without a word their first ones
    before: Mapping[str, float] = field(default_factory=dict)
    rows: IntArray | None = None  # those of the run's rows that were recorded; None: all were


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
    if "delays" in offers:
        more["delays"] = dict(job.delays)
    if "before" in offers:
        more["before"] = dict(job.before)
    try:
        given = predict(dict(job.values), job.run, **more)
    except Exception as error:
        raise _word_error(error, label, job) from error
    return _shape_channels(given, label, job)


def call_many(
    predict_many: PredictMany, label: str, jobs: Sequence[Job], threads: int
) -> list[Array | SimulatorError]:
    """Channels of several jobs, or what failed, by a simulator that takes them at once; see
    ``call``."""
    calls = [
        Call(dict(j.values), j.run, j.forces, j.numerics.time_step, j.delays, j.before)
        for j in jobs
    ]
    out: list[Array | SimulatorError] = []
    for job, given in zip(jobs, predict_many(calls, threads), strict=True):
        if isinstance(given, Exception):
            error = _word_error(given, label, job)
            error.__cause__ = given
            out.append(error)
        else:
            out.append(_shape_channels(given, label, job))
    return out


def _word_error(error: Exception, label: str, job: Job) -> SimulatorError:
    """What went wrong, with the run and the parameters that caused it."""
    at = ", ".join(f"{k} = {v:.6g}" for k, v in job.values.items()) or "no parameters"
    return SimulatorError(
        f"simulator {label} failed in run {job.run.name} at {at}: {type(error).__name__}: {error}"
    )


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
    return out if job.rows is None else out[job.rows]


class Records:
    """The last records of a simulator, by everything that it was given: what happens behind it
    (sensors, clocks) needs no further call."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Array] = OrderedDict()
        self._bytes = 0

    @staticmethod
    def key(job: Job) -> Hashable:
        """What the record depends on; of all samples a digest."""
        run = job.run
        digest = blake2b(run.time_s.tobytes())
        digest.update(np.ascontiguousarray(run.measured).data)
        for values in run.command.values():
            digest.update(np.ascontiguousarray(values).data)
        forces = None if job.forces is None or not job.forces.acts else job.forces.key
        seen = (run.name, run.measured.shape, *run.command, digest.digest())
        late = *sorted(job.delays.items()), *sorted(job.before.items())
        return *seen, *job.values.items(), job.numerics, forces, *late

    def get(self, key: Hashable) -> Array | None:
        """The record of a job, by its key, if it is among the last."""
        return self._kept.get(key)

    def keep(self, key: Hashable, record: Array) -> Array:
        """The record, remembered."""
        if key not in self._kept:
            self._kept[key] = record
            self._bytes += record.nbytes
        while self._bytes > MAX_KEPT:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return record


@dataclass(frozen=True, kw_only=True, eq=False)
class OutsideScene(Scene):
    """One run of an outside simulator."""

    model: OutsideModel  # model that the scene belongs to
    run: Run  # run as recorded
    numerics: Numerics  # factors on the simulator's own settings
    knots: tuple[ForceKnots, ...] = ()  # forces over time

    def simulate(self) -> Tensor:
        """(num_samples, num_channels) predicted channels."""
        job, model = self.job(), self.model
        key = Records.key(job)
        with model.one_at_a_time:  # most simulators hold state, and threads share this one
            record = model.made.get(key)
            if record is None:
                model.count(job)
                record = model.made.keep(key, call(model.predict_run, model.source.label, job))
        return self.read(record)

    def job(self) -> Job:
        """The call of the simulator that this scene asks for."""
        model = self.model
        terms = [
            Term(
                place,
                law.formula,
                float(law.size.detach()),
                model.places[place],
                tuple(float(shape.detach()) for shape in law.shapes),
            )
            for place, law in self.forces
        ]
        forces = PlaceForces(tuple(model.places), terms, self.knots) if model.places else None
        own = (PLAY_START, *model.clocks)  # what happens behind the simulator
        values = {name: float(v.detach()) for name, v in self.numbers.items() if name not in own}
        acting = replace(self.commands, changes=_list_acting(self.commands.changes))
        if acting.changes:
            acting = model.with_first_commands(acting, self.run)
        names, delays, before = tuple(self.run.command), dict[str, float](), dict[str, float]()
        if model.takes_delays and (acting.before is None or model.takes_before):
            acting, delays = _without_delays(acting, names)
        heard = acting.heard(self.grid).detach().numpy()
        if delays:
            before = _before_delays(acting, names, self.grid)
        run = replace(self.run, command=dict(zip(names, heard, strict=True)))
        lost = model.lost(self.run, lambda: _swept_rows(self.run, bool(model.frame.get(HELD))))
        rows = np.arange(len(run.time_s)) + np.append(0, np.cumsum(lost)) if lost.any() else None
        # behind causes: a held command went on in rows that are lost
        run = with_rows_back(run, lost, is_measured=True)
        return Job(run, values, forces, self.numerics, model.channels, delays, before, rows)

    def read(self, predicted: Array) -> Tensor:
        """Channels as the sensors show them.

        Args:
            predicted: What the simulator returned, (num_samples, num_channels).
        """
        clocks = tuple((idx, self.numbers[name]) for name, idx in self.model.clocks.items())
        shown = Instruments((*clocks, *_list_acting(self.instruments.acts)))
        return shown.read_in_order(torch.from_numpy(predicted), self.grid).detach().contiguous()


def _swept_rows(run: Run, is_held: bool) -> IntArray:
    """Lost rows of a run over which held commands went on; straight lines do so by themselves."""
    columns = [np.asarray(u, dtype=np.float64) for u in run.command.values()]
    return swept_rows(run.time_s, columns if is_held else [])


def _list_acting(acts: Sequence[tuple[Any, Any]]) -> tuple[tuple[Any, Any], ...]:
    """What does something at its size: for nothing else the simulator is asked again."""
    return tuple((where, act) for where, act in acts if not _is_nothing(act))


def _without_delays(commands: Commands, names: Sequence[str]) -> tuple[Commands, dict[str, float]]:
    """Commands without the delays at the end of their way, and these by name [s]: told at samples,
    a step that comes between them is a ramp.

    Args:
        commands: Of one point, with all that changes them.
    """
    delays: dict[str, float] = {}
    kept: list[tuple[tuple[int, ...], SignalMap]] = []
    for rows, change in reversed(commands.changes):
        is_last = not any(set(rows) & set(later) for later, _ in kept)
        if is_last and isinstance(change, SignalChange) and change.map in DELAYS:
            sizes = change.size.detach().reshape(-1).expand(len(rows)).tolist()
            for row, size in zip(rows, sizes, strict=True):
                delays[names[row]] = delays.get(names[row], 0.0) + size
        else:
            kept.insert(0, (rows, change))
    return replace(commands, changes=tuple(kept)), delays


def _before_delays(commands: Commands, names: Sequence[str], grid: Grid) -> dict[str, float]:
    """What commands that had not their first values were before the run, by name, behind all that
    changes them but their delays."""
    if commands.before is None:
        return {}
    stood = torch.where(commands.before.isnan(), commands.values[..., 0], commands.before)
    heard = commands.pass_through(stood[:, None].expand_as(commands.values), grid)[..., 0]
    known = (~commands.before.isnan()).tolist()
    return {n: float(v) for n, v, is_known in zip(names, heard, known, strict=True) if is_known}


def _is_nothing(act: SignalMap | Tensor) -> bool:
    if isinstance(act, Tensor):
        return not bool(act.detach().any())
    return isinstance(act, SignalChange) and act.is_none


Strengths = Callable[[Mapping[str, float]], Mapping[str, tuple[float, str]]]
FitsHold = Callable[[str, Collection[str]], bool]
SAMPLE = 20.0  # weighted steps of a sample: simulators take some of their own


@checked_methods
class OutsideModel(SimModel):
    """A simulator from outside, with base parameters.

    Args:
        source: Place of the simulator.
        base: Base parameters.
        in_run: Function (values of the base parameters, run) -> values that the simulator gets.
        channels: Names of the channels.
        commands: Names of the commands; a run need not have all of them.
        known: What is known of commands beyond their samples.
        places: Usual speed of each place where the simulator can add forces, by name.
        clocks: Indices of the channels that are late by a base parameter of that name.
        workers: Processes that simulate side by side; each makes a simulator of its own.
    """

    @checked
    def __init__(
        self,
        source: Source,
        base: Sequence[Parameter],
        in_run: Callable[[Mapping[str, Tensor], Run], Mapping[str, Tensor]],
        *,
        channels: Sequence[str],
        commands: Sequence[str] = (),
        known: Sequence[Command] = (),
        places: Mapping[str, float] | None = None,
        clocks: Mapping[str, tuple[int, ...]] | None = None,
        workers: int = 1,
    ):
        super().__init__(self._build_scene, base, source.label)
        self.leaves_zeros = True
        self.step_cost = SAMPLE
        self.clocks, self.made = dict(clocks or {}), Records()
        self.source, self.in_run = source, in_run
        self.channels, self.commands, self.workers = tuple(channels), tuple(commands), workers
        self.known, self.places = tuple(known), dict(places or {})
        self.predict_run, self.one_at_a_time = source.make(), Lock()
        offers = offers_of(self.predict_run)
        self.takes_delays, self.takes_before = "delays" in offers, "before" in offers
        if places and "force" not in offers:
            raise ValueError(
                f"hooks.force names {', '.join(places)}, but predict of simulator {source.label} "
                "takes no force; write predict(parameters, run, force) and call "
                "force(time, positions, velocities) at each step"
            )
        simulator = getattr(self.predict_run, "__self__", None)
        self.run_many: PredictMany | None = getattr(simulator, "predict_many", None)
        self._count_steps = getattr(simulator, "count_steps", None)
        #: Bodies that may carry a payload, with mass and length, where the simulator says so
        self.carriers: Mapping[str, Carrier] = getattr(simulator, "carriers", {})
        #: Function of the largest commands by name: what actuators push with at most, and its unit
        self.strengths: Strengths | None = getattr(simulator, "strengths", None)
        #: Function (place, names of base parameters): whether how soon friction holds is a number
        self.fits_hold: FitsHold | None = getattr(simulator, "fits_hold", None)
        names, ways = [p.name for p in base], getattr(simulator, "drives", ())
        if all(way & set(names) for way in ways):
            self.drives = tuple(n for n in names if any(n in way for way in ways))
        self.zeros: tuple[str, ...] = ()  # numbers that causes alone change
        #: What was commanded before the runs, where the study may be asked
        self.before_runs: BeforeRuns | None = None
        self._pool: Processes | None = None
        #: Rows that were lost behind each row of a run while commands were swept
        self.lost: Memo[IntArray] = Memo()

    def cost(self, run: Run, numerics: Numerics | None = None) -> float:
        """Weighted steps of one prediction; counted where the simulator counts its own."""
        return self._cost_of(run, numerics or Numerics(), None)

    def _cost_of(self, run: Run, numerics: Numerics, forces: PlaceForces | None) -> float:
        """Weighted steps of a prediction.

        Args:
            numerics: Factors on the simulator's own settings.
            forces: Forces of causes, if any.
        """
        if self._count_steps is None:
            return super().cost(run, numerics)
        return self.run_cost + float(self._count_steps(run, forces)) / numerics.time_step

    def note_simulations(self, run: Run, number: int, numerics: Numerics | None = None) -> None:
        """Count nothing: calls are counted where they are made, records are used again."""

    def count(self, job: Job) -> None:
        """Count a call of the simulator."""
        self.simulations.add(1, round(self._cost_of(job.run, job.numerics, job.forces)))

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes, side by side where there are workers."""
        jobs = [scene.job() for scene in scenes]
        keys = [Records.key(job) for job in jobs]  # jobs that are alike are one
        todo = {k: j for k, j in zip(keys, jobs, strict=True) if self.made.get(k) is None}
        if len(todo) < 2 or (self.workers < 2 and self.run_many is None):
            return [scene.simulate() for scene in scenes]
        found = dict(zip(todo, self._run_jobs(list(todo.values())), strict=True))
        errors = [f for f in found.values() if isinstance(f, SimulatorError)]
        # whoever goes on without what failed need not wait for the others again
        records = {k: f for k, f in found.items() if not isinstance(f, SimulatorError)}
        with self.one_at_a_time:  # threads share the count of bytes
            done = {k: self.made.keep(k, record) for k, record in records.items()}
        if errors:
            raise errors[0]
        out = []
        for scene, key in zip(scenes, keys, strict=True):
            record = done[key] if key in done else self.made.get(key)
            out.append(scene.simulate() if record is None else scene.read(record))
        return out

    def _run_jobs(self, jobs: Sequence[Job]) -> Sequence[Array | SimulatorError]:
        """Records of several jobs: by the simulator's own threads, else by processes."""
        for job in jobs:
            self.count(job)
        if self.run_many is not None:
            with self.one_at_a_time:
                return call_many(self.run_many, self.source.label, jobs, self.workers)
        if self._pool is None:
            self._pool = Processes(self.workers)
        try:
            return run_each(partial(_run_job, self.source), jobs, self._pool)
        except KeyboardInterrupt:  # workers leave it to this process
            self._pool.end()
            self._pool = None
            raise

    def with_first_commands(self, commands: Commands, run: Run) -> Commands:
        """Commands with zero before the run where the study does not say it and they were."""
        is_stated = commands.before is not None and not bool(commands.before.isnan().any())
        if is_stated or self.before_runs is None or not (zero := self.before_runs.zero(run)):
            return commands
        usual = [0.0 if name in zero else np.nan for name in run.command]
        earlier = torch.tensor(usual, dtype=torch.float64)
        if commands.before is not None:
            earlier = torch.where(commands.before.isnan(), earlier, commands.before)
        return replace(commands, before=earlier)

    def _build_scene(
        self, values: Mapping[str, Tensor], run: Run, numerics: Numerics
    ) -> OutsideScene:
        columns = [np.asarray(v, dtype=np.float64) for v in run.command.values()]
        stacked = np.stack(columns) if columns else np.zeros((0, len(run.time_s)))
        heard = Commands.named(tuple(run.command), torch.from_numpy(stacked), self.known)
        none: dict[str, tuple[int, ...]] = dict.fromkeys(self.commands, ())
        return OutsideScene(
            grid=Grid.of(np.asarray(run.time_s, dtype=np.float64), np.inf),
            numbers=self.in_run(values, run),
            zeros=self.zeros,
            commands=replace(heard, rows={**none, **heard.rows}),
            model=self,
            run=run,
            numerics=numerics,
        )


_OWN: dict[str, Predict] = {}  # simulators of this process by label


def _run_job(source: Source, job: Job) -> Array:
    label = source.label
    if label not in _OWN:
        _OWN[label] = source.make()
    return call(_OWN[label], label, job)
