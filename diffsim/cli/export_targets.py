"""``diffsim diagnose export --to TARGET``: an answer as a file of another program, and its list.

| target | files |
|---|---|
| ``mujoco`` | constants, a drive on a joint with its callback; or the study's own MJCF, restated |
| ``bam`` | constants of BAM's smallest model m1 to m5 that has what is named |
| ``urdf`` | ``<dynamics>`` and ``<limit>`` of the joint |
| ``yaml`` | all numbers and causes with their forms, for any program |
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffsim.cli.diagnose_export import flown_constants
from diffsim.cli.export_flight import (
    CARRIED_FILE,
    FLOWN,
    MUJOCO,
    Answer,
    CarriedCause,
    Flight,
    fly_all,
    list_carried,
    say_carried,
    say_flights,
    write_drive,
)
from diffsim.cli.export_mjcf import is_mjcf, restate_mjcf
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.data.study import Study
from diffsim.identify.model_file import SavedModel
from diffsim.identify.ranges import range_of_number
from diffsim.systems.outside.joint_drive import DEFAULTS

BAM, URDF, YAML = "bam", "urdf", "yaml"
#: Constants of a drive that a target's own equations have; MuJoCo's callback has all
_RIG = (
    "kp",
    "forcerange",
    "load_inertia",
    "load_moment",
    "load_mass",
    "load_arm",
    "zero_rad",
    "stick_speed",
)
_HAS = {
    MUJOCO: tuple(DEFAULTS),
    BAM: (*_RIG, "damping", "brake", "frictionloss", "armature", "stribeck", "stribeck_speed",
          "load_friction", "back_driving"),
    URDF: (*_RIG, "damping", "brake", "frictionloss"),
}  # fmt: skip


def only_target(study: Study, target: str) -> Study:
    """The study with the formulas of one program; of URDF and YAML the constants are MuJoCo's."""
    program = target if target in (MUJOCO, BAM) else MUJOCO
    found = study.export.get(program, {})
    return replace(study, export={program: found} if found and target != YAML else {})


def export_to(target: str, study: Study, saved: SavedModel, out: Path) -> None:
    """Write the files of a target, and say what they carry and how they move.

    Args:
        target: One of "mujoco", "bam", "urdf", "yaml".
        study: The study with all of its formulas.
        saved: Its answer.
        out: Folder to write to.

    Raises:
        ValueError: the target needs what the study does not state.
    """
    answer, study = Answer(study, saved), only_target(study, target)
    channel = answer.study.channels[0]
    flights: list[Flight] | str
    if target == YAML:
        files = [write_text_atomic(out / "answer.yaml", _as_yaml(answer))]
        carried = [replace(c, by=("answer.yaml",)) for c in list_carried(answer, YAML)]
        flights = "it holds the answer itself, in no program's words"
    elif target == MUJOCO and is_mjcf(answer.study):
        files, carried, flights = restate_mjcf(answer, out)
    else:
        if not study.export:
            raise ValueError(
                f"{study.name}: `--to {target}` needs the constants of a drive on a joint; name "
                f"them in the study: export: {{mujoco: {{{', '.join(FLOWN)}, ...}}}}, or start "
                "from `like: position_servo`"
            )
        carried = [_without(c, target) for c in list_carried(answer, next(iter(study.export)))]
        files = _write_drive(answer, target, out)
        flights = _fly(answer, target)
    for file in files:
        print(f"wrote {file}")
    print(f"Causes of the answer, and what they are worth on {len(answer.runs)} runs:")
    for line in say_carried(carried, answer.study, target):
        print(line)
    print(say_flights(flights, channel))
    content = {
        "target": target,
        "causes": [asdict(c) for c in carried],
        "flights": flights if isinstance(flights, str) else [asdict(f) for f in flights],
    }
    print(f"wrote {write_json_atomic(out / CARRIED_FILE, content)}")


def _without(carried: CarriedCause, target: str) -> CarriedCause:
    """A cause, carried only by constants that the target has."""
    if target == BAM:
        return carried
    return replace(carried, by=tuple(n for n in carried.by if n in _HAS[target]))


def _write_drive(answer: Answer, target: str, out: Path) -> list[Path]:
    if target == BAM or any(n not in answer.study.export.get(MUJOCO, {}) for n in FLOWN):
        return []  # constants alone, which are written already
    if target == MUJOCO:
        return write_drive(answer, out)
    run = answer.runs[0]
    c = flown_constants(answer.study, answer.saved, MUJOCO, run)
    text = (
        "<!-- of the joint, beside its parent and child; a URDF has no place for the rest -->\n"
        f'<dynamics damping="{c.get("damping", 0.0):.6g}" '
        f'friction="{c.get("frictionloss", 0.0):.6g}"/>\n'
        f'<limit effort="{c.get("forcerange", 0.0):.6g}" '
        f'velocity="{1.0 / max(c.get("rate_limit_s", 0.0), 1e-3):.6g}"/>\n'
    )
    return [write_text_atomic(out / "joint.urdf.xml", text)]


def _fly(answer: Answer, target: str) -> list[Flight] | str:
    """The drive with what the target has of it, on the runs."""
    formulas = answer.study.export.get(MUJOCO, {})
    kept = {name: text for name, text in formulas.items() if name in _HAS[target]}
    return fly_all(answer, kept)


def _as_yaml(answer: Answer) -> str:
    saved, forms = answer.saved, {e.name: e.form for e in answer.setup.effects}
    numbers: dict[str, Any] = {}
    for name in saved.values:
        found = range_of_number(saved, name)
        entry = {"value": found.value, "low": found.low, "high": found.high}
        numbers[name] = {k: float(np.round(v, 12)) for k, v in entry.items()}
        numbers[name]["unit"] = saved.units.get(name, "")
        if (form := forms.get(name.partition(".")[0])) is not None:
            numbers[name]["form"] = form
    split = {name: name in saved.components for name in numbers}
    return yaml.safe_dump(
        {
            "study": saved.study,
            "verdict": saved.verdict,
            "parameters": {n: v for n, v in numbers.items() if not split[n]},
            "causes": {n: v for n, v in numbers.items() if split[n]},
        },
        sort_keys=False,
    )
