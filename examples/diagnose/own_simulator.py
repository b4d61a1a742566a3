"""What does a simulator of my own, twenty lines of Python, get wrong about a recorded cart?

The script writes a folder as a user would have it: recordings in CSV files, the simulator as
``my_cart.py``, and ``study.yaml``, which says how they belong together. The recorded cart rubs on
its rail; the simulator knows nothing of friction, but asks for forces at each of its steps.

Expected: "dry_friction_at_rail", 0.30 N within its interval. Running time: 10 s.

    python examples/diagnose/own_simulator.py runs/my_cart
    diffsim diagnose explain runs/my_cart --out runs/answer    # the same with a page of pictures
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data import load_study
from diffsim.diagnose import Report, diagnose
from diffsim.systems import setup_of

SIMULATOR = '''
import numpy as np

def predict(parameters, run, force):
    """Place of a cart on a spring, in 5 steps to a sample."""
    mass, spring, damping = (parameters[n] for n in ("mass", "spring", "damping"))
    x, v, places = 0.0, 0.0, [0.0]
    for k in range(len(run.time_s) - 1):
        h = (run.time_s[k + 1] - run.time_s[k]) / 5
        for s in range(5):
            share = (s + 0.5) / 5
            push = (1 - share) * run.command["push"][k] + share * run.command["push"][k + 1]
            push += force(run.time_s[k] + s * h, [x], [v])[0]   # what a cause adds at "rail"
            before, v = v, v + h * (push - damping * v - spring * x) / mass
            x += h * 0.5 * (before + v)
        places.append(x)
    return {"place": places}
'''
STUDY = """
name: my cart
time: {column: t, unit: s}
channels:
  - {name: place, unit: mm, sd: 0.5}
commands:
  - {name: push, unit: N}
runs:
  - {name: sine_a, file: sine_a.csv, group: sine}
  - {name: sine_b, file: sine_b.csv, group: sine}
  - {name: steps_a, file: steps_a.csv, group: steps}
  - {name: steps_b, file: steps_b.csv, group: steps}
  - {name: chirp, file: chirp.csv, use: test}
model:
  system: outside
  simulator: my_cart.py:predict
  parameters:
    mass: {value: 1.2, percent: 10, unit: kg}
    spring: {value: 40, percent: 20, unit: N/m}
    damping: {value: 1.0, percent: 50, unit: N s/m}
  hooks:
    force:
      rail: {unit: N, typical: 0.2, distance: 0.1, speed: 0.5}
"""
PUSHES = {
    "sine": lambda t: 3.0 * np.sin(4.2 * t),
    "steps": lambda t: np.interp(t % 2.0, [0, 0.1, 0.9, 1.0, 2.0], [0, 2.5, 2.5, -1.5, 0]),
    "chirp": lambda t: 3.0 * np.sin(2 * np.pi * (0.3 + 0.25 * t) * t),
}


def record(folder: Path, friction: float) -> None:
    """What a real cart would have given: CSV files in seconds, millimeters and newtons."""
    rng, time = np.random.default_rng(0), 0.02 * np.arange(100)
    for name in ("sine_a", "sine_b", "steps_a", "steps_b", "chirp"):
        push = PUSHES[name.split("_")[0]](time)

        def rate(t: float, s: np.ndarray, push: np.ndarray = push) -> list[float]:
            rub = friction * np.tanh(s[1] / 2e-3)
            return [s[1], (np.interp(t, time, push) - rub - 1.1 * s[1] - 38.0 * s[0]) / 1.25]

        x = solve_ivp(rate, (0, time[-1]), [0, 0], t_eval=time, rtol=1e-7, max_step=0.02).y[0]
        table = np.column_stack([time, 1e3 * x + 0.5 * rng.standard_normal(len(x)), push])
        np.savetxt(
            folder / f"{name}.csv",
            table,
            fmt="%.6f",
            delimiter=",",
            header="t,place,push",
            comments="",
        )


def main(folder: Path, friction: float = 0.3) -> Report:
    """Write the folder, read it back, diagnose."""
    folder.mkdir(parents=True, exist_ok=True)
    record(folder, friction)
    (folder / "my_cart.py").write_text(SIMULATOR, encoding="utf-8")
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
