"""Rigs with sound records, small and drawn: what is commanded, what is measured, a model of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]
Tables = dict[str, dict[str, Array]]
RUNS = ("a", "b", "c", "d", "e")


@dataclass(frozen=True)
class Folder:
    """A study as a user has it."""

    rig: str  # name of the rig
    study: Mapping[str, Any]  # content of study.yaml
    tables: Tables  # columns by run, the clock first
    digits: Mapping[str, str]  # format of the numbers, by column

    def write(self, folder: Path) -> Path:
        """Write study.yaml and the tables."""
        folder.mkdir(parents=True)
        text = yaml.safe_dump(dict(self.study), sort_keys=False)
        (folder / "study.yaml").write_text(text, encoding="utf-8")
        for run, table in self.tables.items():
            lines = [",".join(table)]
            formats = [self.digits.get(n, "%.10g" if n == "time_s" else "%.6g") for n in table]
            for row in zip(*table.values(), strict=True):
                cells = ("" if np.isnan(v) else f % v for f, v in zip(formats, row, strict=True))
                lines.append(",".join(cells))
            (folder / f"{run}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return folder

    def changed(self, tables: Tables, **study: Any) -> Folder:
        """The same with other tables and other keys of the study."""
        return replace(self, tables=tables, study={**self.study, **study})


def course(rng: np.random.Generator, t: Array, kind: str, size: float) -> Array:
    """What is commanded: a sum of sines, a chirp or steps."""
    end = float(t[-1])
    if kind == "steps":
        return size * np.sign(np.sin(2.0 * np.pi * rng.uniform(3.0, 6.0) * t / end + 0.3))
    if kind == "chirp":
        low, high = rng.uniform(1.0, 3.0), rng.uniform(8.0, 14.0)
        return size * np.sin(2.0 * np.pi * (low + 0.5 * (high - low) * t / end) * t / end)
    rates, phases = rng.uniform(2.0, 12.0, 3), rng.uniform(0.0, 6.0, 3)
    waves = np.sin(2.0 * np.pi * rates[:, None] * t / end + phases[:, None])
    return size * (np.array([0.6, 0.3, 0.2])[:, None] * waves).sum(0)


def followed(
    rate: Callable[[Any, float], Any], start: Array, u: Array, step: float, fine: int = 10
) -> Array:
    """States at the samples, (num_samples, num_states), of what a held command drives."""
    x, out = np.array(start, dtype=np.float64), np.empty((len(u), len(start)))
    if len(start) == 1:  # a number of Python has the same bits, three times sooner
        x = x.item()
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(fine):
            x = x + step / fine * rate(x, float(value))
    return out


def study_of(
    name: str,
    channels: list[dict[str, Any]],
    commands: list[dict[str, Any]],
    model: Mapping[str, Any],
) -> dict[str, Any]:
    """study.yaml of a rig with five runs."""
    return {
        "name": name,
        "channels": channels,
        "commands": commands,
        "runs": [
            *({"name": r} for r in RUNS[:3]),
            {"name": RUNS[3], "use": "select"},
            {"name": RUNS[4], "use": "test"},
        ],
        "model": {"system": "ode", **model},
    }


KINDS = ("sines", "chirp", "steps", "sines", "chirp")
