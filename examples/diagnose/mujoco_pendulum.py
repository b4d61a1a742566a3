"""What does a MuJoCo model get wrong about a recorded pendulum? No line of Python is needed.

The script writes a folder as a user would have it: recordings in CSV files, the model as
``pendulum.xml``, and ``study.yaml``, which names bodies, joints and sensors of the model. The
recorded pendulum has a cable that pulls it back like a spring; the model has none.

Expected: "added_spring_at_hinge", 0.60 N m/rad within its interval. Running time: 20 s. Needs
``pip install mujoco``.

    python examples/diagnose/mujoco_pendulum.py runs/pendulum
    diffsim diagnose explain runs/pendulum --out runs/answer    # the same with a page of pictures
"""

from __future__ import annotations

from diffsim.core.script import ask_for, interruptible

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data import load_study
from diffsim.diagnose import Report, diagnose
from diffsim.systems import setup_of

MODEL = """
<mujoco>
  <option timestep="0.01" integrator="RK4"/>
  <worldbody>
    <body name="rod">
      <inertial mass="0.8" pos="0 0 -0.25" diaginertia="0.02 0.02 0.001"/>
      <joint name="hinge" axis="0 -1 0" damping="0.06"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><jointpos name="encoder" joint="hinge"/></sensor>
</mujoco>
"""
STUDY = """
name: pendulum
time: {column: t, unit: s}
channels:
  - {name: angle, unit: deg, sd: 0.1}
commands:
  - {name: moment, unit: N m}
runs:
  - {name: sine_a, file: sine_a.csv, group: sine}
  - {name: sine_b, file: sine_b.csv, group: sine}
  - {name: steps_a, file: steps_a.csv, group: steps}
  - {name: steps_b, file: steps_b.csv, group: steps}
  - {name: chirp, file: chirp.csv, use: test}
model:
  system: outside
  simulator: diffsim.systems.outside.mjcf:Mjcf
  options: {model: pendulum.xml, channels: {angle: encoder}, commands: {moment: motor}}
  parameters:
    body.rod.mass: {value: 0.8, percent: 5, unit: kg}
    joint.hinge.damping: {value: 0.06, percent: 50, unit: N m s/rad}
  hooks:
    force:
      hinge: {unit: N m, typical: 0.1, distance: 0.5, speed: 2}
"""
MOMENTS = {
    "sine": lambda t: 0.8 * np.sin(4.5 * t),
    "steps": lambda t: np.interp(t % 2.0, [0, 0.1, 0.9, 1.0, 2.0], [0, 0.7, 0.7, -0.5, 0]),
    "chirp": lambda t: 0.9 * np.sin(2 * np.pi * (0.3 + 0.25 * t) * t),
}


def record(folder: Path, cable: float) -> None:
    """What a real pendulum would have given: CSV files in seconds, degrees and N m."""
    rng, time = np.random.default_rng(0), 0.02 * np.arange(150)
    mass, inertia = 0.81, 0.02 + 0.81 * 0.25**2
    for name in ("sine_a", "sine_b", "steps_a", "steps_b", "chirp"):
        moment = MOMENTS[name.split("_")[0]](time)

        def rate(t: float, s: np.ndarray, moment: np.ndarray = moment) -> list[float]:
            back = mass * 9.81 * 0.25 * np.sin(s[0]) + cable * s[0] + 0.07 * s[1]
            return [s[1], (np.interp(t, time, moment) - back) / inertia]

        angle = solve_ivp(rate, (0, time[-1]), [0, 0], t_eval=time, rtol=1e-8, max_step=0.02).y[0]
        degrees = np.rad2deg(angle) + 0.1 * rng.standard_normal(len(time))
        table = np.column_stack([time, degrees, moment])
        np.savetxt(
            folder / f"{name}.csv",
            table,
            fmt="%.6f",
            delimiter=",",
            header="t,angle,moment",
            comments="",
        )


def main(folder: Path, cable: float = 0.6) -> Report:
    """Write the folder, read it back, diagnose."""
    ask_for(["mujoco"], purpose="this example")
    folder.mkdir(parents=True, exist_ok=True)
    record(folder, cable)
    (folder / "pendulum.xml").write_text(MODEL, encoding="utf-8")
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
