"""A study's own MJCF with the numbers and causes of an answer, flown against the answer itself."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.export_flight import Answer, CarriedCause, Flight
from diffsim.core.files import write_text_atomic
from diffsim.data.study import Run, Study
from diffsim.systems.outside.description import MJCF, OutsideDescription
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.registry import description_of

#: Causes that an element of MuJoCo is, by the array of the joint's axis that grows by their size
_AT_JOINTS = {
    "viscous_friction": "joint.{}.damping",
    "dry_friction": "joint.{}.frictionloss",
    "added_spring": "joint.{}.stiffness",
}


def is_mjcf(study: Study) -> bool:
    """Whether the study's simulator is a MuJoCo model."""
    return study.model is not None and study.model.get("simulator") == MJCF


def restate_mjcf(answer: Answer, out: Path) -> tuple[list[Path], list[CarriedCause], list[Flight]]:
    """Write the MJCF that moves as the answer does, as far as MuJoCo has its causes.

    Args:
        answer: The saved model.
        out: Folder to write to.

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
        size = sum(answer.saved.values[c] for c in components)
        path = _carry(sim, described, cause, size, numbers)
        by = () if path is None else (path,)
        carried.append(CarriedCause(cause, by, answer.cost(components)))
    text, files = sim.restated({n: v for n, v in numbers.items()})
    wrote = [write_text_atomic(out / "model.xml", text)]
    for name, content in files.items():
        (out / name).write_bytes(content)
        wrote.append(out / name)
    again = Mjcf(str(out / "model.xml"), **_readings(source.options))
    return wrote, carried, [_fly(answer, described, again, run) for run in answer.runs]


def _carry(
    sim: Mjcf, described: OutsideDescription, cause: str, size: float, numbers: dict[str, float]
) -> str | None:
    """Let a number of the model hold a cause; the path of the number, None: there is none."""
    for law, path in _AT_JOINTS.items():
        for place in described.hooks.force:
            if cause == f"{law}_at_{re.sub(r'[^A-Za-z0-9]+', '_', place).strip('_')}":
                full = path.format(place)
                numbers[full] = numbers.get(full, sim.value_of(full)) + size
                return full
    return None


def _readings(options: Mapping[str, Any]) -> dict[str, Any]:
    return {k: options[k] for k in ("channels", "commands", "held") if k in options}


def _fly(answer: Answer, described: OutsideDescription, sim: Mjcf, run: Run) -> Flight:
    """The written file on a run, from the start of the answer in it."""
    starts = {}
    for name, quantity in described.start.items():
        own = [v for c, v in answer.saved.values.items() if c in (name, f"{name}@{run.name}")]
        starts[name] = own[0] if own else float(quantity.value)
    flown, own_record, seen = sim.predict(starts, run), answer.record(run), run.measured
    off = [
        float(np.nanmean(np.abs(a - b)[:, 0]))
        for a, b in ((own_record, seen), (flown, seen), (flown, own_record))
    ]
    return Flight(run.name, *off)
