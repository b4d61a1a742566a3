"""``diffsim diagnose export --to TARGET``: an answer as a file of another program, and its list.

| target | files |
|---|---|
| ``mujoco`` | constants, a drive on a joint with its callback; or the study's own MJCF, restated |
| ``bam`` | constants of BAM's smallest model m1 to m5 that has what is named |
| ``urdf`` | ``<dynamics>`` and ``<limit>`` of the joint; of an MJCF of each, and ``<inertial>`` |
| ``yaml`` | all numbers and causes with their forms, for any program |
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from diffsim.causes.row import spell_plainly
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
from diffsim.core.figures import counted
from diffsim.core.files import write_bytes_atomic, write_json_atomic, write_text_atomic
from diffsim.data.study import Run, Study
from diffsim.identify.model_file import SavedModel
from diffsim.identify.ranges import range_of_number
from diffsim.systems.outside.description import OutsideDescription
from diffsim.systems.outside.joint_drive import DEFAULTS
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_laws import OWN_LAWS, path_of_law, with_hold
from diffsim.systems.outside.source import MJCF
from diffsim.systems.registry import description_of

BAM, URDF, YAML = "bam", "urdf", "yaml"
ONLY = "size"  # of a cause's components
_IN_URDF = re.compile(r"\.(damping|frictionloss|payload|unbalance\[\d\])$")  # numbers of an MJCF
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

    Raises:
        ValueError: the target needs what the study does not state.
    """
    answer, study = Answer(study, saved), only_target(study, target)
    flights: list[Flight] | str
    if target == YAML:
        files = [write_text_atomic(out / "answer.yaml", _as_yaml(answer))]
        carried = [replace(c, by=("answer.yaml",), would="") for c in list_carried(answer, YAML)]
        flights = "it holds the answer itself, in no program's words"
    elif target in (MUJOCO, URDF) and is_mjcf(answer.study):
        files, carried, flights = restate_mjcf(answer, out, target)
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
    print(f"Causes of the answer, and what they are worth on {counted(len(answer.runs), 'run')}:")
    for line in say_carried(carried, answer.study, target):
        print(line)
    for line in say_flights(flights, answer.study.channels):
        print(line)
    content = {
        "target": target,
        "causes": carried,
        "flights": flights,
    }
    print(f"wrote {write_json_atomic(out / CARRIED_FILE, content)}")


def _without(carried: CarriedCause, target: str) -> CarriedCause:
    """A cause, carried only by constants that the target has."""
    if target == BAM:  # whose constants have names of their own
        return replace(carried, would="")
    has = _HAS[target]
    would = carried.would if carried.would in has else ""
    return replace(carried, by=tuple(n for n in carried.by if n in has), would=would)


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


def is_mjcf(study: Study) -> bool:
    """Whether the study's simulator is a MuJoCo model."""
    return study.model is not None and study.model.get("simulator") == MJCF


def restate_mjcf(
    answer: Answer, out: Path, target: str = MUJOCO
) -> tuple[list[Path], list[CarriedCause], list[Flight]]:
    """Write the MJCF that moves as the answer does, or what a URDF has of it.

    Args:
        answer: The saved model.
        target: "mujoco" or "urdf".

    Returns:
        The files, the list of causes, and how the written file moves on the runs.
    """
    described = description_of(answer.study)
    assert isinstance(described, OutsideDescription)
    source = described.source(answer.study)
    sim = Mjcf(**dict(source.options))
    numbers = {n: v for n, v in answer.saved.values.items() if n in described.parameters}
    known = {n: float(q.value) for n, q in described.parameters.items()}
    numbers = {**known, **numbers}
    carried = []
    for cause, components in answer.causes().items():
        paths = _paths_of(sim, described, cause)
        if target == URDF and not all(_IN_URDF.search(path) for path in paths.values()):
            paths = {}
        for component in components if paths else ():
            path = paths.get(component.rpartition(".")[2], paths.get(ONLY, ""))
            numbers[path] = numbers.get(path, sim.value_of(path)) + answer.saved.values[component]
            share = answer.saved.values.get(f"hold_of_{cause}", 1.0)
            numbers |= with_hold(sim.numbers, known, path, share)
        carried.append(CarriedCause(cause, tuple(paths.values()), answer.cost(components)))
    with TemporaryDirectory() as folder:
        place = out if target == MUJOCO else Path(folder)
        text, files = sim.restated(numbers)
        wrote = [write_text_atomic(place / "model.xml", text)]
        wrote += [write_bytes_atomic(place / name, content) for name, content in files.items()]
        again = Mjcf(str(place / "model.xml"), **_readings(source.options))
    if target == URDF:
        wrote = [write_text_atomic(out / "joints.urdf.xml", _as_urdf(again))]
    return (
        wrote,
        carried,
        [flight for run in answer.runs for flight in _fly_mjcf(answer, described, again, run)],
    )


def _as_urdf(sim: Mjcf) -> str:
    """Friction of each hinge and slide, its largest force, and the inertia of each body."""
    model, out = sim.plain, ["<!-- beside parent and child; a URDF has no place for the rest -->"]
    for j in range(model.njnt):
        if model.jnt_type[j] in (2, 3):
            dof = model.jnt_dofadr[j]
            efforts = [
                abs(model.actuator_gear[i, 0]) * np.abs(model.actuator_forcerange[i]).max()
                for i in range(model.nu)
                if model.actuator_trnid[i, 0] == j
                and model.actuator_trntype[i] in (0, 1)  # joints: tendons are counted by their own
                and model.actuator_forcelimited[i]
            ]
            limit = f'<limit effort="{sum(efforts):.6g}"/>' if efforts else ""
            out.append(
                f'<joint name="{model.joint(j).name}"><dynamics '
                f'damping="{model.dof_damping[dof]:.6g}" '
                f'friction="{model.dof_frictionloss[dof]:.6g}"/>{limit}</joint>'
            )
    for b in range(1, model.nbody):
        turn = Rotation.from_quat(np.roll(model.body_iquat[b], -1)).as_matrix()
        moments = turn @ np.diag(model.body_inertia[b]) @ turn.T  # along the axes of the body
        pairs = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))
        inertia = " ".join(f'i{name}="{moments[i, k]:.6g}"' for name, i, k in pairs)
        at = " ".join(f"{v:.6g}" for v in model.body_ipos[b])
        out.append(
            f'<link name="{model.body(b).name}"><inertial><origin xyz="{at}" rpy="0 0 0"/>'
            f'<mass value="{model.body_mass[b]:.6g}"/><inertia {inertia}/></inertial></link>'
        )
    return "\n".join(out) + "\n"


def _paths_of(sim: Mjcf, described: OutsideDescription, cause: str) -> dict[str, str]:
    """The numbers of the model that a cause adds to, by its sizes; {}: there are none."""
    for body in sim.carriers:
        if _is_at(cause, "payload", body):
            return {ONLY: f"body.{body}.payload"}
        if _is_at(cause, "unbalance", body):
            return {axis: f"body.{body}.unbalance[{k}]" for k, axis in enumerate("xyz")}
    for law in OWN_LAWS:
        for place in described.hooks.force:
            if _is_at(cause, law, place):
                path = path_of_law(sim.mujoco, sim.numbers, law, place)
                return {} if path is None else {ONLY: path}
    return {}


def _is_at(cause: str, row: str, place: str) -> bool:
    """Whether a cause is that of a row at a place; earlier files have small letters."""
    name = f"{row}_at_{spell_plainly(place)}"
    return cause in (name, name.lower())


def _readings(options: Mapping[str, Any]) -> dict[str, Any]:
    return {k: options[k] for k in ("channels", "commands", "held") if k in options}


def _fly_mjcf(answer: Answer, described: OutsideDescription, sim: Mjcf, run: Run) -> list[Flight]:
    """The written file on a run, channel by channel, from the start of the answer in it."""
    starts = {}
    for name, quantity in described.start.items():
        found = [v for c, v in answer.saved.values.items() if c in (name, f"{name}@{run.name}")]
        starts[name] = found[0] if found else float(quantity.value)
    pairs = zip(answer.record(run).T, sim.predict(starts, run).T, run.measured.T, strict=True)
    return [
        Flight.of(run.name, channel, own, flown, seen, np.isfinite(seen))
        for channel, (own, flown, seen) in zip(answer.study.channels, pairs, strict=True)
        if np.isfinite(seen).any()
    ]
