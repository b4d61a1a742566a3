"""A study's own MJCF with the numbers and causes of an answer, flown against the answer itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.causes.row import spell_plainly
from diffsim.cli.export_flight import Answer, CarriedCause, Flight
from diffsim.core.files import write_bytes_atomic, write_text_atomic
from diffsim.data.study import Run, Study
from diffsim.systems.outside.description import MJCF, OutsideDescription
from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_laws import OWN_LAWS, path_of_law
from diffsim.systems.registry import description_of


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
    text, files = sim.restated(numbers)
    wrote = [write_text_atomic(out / "model.xml", text)]
    wrote += [write_bytes_atomic(out / name, content) for name, content in files.items()]
    again = Mjcf(str(out / "model.xml"), **_readings(source.options))
    return wrote, carried, [_fly(answer, described, again, run) for run in answer.runs]


def _path_of(sim: Mjcf, described: OutsideDescription, cause: str) -> str | None:
    """The number of the model that a cause adds to; None: there is none."""
    for body in sim.carriers:
        if cause == f"payload_at_{spell_plainly(body)}":
            return f"body.{body}.payload"
    for law in OWN_LAWS:
        for place in described.hooks.force:
            if cause == f"{law}_at_{spell_plainly(place)}":
                return path_of_law(sim.mujoco, sim.numbers, law, place)
    return None


def _carry(
    sim: Mjcf, described: OutsideDescription, cause: str, size: float, numbers: dict[str, float]
) -> str | None:
    """Let a number of the model hold a cause; the path of the number, None: there is none."""
    path = _path_of(sim, described, cause)
    if path is not None:
        numbers[path] = numbers.get(path, sim.value_of(path)) + size
    return path


def _readings(options: Mapping[str, Any]) -> dict[str, Any]:
    return {k: options[k] for k in ("channels", "commands", "held") if k in options}


def _fly(answer: Answer, described: OutsideDescription, sim: Mjcf, run: Run) -> Flight:
    """The written file on a run, from the start of the answer in it."""
    starts = {}
    for name, quantity in described.start.items():
        found = [v for c, v in answer.saved.values.items() if c in (name, f"{name}@{run.name}")]
        starts[name] = found[0] if found else float(quantity.value)
    flown, own = sim.predict(starts, run)[:, 0], answer.record(run)[:, 0]
    seen = run.measured[:, 0]
    return Flight.of(run.name, answer.study.channels[0], own, flown, seen, np.isfinite(seen))
