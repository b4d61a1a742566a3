"""Studies: recorded runs of one system under known commands, with noise and set-up facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.data.fault_keys import FaultKeys

USES = ("fit", "select", "test")


TIMELESS = "_timeless"  # fact of runs whose samples have no order, made by a system


@checked
@dataclass(frozen=True)
class Channel:
    """One measured quantity with its unit and noise.

    Attributes:
        name: Column of the run files, unit included, such as "tip_z_m".
        unit: SI unit of the samples.
        kind: Kind of quantity: "position", "angle", "velocity", "pressure", "flow", ...
        sd: Standard deviation of the sensor's noise, in ``unit``; None: estimated from repeats.
        shown_unit: Unit in which a user reads errors, such as "mm"; None: ``unit``.
        sensor: Instrument that shows it, such as "camera"; None: not stated.
        shown_formula: The value that a user reads, in ``shown_unit``, as a formula of the channel's
            own name, where the channel is a scaled reading; None: only units differ.
        lower, upper: How far the rig may travel [unit]: runs that go beyond are not advised. None:
            not stated.
    """

    name: str
    unit: str
    kind: str
    sd: float | None = None
    shown_unit: str | None = None
    sensor: str | None = None
    shown_formula: str | None = None
    lower: float | None = None
    upper: float | None = None


@checked
@dataclass(frozen=True)
class Command:
    """What is known of a command beyond its samples.

    Attributes:
        name: Name of the command, a key of every run's ``command``.
        unit: SI unit of the samples; None: not stated.
        lower: Least value that can be commanded [unit]; None: unknown.
        upper: Largest value that can be commanded [unit]; None: unknown.
        rate: Fastest change that can be commanded [unit/s]; None: unknown.
        is_measured: Whether it was measured, as the output of a controller is: it differs between
            repeats, and cannot be commanded.
        shown_unit: Unit in which a user reads it, such as "mbar"; None: ``unit``.
        before: What was commanded before a run begins [unit]; None: its first value.
    """

    name: str
    unit: str | None = None
    lower: float | None = None
    upper: float | None = None
    rate: float | None = None
    is_measured: bool = False
    shown_unit: str | None = None
    before: float | None = None


@dataclass(frozen=True)
class Column:
    """A recorded quantity that neither the model nor a channel or command uses."""

    name: str  # name for formulas, a key of every run's ``columns``
    unit: str | None  # SI unit of the samples; None: its header states none
    header: str  # what the files call it


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Run:
    """One execution of a command, with the samples that were measured.

    Attributes:
        name: Name of the run, unique in the study.
        time_s: (num_samples,) strictly increasing [s].
        measured: (num_samples, num_channels); NaN where nothing was recorded.
        command: Commanded values by name of the command, (num_samples,) each, at ``time_s``.
        group: Runs with equal command are repeats of each other.
        order: Place in the sequence of experiments, from 0.
        use: "fit" for runs that parameters are fitted to, "select" for runs that choose between
            causes, "test" for runs that are touched once, after the answer is frozen.
        setup: Known facts of this run, numbers or labels: {"payload_kg": 0.2, "frame": "A"}.
        columns: What else was recorded, by name of ``Study.columns``, (num_samples,) each.
        files: Paths of the files that it was read from; none where it was made.
        raw: Of channels and commands that one column holds: its header and its numbers,
            (num_samples,), decoded but neither scaled nor shifted. Empty where nothing was read.
        row_s: Usual time between two rows of its record [s], of which only some are here; None:
            all are.
    """

    name: str
    time_s: Array
    measured: Array
    command: Mapping[str, Array]
    group: str
    order: int = 0
    use: str = "fit"
    setup: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, Array] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    raw: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    row_s: float | None = None

    def __post_init__(self) -> None:
        n = len(self.time_s) if np.ndim(self.time_s) == 1 else -1
        given: list[tuple[str, Any, tuple[int | str, ...]]] = [
            ("time_s", self.time_s, ("num_samples",)),
            ("measured", self.measured, (n, "num_channels")),
            *((f"command[{k!r}]", values, (n,)) for k, values in self.command.items()),
            *((f"columns[{k!r}]", values, (n,)) for k, values in self.columns.items()),
            *((f"raw[{k!r}]", values, (n,)) for k, (_, values) in self.raw.items()),
        ]
        for name, values, shape in given:
            is_array = isinstance(values, np.ndarray) and values.dtype.kind in "fiu"
            if not (is_array or (isinstance(values, Tensor) and values.is_floating_point())):
                got = getattr(values, "dtype", type(values).__name__)
                raise TypeError(f"{name} must be an array of real numbers, got {got}")
            if len(values.shape) != len(shape) or shape[0] not in (len(values), "num_samples"):
                wanted = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
                raise ValueError(f"{name} must have shape {wanted}, got {tuple(values.shape)}")
        bad = ~np.isfinite(self.time_s)
        bad[1:] |= ~(np.diff(self.time_s) >= 0.0)
        if bad.any():
            raise ValueError(
                f"time_s of run {self.name!r} must be finite and increase, got "
                f"{self.time_s[bad][0]:g} at sample {int(np.argmax(bad))}"
            )

    @checked
    def part(self, keep: slice | NDArray[Any]) -> Run:
        """Some of the samples.

        Args:
            keep: A slice, the indices, or which samples are kept.
        """
        return self.mapped(lambda values: values[keep])

    @checked
    def mapped(self, change: Callable[[Array], Array]) -> Run:
        """The run with all of its samples changed.

        Args:
            change: From (num_samples, ...) of one quantity, the clock too, to what stands for them.
        """
        return replace(
            self,
            time_s=change(self.time_s),
            measured=change(self.measured),
            command={name: change(values) for name, values in self.command.items()},
            columns={name: change(values) for name, values in self.columns.items()},
            raw={name: (header, change(values)) for name, (header, values) in self.raw.items()},
        )


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Study:
    """Recorded runs with what is known about them.

    Attributes:
        name: Short name of the study, as reports show it.
        system: System that was recorded, in a word.
        channels: Columns of every run's ``measured``.
        runs: Runs of the study, in any order.
        metadata: Geometry and settings that the model needs, source, licence.
        model: Description of the system as ``model:`` of study.yaml states it; None: none given.
        folder: Folder that paths of ``model`` are relative to; None: the working folder.
        commands: Units and limits of the commands that are known; may be empty.
        file: File that the study was read from; None: made in memory.
        left_out: What of the study's folder is not used, a sentence each.
        todo: What the study says is still to be stated, a sentence each.
        allows: Facts of ``setup`` that can be changed for a next run, with possible values.
        export: Formulas of constants for other programs, by program and name.
        frame: What an earlier fit took from its runs, such as usual magnitudes: with it the causes
            of a saved model mean the same on new runs. Empty: it is taken from these runs.
        faults: How groups of runs are judged for faults; None: they are not.
        columns: What was recorded beside channels and commands: it may explain what is left.
        mended: What was done to the record before anything was read from it, a sentence each.
        stamps: Runs by name of which rows were left out, as their stamps cannot be right, and why.
    """

    name: str
    system: str
    channels: tuple[Channel, ...]
    runs: tuple[Run, ...]
    metadata: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] | None = None
    folder: Path | None = None
    commands: tuple[Command, ...] = ()
    file: Path | None = None
    left_out: tuple[str, ...] = ()
    todo: tuple[str, ...] = ()
    allows: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    export: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    frame: Mapping[str, Any] = field(default_factory=dict)
    faults: FaultKeys | None = None
    columns: tuple[Column, ...] = ()
    mended: tuple[str, ...] = ()
    stamps: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        entries = (("channels", Channel), ("runs", Run), ("commands", Command), ("columns", Column))
        for name, kind in entries:
            held = getattr(self, name)
            for k, entry in enumerate(held):
                if not isinstance(entry, kind):
                    got = type(entry).__name__
                    raise TypeError(f"{name}[{k}] must be a {kind.__name__}, got {got}")
            names = [entry.name for entry in held]
            if len(set(names)) < len(names):
                twice = next(one for one in names if names.count(one) > 1)
                raise ValueError(f"{name} must have different names, got {twice!r} more than once")
        for run in self.runs:
            if self.channels and run.measured.shape[1] != len(self.channels):
                raise ValueError(
                    f"measured of run {run.name!r} must have a column for each of "
                    f"{len(self.channels)} channels, got shape {run.measured.shape}"
                )
            if not (np.diff(run.time_s) > 0.0).all():
                at = int(np.argmax(~(np.diff(run.time_s) > 0.0))) + 1
                raise ValueError(
                    f"time_s of run {run.name!r} must increase, got {run.time_s[at]:g} twice, "
                    f"at sample {at}"
                )

    @property
    def fit_runs(self) -> tuple[Run, ...]:
        """Runs used for fitting, by order."""
        return self.runs_for("fit")

    @property
    def select_runs(self) -> tuple[Run, ...]:
        """Runs that choose between causes and that nothing is fitted to, by order."""
        return self.runs_for("select")

    @property
    def test_runs(self) -> tuple[Run, ...]:
        """Runs that neither a fit nor the choice of causes has seen, by order."""
        return self.runs_for("test")

    def without_tests(self) -> Study:
        """The study as a diagnosis may see it before its answer is frozen."""
        return replace(self, runs=tuple(r for r in self.runs if r.use != "test"))

    @checked
    def runs_for(self, use: str) -> tuple[Run, ...]:
        """Runs of one use, by order."""
        return tuple(sorted((r for r in self.runs if r.use == use), key=lambda r: r.order))
