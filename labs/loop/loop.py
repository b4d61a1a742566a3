"""The alternating loop of thesis Alg. 7: execute, identify, optimize the command, execute again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from diffsim.core.files import write_json_atomic
from diffsim.core.progress import show_progress
from diffsim.data.study import Run
from diffsim.data.study_file import STUDY_FILE, load_study
from diffsim.data.study_save import save_study
from labs.loop.command import RATE_HZ, Command
from labs.loop.hardware import Hardware, as_study
from labs.loop.identification import Identified, identify, loss_of
from labs.loop.model import Starfish
from labs.loop.records import (
    Iteration,
    IterationPlan,
    LoopResult,
    LoopSettings,
    load_plan,
    open_loop,
    save_plan,
)
from labs.loop.trajectory import optimize, speed, travel_loss


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
        hardware: What executes commands and records them.
        command: The hand-made one.
        folder: Folder of the loop: one subfolder per iteration with command, recording and numbers.
        settings: Length of the loop, and budgets of its two optimizations.
        resume: Go on in a folder that holds a loop.
        progress: Show a bar.

    Raises:
        FileExistsError: the folder holds a loop and ``resume`` is off.
        ValueError: resumed with other settings, or a command beyond the hardware's limits.
    """
    settings = settings or LoopSettings()
    command.check(hardware.limits)
    folder = Path(folder)
    open_loop(folder, model, hardware, settings, resume)
    done: list[Iteration] = []
    converged = False
    count = settings.max_iterations + 1
    with show_progress(total=count, desc="sim to real", disable=not progress) as bar:
        for k in range(count):
            place = folder / f"iteration_{k}"
            bar.set_description(f"iteration {k}: identify, optimize")
            if k == 0:
                planned = load_plan(place) or _baseline(place, model, command, settings)
            else:
                planned = load_plan(place) or _plan(place, model, hardware, settings, done)
            bar.set_description(f"iteration {k}: execute")
            run = _execute_or_read(place, hardware, planned.command, k)
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


def _baseline(
    place: Path, model: Starfish, command: Command, settings: LoopSettings
) -> IterationPlan:
    """bl-ctrl: first guesses of Table 5.1 and the hand-made command."""
    values = {p.name: p.value for p in model.parameters}
    with torch.no_grad():
        period = torch.from_numpy(command.contraction_m)
        loss = float(travel_loss(model, values, period, settings.trajectory.periods))
    return save_plan(place, IterationPlan(values, command, None, loss, loss))


def _plan(
    place: Path,
    model: Starfish,
    hardware: Hardware,
    settings: LoopSettings,
    done: list[Iteration],
) -> IterationPlan:
    """Identify on the latest recordings, then optimize the command."""
    found = _identify_or_read(place, model, settings, done)
    shared = [p.name for p in model.parameters]
    values = {name: found.values[name] for name in shared}
    best = optimize(model, values, done[-1].command, hardware.limits, settings.trajectory)
    return save_plan(
        place, IterationPlan(values, best.command, found, best.loss_after, best.loss_before)
    )


def _identify_or_read(
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


def _execute_or_read(place: Path, hardware: Hardware, command: Command, k: int) -> Run:
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
    planned: IterationPlan,
    run: Run,
    k: int,
) -> Iteration:
    """The numbers of an iteration; simulated for as long as the recording lasts."""
    period_s = planned.command.period_s
    with torch.no_grad():
        wish = torch.from_numpy(planned.command.during(hardware.duration_s))
        motion = model.motion(planned.values, wish).numpy()
    motion = motion - motion[0]
    times = np.arange(len(motion)) / RATE_HZ
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
        center_m=motion[:, -1],
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
