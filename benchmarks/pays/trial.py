"""One rig with one seed: record, diagnose, find commands with each model, execute them."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.pays.rigs import RIGS, Rig
from benchmarks.pays.rivals import learn_residual, randomized
from diffsim.data import Study, load_study
from diffsim.diagnose.diagnosis import diagnose
from diffsim.sim_to_real.tracking import Tracking, TrackingTask, best_command
from diffsim.systems.registry import setup_of
from diffsim.systems.twin import Twin

Array = NDArray[np.float64]
HERE = Path(__file__).parent
METHODS = ("plain", "randomized", "residual", "extended", "posterior", "truth")
RECORD_S, EVERY = 2.0, 0.02  # of a recorded run [s]
DRAWS = 8  # models that a robust command is good at in the mean
BUDGET = 2e7  # weighted steps of a search, as of `diffsim diagnose explain --budget 2e7`
SAID = ("verdict", "headline", "named")  # of a report
POLISH = 6  # Gauss-Newton steps on the rig itself, for the ceiling


@dataclass(frozen=True, eq=False)
class Trial:
    """A rig, its recordings, and its task."""

    # name, seed: of the rig
    name: str
    seed: int
    rig: Rig  # what stands for the hardware
    folder: Path  # with study.yaml, task.yaml and the recordings
    study: Study  # the recordings
    task: TrackingTask  # what is wanted

    @classmethod
    def made(cls, name: str, seed: int, out: Path) -> Trial:
        """Draw a rig, and record it into ``out/NAME_SEED``.

        Args:
            name: One of ``RIGS``.
            seed: Of parameters, hidden sizes, commands and noise.
            out: Folder of the folders.
        """
        rng = np.random.default_rng([seed, list(RIGS).index(name)])
        rig, folder = RIGS[name](rng), out / f"{name}_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(HERE / f"{name}.yaml", folder / "study.yaml")
        shutil.copy(HERE / f"{name}_task.yaml", folder / "task.yaml")
        _record(rig, folder, rng)
        study = load_study(folder / "study.yaml")
        return cls(
            name, seed, rig, folder, study, Tracking.read(folder / "task.yaml").for_study(study)
        )

    def execute(self, knots: Array) -> Array:
        """What the rig does with a command, (num_samples, num_channels)."""
        commands = self.task.commands(torch.from_numpy(knots))
        return self.rig.record(self.task.given.time_s, [c.numpy() for c in commands.values()])

    def score(self, knots: Array) -> float:
        """Root mean square of the rig's misses with a command."""
        return float(self.task.score(torch.from_numpy(self.execute(knots))))


def _record(rig: Rig, folder: Path, rng: np.random.Generator) -> None:
    """A CSV for every run that study.yaml names."""
    from diffsim.core.yaml_text import read_yaml_file

    stated = read_yaml_file(folder / "study.yaml")
    t = EVERY * np.arange(round(RECORD_S / EVERY) + 1.0)
    a, b = 1.0 + 0.2 * rng.random(2)
    for run in stated["runs"]:
        shapes = _shapes(run["name"].removesuffix("_again"), t, a, b)
        columns = []
        for k, given in enumerate(stated["commands"]):
            low, high = given["lower"], given["upper"]
            shape = shapes[k]
            columns.append(0.6 * high * shape if low < 0 else 0.4 * high * (1.0 + shape - shape[0]))
        seen = rig.record(t, columns)
        seen = seen + rng.standard_normal(seen.shape) * [c["sd"] for c in stated["channels"]]
        header = ["t_s", *(c["column"] for c in (*stated["channels"], *stated["commands"]))]
        np.savetxt(
            folder / run["file"],
            np.column_stack([t, seen, *columns]),
            delimiter=",",
            header=",".join(header),
            comments="",
            fmt="%.7g",
        )


def _shapes(kind: str, t: Array, a: float, b: float) -> list[Array]:
    """Courses of two commands, within -1 and 1."""
    ramp = np.minimum(t / 0.1, 1.0)
    steps = np.interp(t, [0, 0.2, 0.25, 0.8, 0.85, 1.4, 1.45, 2], [0, 0, 1, 1, -1, -1, 0.3, 0.3])
    return {
        "sine": [ramp * np.sin(5.0 * a * t), ramp * np.sin(7.0 * b * t + 0.5)],
        "steps": [steps, -np.roll(steps, 12) * ramp],
        "chirp": [
            ramp * np.sin(2 * np.pi * (0.5 + 0.6 * b * t) * t),
            ramp * np.sin(2 * np.pi * (0.8 + 0.5 * a * t) * t + 1.0),
        ],
        "mixed": [
            0.5 * ramp * (np.sin(3.1 * t) + np.sin(8.3 * t + 0.4)),
            0.5 * ramp * (np.sin(4.3 * t + 1.0) + np.sin(9.1 * t)),
        ],
    }[kind]


def explain(trial: Trial) -> dict[str, Any]:
    """Diagnose the recordings, as ``diffsim diagnose explain`` does, into the folder.

    An answer that is there is kept: the seed makes the same recordings.

    Returns:
        What a report says first, and the causes by name.
    """
    kept = trial.folder / "diagnosis" / "report.json"
    if kept.is_file():
        said = json.loads(kept.read_text(encoding="utf-8"))
        return {key: said[key] for key in SAID}
    setup = setup_of(trial.study)
    search = replace(setup.settings.search, scan_steps=BUDGET, refit_steps=BUDGET, law_steps=BUDGET)
    report = diagnose(
        setup.study or trial.study,
        setup.model,
        setup.effects,
        seed=0,
        unknowns=setup.unknowns,
        settings=replace(setup.settings, search=search),
        laws=setup.laws,
    )
    report.save(trial.folder / "diagnosis")
    return {key: getattr(report, key) for key in SAID}


def run(name: str, seed: int, out: Path) -> dict[str, Any]:
    """Everything for one rig and seed: scores on the rig by method, and what was found.

    Args:
        name: One of ``RIGS``.
        seed: Of the rig.
        out: Folder of the folders.
    """
    cpu: dict[str, float] = {}
    with _timed(cpu, "record"):
        trial = Trial.made(name, seed, out)
    with _timed(cpu, "diagnose"):
        said = explain(trial)
    rng = np.random.default_rng([seed, 1])
    task, time_s = trial.task, trial.task.given.time_s
    twin = Twin.read(trial.folder / "diagnosis", trial.study, time_s)
    plain = twin.plain()
    knots: dict[str, Array] = {}
    with _timed(cpu, "plain"):
        knots["plain"] = best_command(plain, task).knots
    start = [knots["plain"]]
    with _timed(cpu, "randomized"):
        drawn = randomized(plain, DRAWS, rng)
        knots["randomized"] = best_command(plain, task, at=drawn, starts=start).knots
    with _timed(cpu, "residual"):
        residual = learn_residual(twin, trial.study, rng)
        knots["residual"] = best_command(residual.put_in(plain), task, starts=start).knots
    with _timed(cpu, "extended"):
        knots["extended"] = best_command(twin, task, starts=start).knots
    with _timed(cpu, "posterior"):
        more = [knots["extended"]]
        knots["posterior"] = best_command(twin, task, at=twin.draw(DRAWS, rng), starts=more).knots
    scores = {method: trial.score(k) for method, k in knots.items()}
    with _timed(cpu, "truth"):
        knots["truth"] = polished(trial, knots[min(scores, key=lambda m: scores[m])])
    scores["truth"] = min(trial.score(knots["truth"]), *scores.values())
    return {
        "rig": name,
        "seed": seed,
        **said,
        "sizes": {c: twin.saved.values[c] for c in twin.saved.components},
        "residual": [residual.misfit_before, residual.misfit_after],
        "scores": scores,
        "knots": {method: k.tolist() for method, k in knots.items()},
        "cpu_s": cpu,
    }


def polished(trial: Trial, start: Array) -> Array:
    """The ceiling: the command improved on the rig itself, by differences of its runs."""
    task = trial.task

    def left(x: Array) -> Array:
        knots = torch.from_numpy(x)
        misses = task.misses(torch.from_numpy(trial.execute(x))).flatten()
        return torch.cat([misses, task.calm(knots)]).numpy()

    inside = np.clip(start, 1e-6, 1.0 - 1e-6)
    found = least_squares(left, inside, bounds=(0.0, 1.0), max_nfev=POLISH, diff_step=1e-3)
    return np.asarray(found.x)


@contextmanager
def _timed(into: dict[str, float], what: str) -> Iterator[None]:
    begin = time.process_time()
    yield
    into[what] = time.process_time() - begin
