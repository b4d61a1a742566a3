"""What does RotorPy get wrong about recorded climbs of a quadrotor?

The script writes a folder as a user would have it: recordings in CSV files, a few lines that call
RotorPy as ``climb.py``, and ``study.yaml``. The recorded vehicle hears its commands 40 ms late;
the simulation hears them at once.

Expected: "delay", 0.040 s within its interval. Running time: 30 s. Needs ``pip install rotorpy``.

    python examples/diagnose/rotorpy_climb.py runs/climb
    diffsim diagnose explain runs/climb --out runs/answer    # the same with a page of pictures
"""

from __future__ import annotations

from diffsim.core.script import ask_for, interruptible

import argparse
import tempfile
from pathlib import Path

import numpy as np

from diffsim.data import load_study
from diffsim.diagnose import Report, diagnose
from diffsim.systems import setup_of

SIMULATOR = '''
import numpy as np
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

def predict(parameters, run):
    """Height and climb speed under one speed of all four rotors, held from sample to sample."""
    vehicle = Multirotor({**quad_params, **parameters}, aero=True)
    zero, speeds = np.zeros(3), run.command["rotor_speed"]
    state = {"x": zero, "v": zero, "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": zero, "wind": zero,
             "rotor_speeds": np.full(4, speeds[0])}
    rows = [(0.0, 0.0)]
    for k in range(len(run.time_s) - 1):
        asked = {"cmd_motor_speeds": np.full(4, speeds[k])}
        state = vehicle.step(state, asked, run.time_s[k + 1] - run.time_s[k])
        rows.append((state["x"][2], state["v"][2]))
    return np.array(rows)
'''
STUDY = """
name: climbs
time: {column: t, unit: s}
channels:
  - {name: height, unit: m, sd: 0.002}
  - {name: climb, unit: m/s, sd: 0.02}
commands:
  - {name: rotor_speed, unit: rad/s}
runs:
  - {name: hop_a, file: hop_a.csv, group: hop}
  - {name: hop_b, file: hop_b.csv, group: hop}
  - {name: wave_a, file: wave_a.csv, group: wave}
  - {name: wave_b, file: wave_b.csv, group: wave}
  - {name: mixed, file: mixed.csv, use: test}
model:
  system: outside
  simulator: climb.py:predict
  commands_are: held
  parameters:                      # RotorPy's own names
    mass: {value: 0.5, percent: 2, unit: kg}
    k_eta: {value: 5.57e-6, percent: 3, unit: N s^2/rad^2}
    tau_m: {value: 0.02, percent: 20, unit: s}
  effects: {without: [backlash, slack, rate_limit]}
"""


def commands(name: str, time: np.ndarray) -> np.ndarray:
    """Speed of the rotors about that of hover [rad/s]."""
    hover = np.sqrt(0.5 * 9.81 / 4 / 5.57e-6)
    shape = {
        "hop": np.interp(time, [0, 0.1, 0.12, 0.5, 0.52, 0.9, 0.92, 2], [0, 0, 1, 1, -1, -1, 0, 0]),
        "wave": np.sin(9.0 * time),
        "mixed": 0.6 * np.sin(5.0 * time) + 0.4 * np.sin(14.0 * time),
    }[name.split("_")[0]]
    return hover * (1.0 + 0.1 * shape)


def record(folder: Path, late_s: float) -> None:
    """What a real vehicle would have given: RotorPy itself, whose commands come late."""
    namespace: dict = {}
    exec(SIMULATOR, namespace)
    rng, time = np.random.default_rng(0), 0.02 * np.arange(61)
    for name in ("hop_a", "hop_b", "wave_a", "wave_b", "mixed"):
        asked = commands(name, time)
        heard = asked[np.maximum(np.arange(len(time)) - round(late_s / 0.02), 0)]
        run = type("Run", (), {"time_s": time, "command": {"rotor_speed": heard}})
        truth = {"mass": 0.505, "k_eta": 5.65e-6, "tau_m": 0.022}
        seen = namespace["predict"](truth, run) + [2e-3, 2e-2] * rng.standard_normal((61, 2))
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([time, seen, asked]),
            fmt="%.6f",
            delimiter=",",
            header="t,height,climb,rotor_speed",
            comments="",
        )


def main(folder: Path, late_s: float = 0.04) -> Report:
    """Write the folder, read it back, diagnose."""
    ask_for(["rotorpy"], purpose="this example")
    folder.mkdir(parents=True, exist_ok=True)
    record(folder, late_s)
    (folder / "climb.py").write_text(SIMULATOR, encoding="utf-8")
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    study = load_study(folder)
    setup = setup_of(study)
    return diagnose(study, setup.model, setup.effects, unknowns=setup.unknowns, seed=0)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
        parser.add_argument("folder", nargs="?", type=Path, default=Path(tempfile.mkdtemp()))
        report = main(parser.parse_args().folder)
        print(report.verdict, *report.sentences, sep="\n")
