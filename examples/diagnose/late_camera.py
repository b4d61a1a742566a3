"""A gantry whose belt has play, and a camera that is late while the encoder is not: which is which?

The script writes a folder as a user would have it: recordings in CSV files and ``study.yaml``. The
encoder sits on the motor. The camera sees the carriage, which lies anywhere in the play when a run
starts, and shows it 45 ms late. The description knows of neither.

Expected: "sensor_backlash_of_carriage", half a play of 0.9 mm, and "sensor_delay_of_carriage".
Running time: 10 s.

    python examples/diagnose/late_camera.py runs/gantry
    diffsim diagnose explain runs/gantry --out runs/answer    # the same with a page of pictures
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from diffsim.data import load_study
from diffsim.diagnose import Report, diagnose
from diffsim.systems import setup_of

STUDY = """
name: gantry
time: {column: t, unit: s}
channels:
  - {name: motor, unit: mm, sd: 0.01}
  - {name: carriage, unit: mm, sd: 0.05}
commands:
  - {name: setpoint, unit: mm}
runs:
  - {name: slow_a, file: slow_a.csv}
  - {name: slow_b, file: slow_b.csv, repeat_of: slow_a}
  - {name: fast, file: fast.csv}
  - {name: mixed, file: mixed.csv}
  - {name: chirp, file: chirp.csv, use: select}
  - {name: steps, file: steps.csv, use: test}
model:
  system: ode
  parameters:
    mass: {value: 2 kg, percent: 10}
    stiffness: {value: 900, percent: 10, unit: N/m}
    damping: {value: 55, percent: 30, unit: N s/m}
  inputs: [{name: setpoint, held: true}]
  states: {x: 0, v: 0}
  rates: {x: v, v: (stiffness*(setpoint - x) - damping*v)/mass}
  readings: {motor: x, carriage: x}
  places: [{name: belt, position: x, velocity: v, inertia: mass}]
"""
SETPOINTS = {
    "slow": lambda t: 0.05 * np.sin(2.0 * t),
    "fast": lambda t: 0.03 * np.sin(7.0 * t),
    "mixed": lambda t: 0.03 * np.sin(1.5 * t) + 0.015 * np.sin(6.0 * t),
    "chirp": lambda t: 0.02 * np.sin(2.0 * np.pi * (0.3 + 0.2 * t) * t),
    "steps": lambda t: np.take([0.0, 0.02, -0.01, 0.03, 0.0], (t / 0.8).astype(int) % 5),
}
STEP, PER_SAMPLE = 5e-4, 20


def record(folder: Path, play: float, late: float) -> None:
    """What a real gantry would have given: CSV files in seconds and millimeters.

    Args:
        folder: Where they are written.
        play: Half of the play [m].
        late: Age of what the camera shows [s].
    """
    rng = np.random.default_rng(77)
    time = STEP * np.arange(8000)
    for name in ("slow_a", "slow_b", "fast", "mixed", "chirp", "steps"):
        setpoint = SETPOINTS[name.split("_")[0]](time[::PER_SAMPLE])
        x = v = 0.0
        carriage = play * rng.uniform(-1.0, 1.0)
        motor, seen = [], []
        for k in range(len(time)):
            motor.append(x)
            carriage = min(max(carriage, x - play), x + play)
            seen.append(carriage)
            v += STEP * (900.0 * (setpoint[k // PER_SAMPLE] - x) - 54.0 * v) / 2.1
            x += STEP * v
        samples = np.arange(0, len(time), PER_SAMPLE)
        before = np.maximum(samples - round(late / STEP), 0)
        shown = 1e3 * np.column_stack([np.array(motor)[samples], np.array(seen)[before]])
        shown += rng.normal(size=shown.shape) * [0.01, 0.05]
        table = np.column_stack([time[samples], shown, 1e3 * setpoint])
        header = "t,motor,carriage,setpoint"
        path = folder / f"{name}.csv"
        np.savetxt(path, table, fmt="%.5f", delimiter=",", header=header, comments="")


def main(folder: Path, play: float = 9e-4, late: float = 0.045) -> Report:
    """Write the folder, read it back, take a quick look."""
    folder.mkdir(parents=True, exist_ok=True)
    record(folder, play, late)
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    study = load_study(folder)
    setup = setup_of(study)
    search = replace(setup.settings.search, max_effects=2, num_refits=2, max_rounds=4)
    settings = replace(setup.settings, search=search, noise_rounds=1)
    return diagnose(
        study, setup.model, setup.effects, unknowns=setup.unknowns, settings=settings, seed=0
    )


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
        parser.add_argument("folder", nargs="?", type=Path, default=Path(tempfile.mkdtemp()))
        report = main(parser.parse_args().folder)
        print(report.headline, report.verdict, *report.sentences, sep="\n")
