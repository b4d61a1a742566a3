"""The hardware of the loop: anything that executes a command and says what the robot did."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_text_atomic
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_file import STUDY_FILE, load_study
from labs.loop.command import RATE_HZ, Command, Limits
from labs.loop.model import CHANNELS
from labs.loop.recordings import COMMAND


class Hardware(Protocol):
    """A robot on its rig.

    Attributes:
        name: Name for reports.
        virtual: True where no matter moves; a report has to say so.
        duration_s: Length of an experiment [s].
        limits: Limits of the servo; commands beyond are refused.
    """

    @property
    def name(self) -> str: ...

    @property
    def virtual(self) -> bool: ...

    @property
    def duration_s(self) -> float: ...

    @property
    def limits(self) -> Limits: ...

    def execute(self, command: Command, *, order: int) -> Run:
        """Execute a command from rest, repeating its period, and record.

        Args:
            command: Within ``limits``.
            order: Place in the sequence of experiments, from 0.

        Returns:
            The recording in the study format: ``measured`` holds ``CHANNELS`` (x and z of four
            markers in the camera's plane [m], the robot swims towards -x, NaN where not seen), at
            60 Hz from the command's start; ``command`` the contraction that was executed, which
            differs from the command where the servo quantizes.
        """
        ...


class AwaitingRecordingError(DiffsimError):
    """The experiment has not been made yet; the loop goes on from here when it has."""


@dataclass(frozen=True, kw_only=True)
class FileHardware:
    """A user's rig, through files: commands go out as CSV, recordings come in as studies.

    For experiment k it writes ``command_k.csv`` (``time_s``, ``tendon_contraction_m``) and looks
    for ``run_k/study.yaml`` in the study format (:mod:`diffsim.data.study_file`) with one run.

    Attributes:
        folder: Folder in which both lie.
        duration_s: Length of an experiment [s].
        limits: Limits of the servo.
        wait_s: How long to wait for the recording [s]; 0: look once.
        poll_s: Time between two looks [s].
    """

    folder: Path
    duration_s: float = 30.0
    limits: Limits = field(default_factory=Limits)
    wait_s: float = 0.0
    poll_s: float = 1.0
    name = "rig through files"
    virtual = False

    def execute(self, command: Command, *, order: int) -> Run:
        """See :class:`Hardware`.

        Raises:
            AwaitingRecordingError: no recording after ``wait_s``.
            ValueError: the command is beyond the limits, or the recording has other channels.
        """
        command.check(self.limits)
        out = Path(self.folder) / f"command_{order}.csv"
        write_command(out, command, self.duration_s)
        study = Path(self.folder) / f"run_{order}" / STUDY_FILE
        until = time.monotonic() + self.wait_s
        while not study.is_file():
            if time.monotonic() >= until:
                raise AwaitingRecordingError(
                    f"experiment {order} has no recording yet: execute {out} and put the recording "
                    f"at {study}, then resume the loop"
                )
            time.sleep(self.poll_s)
        return read_recording(study, order)


def write_command(path: Path, command: Command, duration_s: float) -> Path:
    """The command as a CSV of ``time_s`` and contraction, as long as the experiment."""
    values = command.during(duration_s)
    rows = [f"{k / RATE_HZ!r},{float(v)!r}" for k, v in enumerate(values)]
    return write_text_atomic(path, "\n".join([f"time_s,{COMMAND}", *rows]) + "\n")


def read_recording(path: Path, order: int) -> Run:
    """The one run of a study, its clock from 0.

    Raises:
        ValueError: other channels than ``CHANNELS``, no command, or several runs.
    """
    study = load_study(path)
    names = tuple(c.name for c in study.channels)
    if names != CHANNELS or len(study.runs) != 1 or COMMAND not in study.runs[0].command:
        raise ValueError(
            f"{path}: a recording must have one run, the channels {', '.join(CHANNELS)} and the "
            f"command {COMMAND}, got {len(study.runs)} runs and channels {', '.join(names)}"
        )
    run = study.runs[0]
    steps = np.diff(run.time_s)
    if np.abs(steps * RATE_HZ - 1.0).max() > 0.05:
        raise ValueError(
            f"{path}: samples must be 1/{RATE_HZ:g} s apart, got {steps.min():.4g} to "
            f"{steps.max():.4g} s; resample the recording"
        )
    return replace(run, name=f"run_{order}", order=order, time_s=run.time_s - run.time_s[0])


def as_study(run: Run, source: str) -> Study:
    """A recording as the study that ``load_study`` reads back."""
    channels = tuple(Channel(c, "m", "position") for c in CHANNELS)
    return Study("sim_to_real", "soft_body", channels, (run,), {"source": source})
