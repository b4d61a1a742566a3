"""From CSV files to a stroke: a starfish whose servo has slack is diagnosed, and swims.

The virtual laboratory shares no code with the model. Its tendons have 7.4 mm of slack and its servo
follows at no more than 110 mm/s, as the diagnosis of the real robot has them; the model knows
neither. Three strokes are recorded and diagnosed. Body and water are identified, and a stroke is
optimized, once with the plain model and once with the causes built in; the laboratory swims both.

Expected: "6.9 mm of slack and a speed limit near 106 mm/s"; what the identified model leaves of the
markers falls from 3.1 to 1.8 mm. Nothing is gained by these short searches: the robot swims 0.51
cm/s by the diagnosed stroke, 0.78 by the plain one. ``worth`` says what mending buys.
Running time: 5 min and more.

    python examples/sim_to_real/starfish_from_csv.py runs/starfish
    diffsim diagnose worth runs/starfish --task runs/starfish/task.yaml --out runs/starfish/answer
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import tempfile
from pathlib import Path

import numpy as np

from diffsim.data import load_study
from diffsim.diagnose import diagnose
from diffsim.systems import setup_of
from labs.loop import (
    CHANNELS,
    Command,
    FitSettings,
    Limits,
    Rig,
    Starfish,
    TrajectorySettings,
    Truth,
    VirtualLaboratory,
    identify,
    open_close,
    optimize,
    speed,
    worth_of_travel,
)

STUDY = Path(__file__).with_name("learned_swimmer_study.yaml")
CONTRACTION = "tendon_contraction_m"
TASK = """
seconds: 1.2
every: 0.0166666667
knots: 24
wanted:                      # three strokes, quicker than the servo likes
  closing: {course: "0.012*(1 - cos(2*pi*t/0.4))", miss: 0.001}
"""
LIMITS = Limits(contraction_m=0.018, rate_m_s=0.3)
SLOW = open_close(period_s=1.0, low_m=0.002, high_m=0.014, closed=0.35, limits=LIMITS)
STROKES = {
    "strokes": open_close(limits=LIMITS),
    "slow_strokes": SLOW,
    "plain_0": open_close(period_s=0.8, high_m=0.016, limits=LIMITS),  # judges the answer
}
FIT = FitSettings(duration_s=1.1, max_evaluations=4, method="gauss_newton")
SEARCH = TrajectorySettings(periods=1, num_knots=20, max_evaluations=8)
SOFT = {"youngs_modulus": 5e5, "axial_stiffness": 600.0}  # data sheet of foam and tendon


def main(folder: Path) -> dict[str, float]:
    """Record, diagnose, identify, optimize, swim; speeds of the laboratory by model [cm/s]."""
    folder.mkdir(parents=True, exist_ok=True)
    lab = VirtualLaboratory(
        seed=0,
        duration_s=4.4,
        limits=LIMITS,
        truth=Truth(slack_m=0.0074),
        rig=Rig(rate_m_s=0.110),
    )
    runs = []
    for k, (name, stroke) in enumerate(STROKES.items()):
        run = lab.execute(stroke, order=k)
        runs.append(run)
        table = np.column_stack([run.time_s, run.command[CONTRACTION], run.measured])
        head = ",".join(["time_s", CONTRACTION, *CHANNELS])
        text = "\n".join([head, *(",".join(map(repr, row)) for row in table.tolist())])
        (folder / f"{name}.csv").write_text(text.replace("nan", ""), encoding="utf-8")
    (folder / "task.yaml").write_text(TASK, encoding="utf-8")
    (folder / "study.yaml").write_text(STUDY.read_text(encoding="utf-8"), encoding="utf-8")
    study = load_study(folder)
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects, unknowns=setup.unknowns, seed=0)
    report.save(folder / "answer")
    print(report.headline)

    plain = Starfish()
    models = {"plain": plain, "diagnosed": plain.extended(folder / "answer", study)}
    speeds = {}
    for k, (name, model) in enumerate(models.items()):
        start = {p.name: p.value for p in model.parameters} | SOFT
        found = identify(model, runs[:2], FIT, start=start)
        values = {p.name: found.values[p.name] for p in model.parameters}
        best = optimize(model, values, SLOW, LIMITS, SEARCH)
        seen = [swim(lab, best.command, 10 * (1 + k) + n) for n in range(3)]
        speeds[name] = 100.0 * float(np.mean(seen))
        promised = -100.0 * best.loss_after / (SEARCH.periods * best.command.period_s)
        print(
            f"{name}: misfit {1e3 * found.rms_after:.2f} mm, promises {promised:.2f} cm/s, swims "
            f"{speeds[name]:.2f} cm/s"
        )
    for row in worth_of_travel(model, values, SLOW, LIMITS, SEARCH):
        print(row.words)
    return speeds


def swim(lab: VirtualLaboratory, stroke: Command, order: int) -> float:
    """Speed of the laboratory's robot [m/s]."""
    run = lab.execute(stroke, order=order)
    return speed(run.time_s, run.measured[:, ::2], stroke.period_s)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
        parser.add_argument("folder", nargs="?", type=Path, default=Path(tempfile.mkdtemp()))
        print("speeds [cm/s]:", main(parser.parse_args().folder))
