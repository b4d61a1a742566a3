"""The alternating loop of thesis Alg. 7: execute, identify, optimise the command, execute again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from diffsim._check import require_number
from diffsim._files import write_json_atomic
from diffsim.data.study import Run
from diffsim.data.study_file import STUDY_FILE, load_study, save_study
from diffsim.sim_to_real.command import Command
from diffsim.sim_to_real.hardware import Hardware, as_study
from diffsim.sim_to_real.identification import FitSettings, Identified, identify, loss_of
from diffsim.sim_to_real.model import Starfish
from diffsim.sim_to_real.trajectory import (
    TrajectorySettings,
    optimise,
    speed,
    travel_loss,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """How long the loop goes on, and how its two optimisations are made.

    Attributes:
        max_iterations: After the baseline.
        tolerance: Converged where the measured speed changes by less than this share.
        memory: Latest recordings that parameters are fitted to; 1 in Alg. 7.
        fit, trajectory: Of the optimisations.
    """

    max_iterations: int = 5
    tolerance: float = 0.03
    memory: int = 1
    fit: FitSettings = field(default_factory=FitSettings)
    trajectory: TrajectorySettings = field(default_factory=TrajectorySettings)

    def __post_init__(self) -> None:
        require_number("max_iterations", self.max_iterations, at_least=1)
        require_number("tolerance", self.tolerance, at_least=0.0)
        require_number("memory", self.memory, at_least=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Iteration:
    """One row of Table 5.2, with what it was made from.

    Iteration 0 is bl-ctrl: the first guesses and the hand-made command. Iteration 1 is bl-one-iter.

    Attributes:
        idx: From 0.
        values: theta, by name, that ``command`` was optimised for.
        identified: How theta was found, from the recordings before; None in iteration 0.
        loss_theta: L_theta [m^2]: of theta on the recordings that it was fitted to; in iteration 0
            of the first guesses on the recording of this command.
        loss_action: L_a of ``command`` with theta [m].
        loss_action_before: L_a of the command before, with theta [m].
        command: Executed in this iteration.
        run: Its recording.
        centre_m: (num_samples,) x of the centre of mass, simulated with theta for ``command``, from
            its start [m].
        markers_m: (num_samples, 8) displacements of the markers, simulated, as ``centre_m``.
        speed_simulated: v_s, predicted before the experiment [m/s].
        speed_measured: v_r [m/s].
    """

    idx: int
    values: dict[str, float]
    identified: Identified | None
    loss_theta: float
    loss_action: float
    loss_action_before: float
    command: Command
    run: Run
    centre_m: Array
    markers_m: Array
    speed_simulated: float
    speed_measured: float


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopResult:
    """What the loop found.

    Attributes:
        iterations: In order; ``iterations[0]`` is bl-ctrl, ``iterations[1]`` bl-one-iter.
        converged: Whether the measured speed stopped changing before the iterations ran out.
        hardware: Name of the hardware.
        virtual: Whether no matter moved.
    """

    iterations: tuple[Iteration, ...]
    converged: bool
    hardware: str
    virtual: bool

    @property
    def best(self) -> Iteration:
        """The iteration with the highest measured speed."""
        return max(self.iterations, key=lambda i: i.speed_measured)

    @property
    def best_so_far(self) -> list[float]:
        """Highest measured speed up to each iteration [m/s]; never falls."""
        return np.maximum.accumulate([i.speed_measured for i in self.iterations]).tolist()


def sim_to_real(
    model: Starfish,
    hardware: Hardware,
    command: Command,
    folder: str | Path,
    settings: LoopSettings | None = None,
    *,
    resume: bool = False,
    progress: bool = True,
) -> LoopResult:
    """Run Alg. 7; what is done is on disk at once, and a resumed loop does none of it again.

    Args:
        model: With priors and first guesses.
        hardware: Executes commands.
        command: The hand-made one.
        folder: Of the loop: one subfolder per iteration with command, recording and numbers.
        settings: How.
        resume: Go on in a folder that holds a loop.
        progress: Show a bar.

    Raises:
        FileExistsError: the folder holds a loop and ``resume`` is off.
        ValueError: resumed with other settings, or a command beyond the hardware's limits.
    """
    settings = settings or LoopSettings()
    command.check(hardware.limits)
    folder = Path(folder)
    _open(folder, model, hardware, settings, resume)
    done: list[Iteration] = []
    converged = False
    with tqdm(total=settings.max_iterations + 1, desc="sim to real", disable=not progress) as bar:
        for k in range(settings.max_iterations + 1):
            place = folder / f"iteration_{k}"
            bar.set_description(f"iteration {k}: identify, optimise")
            if k == 0:
                planned = _planned(place) or _baseline(place, model, command, settings)
            else:
                planned = _planned(place) or _plan(place, model, hardware, settings, done)
            bar.set_description(f"iteration {k}: execute")
            run = _executed(place, hardware, planned.command, k)
            done.append(_row(place, model, hardware, settings, planned, run, k))
            bar.update()
            bar.set_postfix_str(f"v_r = {1e2 * done[-1].speed_measured:.3f} cm/s")
            if k and _is_converged(done, settings.tolerance):
                converged = True
                break
    return LoopResult(
        iterations=tuple(done),
        converged=converged,
        hardware=hardware.name,
        virtual=hardware.virtual,
    )


@dataclass(frozen=True, eq=False)
class _Planned:
    """What is known before the experiment."""

    values: dict[str, float]
    command: Command
    identified: Identified | None
    loss_action: float
    loss_action_before: float


def _open(
    folder: Path, model: Starfish, hardware: Hardware, settings: LoopSettings, resume: bool
) -> None:
    file = folder / "loop.json"
    now = {
        "hardware": hardware.name,
        "duration_s": hardware.duration_s,
        "limits": asdict(hardware.limits),
        "settings": asdict(settings),
        "model": asdict(model),
    }
    now = json.loads(json.dumps(now, default=str).replace("Infinity", '"inf"'))
    if not file.exists():
        write_json_atomic(file, now)
        return
    if not resume:
        raise FileExistsError(f"{folder} already holds a loop; resume it or take another folder")
    then = json.loads(file.read_text())
    # more iterations may be asked for; everything else would mix two loops
    for entry in (now, then):
        entry["settings"] = {k: v for k, v in entry["settings"].items() if k not in _MAY_CHANGE}
    if changed := [key for key in now if now[key] != then.get(key)]:
        raise ValueError(
            f"{folder} holds a loop with another {' and '.join(changed)}; resume it with the same, "
            "or take another folder"
        )


_MAY_CHANGE = ("max_iterations", "tolerance")


def _planned(place: Path) -> _Planned | None:
    """The saved plan of an iteration, None where there is none."""
    file = place / "plan.json"
    if not file.exists():
        return None
    saved: dict[str, Any] = json.loads(file.read_text())
    found = saved["identified"]
    return _Planned(
        saved["values"],
        Command(np.array(saved["contraction_m"])),
        None if found is None else Identified.from_plain(found),
        saved["loss_action"],
        saved["loss_action_before"],
    )


def _save_plan(place: Path, planned: _Planned) -> _Planned:
    found = planned.identified
    write_json_atomic(
        place / "plan.json",
        {
            "values": planned.values,
            "contraction_m": planned.command.contraction_m,
            "identified": None if found is None else found.plain(),
            "loss_action": planned.loss_action,
            "loss_action_before": planned.loss_action_before,
        },
    )
    return planned


def _baseline(place: Path, model: Starfish, command: Command, settings: LoopSettings) -> _Planned:
    """bl-ctrl: first guesses of Table 5.1 and the hand-made command."""
    values = {p.name: p.value for p in model.parameters}
    with torch.no_grad():
        period = torch.from_numpy(command.contraction_m)
        loss = float(travel_loss(model, values, period, settings.trajectory.periods))
    return _save_plan(place, _Planned(values, command, None, loss, loss))


def _plan(
    place: Path,
    model: Starfish,
    hardware: Hardware,
    settings: LoopSettings,
    done: list[Iteration],
) -> _Planned:
    """Identify on the latest recordings, then optimise the command."""
    found = _identified(place, model, settings, done)
    shared = [p.name for p in model.parameters]
    values = {name: found.values[name] for name in shared}
    best = optimise(model, values, done[-1].command, hardware.limits, settings.trajectory)
    return _save_plan(
        place, _Planned(values, best.command, found, best.loss_after, best.loss_before)
    )


def _identified(
    place: Path, model: Starfish, settings: LoopSettings, done: list[Iteration]
) -> Identified:
    file = place / "identified.json"
    if file.exists():
        return Identified.from_plain(json.loads(file.read_text()))
    last = done[-1]
    start: Mapping[str, float] = last.values if last.identified is None else last.identified.values
    runs = [i.run for i in done[-settings.memory :]]
    found = identify(model, runs, settings.fit, start=start)
    write_json_atomic(file, found.plain())
    return found


def _executed(place: Path, hardware: Hardware, command: Command, k: int) -> Run:
    """The recording of an iteration, made only where there is none yet."""
    study = place / "recording" / STUDY_FILE
    if not study.exists():
        run = hardware.execute(command, order=k)
        save_study(as_study(run, hardware.name), study.parent)
    return load_study(study).runs[0]


def _row(
    place: Path,
    model: Starfish,
    hardware: Hardware,
    settings: LoopSettings,
    planned: _Planned,
    run: Run,
    k: int,
) -> Iteration:
    """The numbers of an iteration; simulated for as long as the recording lasts."""
    period_s = planned.command.period_s
    with torch.no_grad():
        wish = torch.from_numpy(planned.command.during(hardware.duration_s))
        motion = model.motion(planned.values, wish).numpy()
    motion = motion - motion[0]
    times = np.arange(len(motion)) / 60.0
    if planned.identified is None:
        loss = loss_of(model, run, planned.values, settings.fit.duration_s)
    else:
        loss = planned.identified.loss_after
    row = Iteration(
        idx=k,
        values=planned.values,
        identified=planned.identified,
        loss_theta=loss,
        loss_action=planned.loss_action,
        loss_action_before=planned.loss_action_before,
        command=planned.command,
        run=run,
        centre_m=motion[:, -1],
        markers_m=motion[:, :-1],
        speed_simulated=speed(times, motion[:, :-1:2], period_s),
        speed_measured=speed(run.time_s, run.measured[:, ::2], period_s),
    )
    write_json_atomic(
        place / "row.json",
        {
            "iteration": k,
            "L_theta_m2": row.loss_theta,
            "L_a_m": row.loss_action,
            "v_s_m_s": row.speed_simulated,
            "v_r_m_s": row.speed_measured,
            "values": row.values,
        },
    )
    return row


def _is_converged(done: list[Iteration], tolerance: float) -> bool:
    last, before = done[-1].speed_measured, done[-2].speed_measured
    return abs(last - before) <= tolerance * max(abs(last), abs(before))
