"""What holds a recorded motor back that no library of causes lists?

The script writes a folder as a user would have it: recordings in CSV files, and ``study.yaml``. The
recorded motor cogs: magnets pull its rotor into 14 places of a turn, with 2.2 mN m. The model knows
nothing of it, and neither does the library: the law itself is found.

Expected: a torque at the shaft that repeats 14 times a turn of the angle, 2.13 to 2.27 mN m.
Running time: a minute and a half.

    python examples/diagnose/cogging_motor.py runs/motor
    diffsim diagnose explain runs/motor --out runs/answer --budget quick    # with pictures
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

STUDY = """
name: motor
time: {column: t, unit: s}
channels:
  - {name: angle, unit: deg, sd: 0.5}
commands:
  - {name: current, unit: A}
runs:
  - {name: drive_1, file: drive_1.csv}
  - {name: drive_2, file: drive_2.csv}
  - {name: drive_3, file: drive_3.csv}
  - {name: drive_4, file: drive_4.csv}
  - {name: drive_5, file: drive_5.csv, use: select}
  - {name: drive_6, file: drive_6.csv, use: select}
  - {name: drive_7, file: drive_7.csv, use: test}
model:
  system: ode
  states: {angle: 0 rad, speed: 0 rad/s}
  inputs: [current]
  parameters:
    torque_per_ampere: {value: 0.05, percent: 5, unit: N m/A}
    drag: {value: 5e-3, percent: 20, unit: N m s/rad}
    inertia: {value: 2e-4, percent: 5, unit: kg m^2}
  rates:
    angle: speed
    speed: (torque_per_ampere * current - drag * speed) / inertia
  readings: {angle: angle}
  places:
    - name: shaft
      position: angle
      velocity: speed
      inertia: inertia
      unit: N m
      position_unit: rad
"""
NUM_RUNS = 7
TEETH, COGGING_NM, PHASE = 14, 2.2e-3, 0.4  # what nobody tells the diagnosis
DRAG, INERTIA, TORQUE_PER_AMPERE = 5.5e-3, 2e-4, 0.05


def record(folder: Path, cogging_Nm: float) -> None:
    """What a real motor would have given: CSV files in seconds, degrees and amperes."""
    rng, time = np.random.default_rng(1), 0.01 * np.arange(600)
    for k in range(NUM_RUNS):
        frequency_Hz, amplitude_A = rng.uniform(0.2, 0.8, 3), rng.uniform(0.2, 0.7, 3)
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        waves = np.sin(2.0 * np.pi * np.outer(time, frequency_Hz) + phase)
        current = waves @ amplitude_A

        def rate(t: float, s: np.ndarray, current: np.ndarray = current) -> list[float]:
            drive = TORQUE_PER_AMPERE * np.interp(t, time, current)
            cogging = cogging_Nm * np.sin(TEETH * s[0] + PHASE)
            return [s[1], (drive - DRAG * s[1] - cogging) / INERTIA]

        solved = solve_ivp(rate, (0, time[-1]), [0, 0], t_eval=time, rtol=1e-8, max_step=5e-3)
        degrees = np.rad2deg(solved.y[0]) + 0.5 * rng.standard_normal(len(time))
        np.savetxt(
            folder / f"drive_{k + 1}.csv",
            np.column_stack([time, degrees, current]),
            fmt="%.6f",
            delimiter=",",
            header="t,angle,current",
            comments="",
        )


def main(folder: Path, cogging_Nm: float = COGGING_NM) -> Report:
    """Write the folder, read it back, diagnose."""
    folder.mkdir(parents=True, exist_ok=True)
    record(folder, cogging_Nm)
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    study = load_study(folder)
    setup = setup_of(study)
    return diagnose(
        study, setup.model, setup.effects, unknowns=setup.unknowns, laws=setup.laws, seed=0
    )


def draw(report: Report, path: Path) -> None:
    """The missing torque over the angle with its 90 % band, and the torque that was hidden."""
    from diffsim.viz import figures, palette

    assert report.described is not None
    curve = next(c for c in report.described.curves if c.law)
    u, middle, sd = (np.array(values) for values in (curve.u, curve.value, curve.sd))
    figure, ax = figures.new_figure(height=3.2)
    figure.set_facecolor("white")
    band = (1e3 * (middle - 1.645 * sd), 1e3 * (middle + 1.645 * sd))
    ax.fill_between(u, *band, color=figures.LINE, label="90 % band")
    ax.plot(u, 1e3 * middle, color=figures.INK, label="as the recordings ask for it")
    hidden = -1e3 * COGGING_NM * np.sin(TEETH * u + PHASE)
    ax.plot(u, hidden, "--", color=figures.COLORS["published"], label="what was hidden")
    ax.set(xlabel="angle [rad]", ylabel="torque at the shaft [mN m]")
    ax.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    palette.save(figure, path)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
        parser.add_argument("folder", nargs="?", type=Path, default=Path(tempfile.mkdtemp()))
        parser.add_argument("--picture", type=Path, help="draw what was found there, as a PNG")
        given = parser.parse_args()
        report = main(given.folder)
        print(report.headline, report.verdict, *report.sentences[1:], sep="\n")
        if given.picture:
            draw(report, given.picture)
