"""A case as files: what a diagnosis sees in one folder, the truth in a file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from labs.unlisted.catalog import COLOR, LOST_ROWS
from labs.unlisted.courses import COLUMNS
from labs.unlisted.draw import Case, Misfit, sized
from labs.unlisted.machine import Machine, simulate

Array = NDArray[np.float64]
STUDY, CLEAN, TRUTH = "study", "without_noise", "truth.yaml"
VISIBLE = 3.0  # lambda below which nothing can be told
AUTOCORRELATION, LOST = 0.6, 0.02  # of colored noise from sample to sample; of lost rows


@dataclass(frozen=True)
class Recording:
    """A case that was recorded."""

    study: Mapping[str, Any]  # content of ``study.yaml``
    tables: Mapping[str, Mapping[str, Array]]  # columns by name, by file
    # the same, without the noise of unseen runs: for the score alone
    clean: Mapping[str, Mapping[str, Array]]
    truth: Mapping[str, Any]  # what is hidden


def recorded(case: Case, size: float | None = None) -> Recording:
    """Record a case.

    Args:
        case: As drawn.
        size: Of its law; none: as visible as wanted.
    """
    size, misfit = sized(case) if size is None else (size, Misfit(0.0, {}))
    clean = simulate(case.machine, case.numbers, case.courses, case.law, size)
    tables = _tables(case, clean)
    return Recording(
        _study(case), tables, _without_noise(case, tables, clean), truth_of(case, size, misfit)
    )


def write(recording: Recording, folder: Path) -> None:
    """Write ``study/``; beside it ``truth.yaml``, and ``without_noise/``, the same study.

    Args:
        recording: Of a case.
        folder: Of the case; made.
    """
    for part, tables in ((STUDY, recording.tables), (CLEAN, recording.clean)):
        (folder / part).mkdir(parents=True, exist_ok=True)
        _write_yaml(folder / part / "study.yaml", recording.study)
        for name, columns in tables.items():
            rows, header = np.column_stack(list(columns.values())), ",".join(columns)
            path = folder / part / name
            np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    _write_yaml(folder / TRUTH, recording.truth)


def _write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False, width=100), encoding="utf-8")


def _study(case: Case) -> dict[str, Any]:
    machine = case.machine
    runs: list[dict[str, Any]] = []
    for k, use in enumerate(case.uses):
        run = {"name": f"run_{k + 1}", "file": f"run_{k + 1}.csv", "use": use}
        runs.append(run | ({"repeat_of": "run_1"} if case.repeats and k == 4 else {}))
    return {
        "name": machine.name,
        "time": {"column": "time", "unit": "s"},
        "channels": [
            {"name": name, "column": name, "unit": d.unit, "sd": float(d.sd * d.per_si)}
            for name, d in machine.dials.items()
        ],
        "commands": [
            {"name": name, "column": name, "unit": d.unit or "-",
             "lower": d.middle - 1.2 * d.reach, "upper": d.middle + 1.2 * d.reach}
            for name, d in machine.drives.items()
        ],
        "runs": runs,
        "model": _model(machine),
    }  # fmt: skip


def _model(machine: Machine) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, sheet in machine.numbers.items():
        said: dict[str, Any] = {"value": sheet.value, "percent": sheet.percent}
        numbers[name] = said | ({"unit": sheet.unit} if sheet.unit else {})
        if not sheet.percent:
            numbers[name] = sheet.value
    model: dict[str, Any] = {
        "system": "ode",
        "states": dict(machine.states),
        "inputs": [{"name": name, "held": True} for name in machine.drives],
        "parameters": numbers,
        **machine.more,
        "rates": dict(machine.texts),
        "readings": {name: d.formula for name, d in machine.dials.items()},
    }
    if machine.places:
        model["places"] = [dict(place) for place in machine.places]
    return model


def _tables(case: Case, clean: Array) -> dict[str, dict[str, Array]]:
    machine = case.machine
    rng = np.random.default_rng(case.noise)
    time = machine.step_s * np.arange(float(machine.count))
    tables: dict[str, dict[str, Array]] = {}
    for k in range(len(case.uses)):
        table = {"time": time}
        for j, (name, dial) in enumerate(machine.dials.items()):
            noise = dial.sd * _unit_noise(rng, machine.count, case.kind.dirt)
            table[name] = dial.per_si * (clean[j, k] + noise)
        table |= {name: course[k] for name, course in case.courses.commands.items()}
        for name, course in case.courses.columns.items():
            table[name] = course[k] + COLUMNS[name][-1] * rng.standard_normal(machine.count)
        kept = np.ones(machine.count, dtype=bool)
        if case.kind.dirt == LOST_ROWS:
            kept = rng.random(machine.count) >= LOST
            kept[0] = True
        tables[f"run_{k + 1}.csv"] = {name: column[kept] for name, column in table.items()}
    return tables


def _without_noise(
    case: Case, tables: Mapping[str, Mapping[str, Array]], clean: Array
) -> dict[str, dict[str, Array]]:
    """The tables, those of unseen runs as the channels would show them without noise."""
    machine, out = case.machine, {file: dict(table) for file, table in tables.items()}
    for k, (file, table) in enumerate(tables.items()):
        if case.uses[k] != "test":
            continue
        rows = np.rint(table["time"] / machine.step_s).astype(int)
        shown = zip(machine.dials.items(), clean[:, k], strict=True)
        out[file] |= {name: d.per_si * course[rows] for (name, d), course in shown}
    return out


def _unit_noise(rng: np.random.Generator, count: int, dirt: str) -> Array:
    """White, or with the same variance colored."""
    from scipy.signal import lfilter

    white = rng.standard_normal(count + 50)
    if dirt != COLOR:
        return white[50:]
    scale = np.sqrt(1.0 - AUTOCORRELATION**2)
    colored: Array = scale * lfilter([1.0], [1.0, -AUTOCORRELATION], white)[50:]
    return colored


def truth_of(case: Case, size: float, misfit: Misfit) -> dict[str, Any]:
    """What is hidden, in types that YAML has.

    Args:
        case: As drawn.
        size: Of its law.
        misfit: Of the plain machine.
    """
    law = case.law
    truth: dict[str, Any] = {
        "case": case.name,
        "group": case.kind.group,
        "machine": case.machine.name,
        "dirt": case.kind.dirt,
        "size": float(size),
        "lambda": misfit.strength,
        "wanted_lambda": case.wanted,
        "numbers_of_machine": {n: float(v) for n, v in case.numbers.items()},
        "error_above_noise_on_test_runs": dict(misfit.rms),
        "noise": {name: d.sd for name, d in case.machine.dials.items()},
    }
    if law is None or size == 0.0:
        return truth
    is_nearly_line = misfit.strength * law.bend(size) < VISIBLE
    return truth | {
        "entry": [{"kind": kind, "target": target} for kind, target in law.entry],
        "variables": [list(names) for names in law.variables],
        "memory": list(law.memory),
        "forms": [*law.forms, *(["line"] if is_nearly_line else [])],
        "numbers": {n: float(v) for n, v in law.numbers(size).items()},
        "alike": list(law.alike),
    }
