"""What an exported model holds of an answer, and what the rest costs: the export is simulated.

A target carries a cause where a constant of it reads the cause. What a cause that is not carried is
worth is the difference of the model with and without it; what the export as a whole is worth is its
own error on the study's runs.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from diffsim.causes.scales import HELD
from diffsim.cli.diagnose_export import flown_constants, is_text
from diffsim.core.arrays import Array, Mask
from diffsim.core.expression import parse_expression
from diffsim.core.figures import counted, figure
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.units import after_number, factor, small_scale
from diffsim.data.record.shapes import spikes
from diffsim.data.record.signals import Samples
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.judge.own_values import words_of
from diffsim.identify.model_file import SavedModel, rebuilt
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.outside import joint_drive
from diffsim.systems.registry import setup_of

MUJOCO = "mujoco"
FLOWN = ("kp", "load_inertia", "load_moment")  # constants that a drive on a joint needs to be flown
MAX_RUNS = 20  # that an export is flown on
STEP_S = 0.0005  # s
CARRIED_FILE = "carried.json"
#: What a drive on a joint has for a cause, by the row of the cause
CONSTANTS = {
    "delay": "delay_s",
    "lag": "lag_s",
    "rate_limit": "rate_limit_s",
    "dry_friction": "frictionloss",
    "viscous_friction": "damping",
    "stribeck_friction": "stribeck",
    "friction_asymmetry": "friction_asymmetry",
    "square_drag": "square_drag",
}
POSITION, POWER = "goal", "powered"  # commands of a drive


@dataclass(frozen=True)
class CarriedCause:
    """A named cause, and whether a target has it."""

    cause: str
    by: tuple[str, ...]  # constants of the target that read it; empty: it is not carried
    # mean difference of the model with and without it, by channel, in shown units
    cost: Mapping[str, float]
    # constant that a drive on a joint has for it, where no formula of the study reads it; empty:
    # there is none, or it is carried
    would: str = ""


@dataclass(frozen=True)
class Flight:
    """Mean errors of a run's channel in its shown unit.

    Attributes:
        run: Name of the run.
        channel: Name of the channel.
        model: Of the answer's own model.
        export: Of the exported one.
        apart: Of the one against the other.
    """

    run: str
    channel: str
    model: float
    export: float
    apart: float

    @classmethod
    def of(
        cls, run: str, channel: Channel, own: Array, flown: Array, seen: Array, good: Mask
    ) -> Flight:
        """Errors of one channel at the samples that are good, all (num_samples,)."""
        pairs = ((own, seen), (flown, seen), (flown, own))
        off = [float(np.abs(a - b)[good].mean()) for a, b in pairs]
        return cls(run, channel.name, *(_times(channel) * v for v in off))


def runs_to_fly(study: Study) -> tuple[Run, ...]:
    """Test runs, or all where there are none; at most ``MAX_RUNS``, evenly taken."""
    runs = [run for run in study.runs if run.use == "test"] or list(study.runs)
    step = max(math.ceil(len(runs) / MAX_RUNS), 1)
    return tuple(runs[::step])


class Answer:
    """A saved model that is simulated with and without its causes."""

    def __init__(self, study: Study, saved: SavedModel):
        self.saved, self.study = saved, saved.framed(study)
        self.setup: DiagnosisSetup = setup_of(self.study)
        self.runs = runs_to_fly(study)
        self._whole = self.records(saved)

    def records(self, saved: SavedModel) -> dict[str, Array]:
        """Channels of each run, (num_samples, num_channels)."""
        model = rebuilt(saved, self.setup)
        with torch.no_grad():
            return {r.name: model.predict(r, model.at_prior()).numpy() for r in self.runs}

    def record(self, run: Run) -> Array:
        """Channels of a run with all causes."""
        return self._whole[run.name]

    def causes(self) -> dict[str, tuple[str, ...]]:
        """Components that are not nothing, by cause."""
        out: dict[str, tuple[str, ...]] = {}
        for effect in self.setup.effects:
            own = [f"{effect.name}.{c}" if c else effect.name for c in effect.components]
            own = [c for c in (effect.name, *own) if self.saved.values.get(c)]
            if own and any(c in self.saved.components for c in own):
                out[effect.name] = tuple(dict.fromkeys(own))
        return out

    def cost(self, components: Sequence[str]) -> dict[str, float]:
        """Mean difference that some components make, by channel, in shown units."""
        without = replace(
            self.saved, values={**self.saved.values, **dict.fromkeys(components, 0.0)}
        )
        records = self.records(without)
        out = {}
        for k, channel in enumerate(self.study.channels):
            off = [np.abs(records[r.name][:, k] - self.record(r)[:, k]) for r in self.runs]
            out[channel.name] = _times(channel) * float(np.nanmean(np.concatenate(off)))
        return out


def list_carried(answer: Answer, program: str) -> list[CarriedCause]:
    """Each named cause, the constants that carry it, and what it is worth.

    Args:
        answer: The saved model.
        program: Name of the program in the study's `export`.
    """
    formulas = answer.study.export.get(program, {})
    read = {
        name: set(parse_expression(text).names)
        for name, text in formulas.items()
        if not is_text(text)
    }
    out = []
    for cause, components in answer.causes().items():
        by = tuple(name for name, own in read.items() if own & {cause, *components})
        would = "" if by else CONSTANTS.get(re.split("_(?:of|at)_", cause)[0], "")
        out.append(CarriedCause(cause, by, answer.cost(components), would))
    return out


def fly(constants: Mapping[str, float], run: Run, *, is_held: bool = False) -> Array:
    """Angles of an exported drive in MuJoCo at the samples of a run, (num_samples,).

    Args:
        constants: Constants of the run.
        run: Run with the commands ``goal`` and, where its torque may be off, ``powered``.
        is_held: Whether the goal stays from sample to sample; else lines join them.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(joint_drive.model_text(constants, STEP_S, delayed=False))
    data, drive = mujoco.MjData(model), joint_drive.JointDrive(constants)
    time = run.time_s
    goal, powered = np.asarray(run.command[POSITION]), run.command.get(POWER)
    measured = run.measured[np.isfinite(run.measured[:, 0]), 0]
    data.time, data.qpos[0] = float(time[0]), float(measured[0])
    drive.begin(model, float(goal[0]))
    count = int(np.ceil((time[-1] - time[0]) / STEP_S - 1e-6))
    steps = time[0] + STEP_S * np.arange(count + 1)
    held = np.clip(np.searchsorted(time, steps + 1e-9, side="right") - 1, 0, None)
    goals = goal[held] if is_held else np.interp(steps, time, goal)
    power = np.ones(len(steps)) if powered is None else np.asarray(powered)[held]
    out = np.empty(count + 1)
    for k in range(count + 1):
        out[k] = data.qpos[0]
        drive.set_control(model, data, float(goals[k]), float(power[k]))
        mujoco.mj_step(model, data)
    return np.interp(time, steps, out)


def fly_all(answer: Answer, formulas: Mapping[str, str]) -> list[Flight] | str:
    """Errors of the exported drive and of the model, run by run; or why it cannot be flown.

    Args:
        formulas: Constants of the drive that the target has.
    """
    lacks = [n for n in FLOWN if n not in formulas]
    if lacks:
        return f"export.mujoco has no {', '.join(lacks)}, so there is no drive on a joint to fly"
    if POSITION not in {name for run in answer.runs for name in run.command}:
        return f"no command {POSITION!r}, which a drive on a joint follows"
    try:
        import mujoco  # noqa: F401
    except ImportError:
        return "MuJoCo is not installed: pip install mujoco"
    out = []
    channel = answer.study.channels[0]
    study = replace(answer.study, export={MUJOCO: formulas})
    held = answer.setup.model.frame.get(HELD, {})  # as the model takes it: stated, or as it looks
    is_held = bool(held.get(POSITION)) if isinstance(held, Mapping) else bool(held)
    for run in answer.runs:
        constants = flown_constants(study, answer.saved, MUJOCO, run)
        flown, own, seen = (
            fly(constants, run, is_held=is_held),
            answer.record(run)[:, 0],
            run.measured[:, 0],
        )
        out.append(Flight.of(run.name, channel, own, flown, seen, is_read(run)))
    return out


def is_read(run: Run) -> Mask:
    """Samples of the first channel that were measured, and not misread."""
    good = np.isfinite(run.measured[:, 0])
    at = np.flatnonzero(good)
    good[at[spikes(Samples(run.name, at, run.time_s[at], run.measured[at, 0]))]] = False
    return good


def write_drive(answer: Answer, out: Path) -> list[Path]:
    """The drive's MJCF of the first run, its callback, and the constants of each run."""
    runs = {r.name: flown_constants(answer.study, answer.saved, MUJOCO, r) for r in answer.runs}
    first = next(iter(runs.values()))
    return [
        write_text_atomic(out / "drive.xml", joint_drive.model_text(first, STEP_S)),
        write_text_atomic(out / "joint_drive.py", inspect.getsource(joint_drive)),
        write_json_atomic(out / "mujoco_runs.json", runs),
    ]


def say_flights(flights: list[Flight] | str, channels: Sequence[Channel]) -> list[str]:
    """How the export does on the runs, a sentence for each channel."""
    if isinstance(flights, str):
        return [f"Not flown: {flights}."]
    out = []
    for channel in channels:
        if found := [f for f in flights if f.channel == channel.name]:
            errors = (np.mean([getattr(f, n) for f in found]) for n in ("export", "model", "apart"))
            export, own, apart = (_read(float(v), channel) for v in errors)
            out.append(
                f"{channel.name}, flown in MuJoCo on {counted(len(found), 'run')}: {export} from "
                f"what was measured, the model itself {own}; {apart} from one another."
            )
    return out


def say_carried(found: Sequence[CarriedCause], study: Study, program: str) -> list[str]:
    """The list of what is carried and of what is not, a line each."""
    channels = {c.name: c for c in study.channels}
    out = []
    for carried in found:
        cost = [f"{name} by {_read(v, channels[name])}" for name, v in carried.cost.items()]
        how = f"carried by {', '.join(carried.by)}" if carried.by else f"not carried to {program}"
        if carried.would:
            stated = study.export.get(MUJOCO, {}).get(carried.would)
            formula = f"{stated} + {carried.cause}" if stated else carried.cause
            how += f", unless export.mujoco says `{carried.would}: {formula}`"
        out.append(f"  {words_of(carried.cause)}: {how}; without it off: {', '.join(cost)}")
    return out or [f"  no cause is named: {program} gets the fitted model as it is"]


def _read(value: float, channel: Channel) -> str:
    """A number in a channel's shown unit, small ones with a prefix."""
    unit, times = small_scale(channel.shown_unit or channel.unit, (value,))
    return f"{figure(times * value)}{after_number(unit)}"


def _times(channel: Channel) -> float:
    """Factor from a channel's unit to the one that it is shown in."""
    if channel.shown_unit is None:
        return 1.0
    return factor(channel.unit, channel.shown_unit)
