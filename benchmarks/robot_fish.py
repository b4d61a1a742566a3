"""``python -m benchmarks.robot_fish --model FOLDER``: speeds of the robot fish by its own rule.

The speed of a recording is that of its authors: displacements of the head's middle in the head's
own direction, summed up; slope of a straight line over frame / 60. The model starts from rest at
the frequency that the file's name states and swims for 30 s; nothing of a recording is used but
that name. The last ten beats count. Beside it stand the straight line over the stated frequency
through the speeds of the two recordings that everything is fitted to, and the tail: mean of
|lateral place, simulated less measured| relative to the head and without mean, where the motor's
angle is chosen for each recording, as the authors do.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.systems.registry import load_extended

STUDY = Path(__file__).parents[1] / "diffsim/systems/published/robot_fish.yaml"
PUBLISHED = {"MuJoCo, as published": 0.019, "Lighthill's theory, as published": 0.134}
DURATION, FRAME, BEATS = 30.0, 1.0 / 60.0, 10
TAIL = ("tail5", "tail6", "tail7", "tail8")

HEAD = "| recording | use | measured, m/s | model | line | tail, mm |\n|---|---|---|---|---|---|"

Array = NDArray[np.float64]


def speed_of(time_s: Array, head: Array, heading: Array) -> float:
    """Speed by the authors' rule [m/s].

    Args:
        time_s: (num_samples,) [s].
        head: (num_samples, 2) middle of the head [m].
        heading: (num_samples,) direction from marker 0 to marker 1 [rad].
    """
    axis = np.stack([np.cos(heading), np.sin(heading)], -1)
    way = np.cumsum((axis[1:] * np.diff(head, axis=0)).sum(-1))  # towards the tail
    return -float(np.polyfit(time_s, np.concatenate([[0.0], way]), 1)[0])


def whole_recordings() -> Study:
    """The published study with every frame."""
    stated = yaml.safe_load(STUDY.read_text())
    stated["defaults"]["every"] = 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(yaml.safe_dump(stated, sort_keys=False))
        return load_study(path)


def swum(study: Study, model: Path, hz: float) -> tuple[Array, Array]:
    """Times and readings of the model that starts from rest at a stated frequency."""
    time_s = np.arange(0.0, DURATION, FRAME)
    names = [c.name for c in study.channels]
    measured = np.zeros((len(time_s), len(names)))
    setup = {"motor_hz": hz, "start_deg": 0.0}
    run = Run("from_rest", time_s, measured, {}, "from_rest", setup=setup)
    found = load_extended(model, replace(study, runs=(run,)))
    q = found.at_prior()
    still = [i for i, p in enumerate(found.base) if p.name == "ahead@from_rest"]
    q[still] = found.base[still[0]].coordinate_of(0.0)
    with torch.no_grad():
        return time_s, found.predict(run, q).numpy()


def cruise(study: Study, model: Path, hz: float) -> float:
    """Speed of the model at a stated frequency [m/s]."""
    time_s, read = swum(study, model, hz)
    last = time_s > time_s[-1] - BEATS / hz
    return speed_of(time_s[last], read[last, :2], read[last, 2])


def tail_error(study: Study, model: Path, run: Run) -> float:
    """Mean lateral error of the tail at the best angle of the motor [m]."""
    columns = [i for i, c in enumerate(study.channels) if c.name in TAIL]
    hz = float(run.setup["motor_hz"])
    time_s, read = swum(study, model, hz)
    truth = run.measured[:, columns] - np.nanmean(run.measured[:, columns], 0)
    errors = []
    for begin in np.arange(DURATION - 12.0, DURATION - 12.0 + 2.0 / hz, FRAME):
        tail = np.stack([np.interp(begin + run.time_s, time_s, read[:, i]) for i in columns], -1)
        errors.append(np.nanmean(np.abs(tail - tail.mean(0) - truth)))
    return float(min(errors))


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="answer of diagnose explain")
    args = parser.parse_args(argv)
    study = whole_recordings()
    hz = np.array([float(run.setup["motor_hz"]) for run in study.runs])
    truth = np.array([speed_of(r.time_s, r.measured[:, :2], r.measured[:, 2]) for r in study.runs])
    unseen = np.array([run.use == "test" for run in study.runs])
    line = np.polyval(np.polyfit(hz[~unseen], truth[~unseen], 1), hz)
    model = np.array([cruise(study, args.model, f) for f in hz])
    print(HEAD)
    for k, run in enumerate(study.runs):
        numbers = f"{truth[k]:.4f} | {model[k]:.4f} | {line[k]:.4f}"
        tail = 1e3 * tail_error(study, args.model, run)
        print(f"| {run.name} | {run.use} | {numbers} | {tail:.1f} |", flush=True)
    for name, found in (("model", model), ("line", line)):
        print(f"{name}: mean error of unseen runs {np.abs(found - truth)[unseen].mean():.4f} m/s")
    for name, error in PUBLISHED.items():
        print(f"{name}: {error:.3f} m/s over eight recordings, two of them fitted")


if __name__ == "__main__":
    with interruptible():
        main()
