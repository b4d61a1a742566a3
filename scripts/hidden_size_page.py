"""Write docs/site/hidden_size.html: one diagnosis, whose hidden size a visitor moves.

    python scripts/hidden_size_page.py          # about two CPU minutes

A pendulum rubs at its hinge by a size that the model does not know. Each size is simulated,
diagnosed (first answers) and judged on an unseen run; the page shows these stored answers and
computes nothing itself.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.cli import main as diffsim
from diffsim.core.files import write_text_atomic

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "site" / "hidden_size.html"
TEMPLATE = Path(__file__).with_name("hidden_size.html")
SIZES = (0.0, 0.0005, 0.001, 0.002, 0.003, 0.006, 0.012)  # hidden friction [N m]
STEP = 0.02  # of the record [s]
STUDY = """
name: pendulum
channels: [{name: angle, unit: rad, sd: 0.005}]
commands: [{name: torque, unit: N m}]
model:
  system: ode
  states: {q: 0, w: 0}
  inputs: [{name: torque, held: true}]
  parameters:
    inertia: {value: 0.04, percent: 10, unit: kg m^2}
    weight: {value: 1.3, percent: 5, unit: N m}
    damping: {value: 0.02, percent: 50, unit: N m s/rad}
  rates: {q: w, w: (torque - weight*sin(q) - damping*w)/inertia}
  readings: {angle: q}
  places: [{name: hinge, position: q, velocity: w, inertia: inertia, unit: N m, position_unit: rad}]
runs: [{name: slow}, {name: fast}, {name: steps}, {name: unseen, use: test}]
"""


def record(folder: Path, size: float) -> None:
    """Four runs of the pendulum with a friction that nobody states."""
    rng = np.random.default_rng(5)
    time = np.arange(0.0, 5.0, STEP)
    drives = {
        "slow": 0.25 * np.sin(2.0 * time),
        "fast": 0.25 * np.sin(5.5 * time),
        "steps": 0.2 * np.sign(np.sin(1.7 * time)),
        "unseen": 0.2 * np.sin(3.1 * time) + 0.1 * np.sin(7.3 * time),
    }
    for name, torque in drives.items():

        def rates(t, y, torque=torque):
            drive = torque[min(int(t / STEP + 1e-9), len(time) - 1)]
            rubbing = size * np.tanh(y[1] / 0.01)
            return y[1], (drive - 1.3 * np.sin(y[0]) - 0.02 * y[1] - rubbing) / 0.04

        motion = solve_ivp(rates, (0.0, 5.0), (0.0, 0.0), t_eval=time, max_step=0.004, rtol=1e-8)
        rows = np.c_[time, torque, motion.y[0] + rng.normal(0.0, 0.005, len(time))]
        head = "time_s,torque_N_m,angle_rad"
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header=head, comments="")


def answer(size: float) -> dict[str, object]:
    """The stored answer for one hidden size."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = STUDY.replace("name: angle,", "name: angle, column: angle_rad,")
        study = study.replace("name: torque, unit", "name: torque, column: torque_N_m, unit")
        (folder / "study.yaml").write_text(study)
        record(folder, size)
        out = folder / "out"
        for step in (["explain", "--quick"], ["judge"]):
            if diffsim(["diagnose", step[0], name, "--out", str(out), "--quiet", *step[1:]]):
                raise RuntimeError(f"diagnose {step[0]} failed for {size}")
        report = json.loads((out / "report.json").read_text())
        with (out / "judged" / "unseen.csv").open() as file:
            rows = list(csv.DictReader(file))
    curves = {key: [round(float(row[key]), 4) for row in rows] for key in rows[0] if key != "use"}
    kept = [c for c in report["causes"] if c["status"] in ("certain", "likely")]
    return {
        "size": size,
        "headline": report["headline"],
        "verdict": report.get("verdict", ""),
        "causes": [{k: c[k] for k in ("name", "words", "status", "size", "unit")} for c in kept],
        "refuted": sum(c["status"] == "refuted" for c in report["causes"]),
        "curves": curves,
    }


def main() -> None:
    answers = []
    for size in SIZES:
        answers.append(answer(size))
        print(size, answers[-1]["headline"], flush=True)
    page = TEMPLATE.read_text(encoding="utf-8")
    write_text_atomic(PAGE, page.replace("ANSWERS", json.dumps(answers)))
    print(f"wrote {PAGE}, {PAGE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
