"""What is a diagnosis worth to a robot that learns in simulation?

A network steers the starfish in closed loop: markers' velocities and a clock in, contraction of
the tendons out. The virtual laboratory's servo has what nobody told the simulation: a speed limit
and slack, as large as the diagnosis of the real starfish names them. The real robot's strokes are
recorded there, body and water identified from them, a network trained in that model, and it swims.
``diffsim diagnose explain`` gets the recordings; body and water are identified again behind the
servo that it names, the same network is trained anew and swims again. Every seed is such a chain of
its own: first weights, scatter and noise of the laboratory.

Expected: the diagnosis finds slack and speed limit to 3 %, and the model's misfit falls to a third,
but the robot gains nothing that is sure: 0.12 cm/s, 95 % interval -0.33 to 0.57 over five
seeds (why: docs/measured/sim_to_real.md). About three minutes of processor time per seed. Every
step is kept: started again, it goes on where it was interrupted.

    python examples/sim_to_real/learned_swimmer.py --out runs/learned_swimmer
    python examples/sim_to_real/learned_swimmer.py --quick  # one seed, hardly trained
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from diffsim.cli import main as diffsim_cli
from diffsim.core import DiffsimError
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.data import Run
from diffsim.learn import GradientLearner, read_rows, recipe, train
from labs.loop import (
    CHANNELS,
    FitSettings,
    Limits,
    Rig,
    Starfish,
    Truth,
    VirtualLaboratory,
    identify,
    open_close,
    speed,
)
from labs.loop.tendon_swim import (
    CONTROL_S,
    DATA_SHEET,
    SETTLE_S,
    STROKE_S,
    UNIT_M_S,
    Servo,
    Steering,
    SwimSetup,
    swim_options,
)

Array = NDArray[np.float64]
COMMAND = "tendon_contraction_m"  # the column of the laboratory's command
STUDY = Path(__file__).with_name("learned_swimmer_study.yaml")
HIDDEN = Servo(lag_s=Rig().lag_s, rate_m_s=0.110, slack_m=0.0074)  # docs/measured/starfish.md
LIMITS = Limits(
    contraction_m=0.018, rate_m_s=0.3
)  # what may be commanded, as in the real recordings
STROKES = {  # recorded before anything is trained: as on the real robot, and slower
    "strokes": open_close(limits=LIMITS),
    "slow_strokes": open_close(period_s=1.0, low_m=0.002, high_m=0.014, closed=0.35, limits=LIMITS),
}
FIT = FitSettings(duration_s=2.2, max_evaluations=6, method="gauss_newton")
LEARNING_RATE = 0.01  # the swimmers' recipe has 0.003, for bodies of thousands of unknowns
SPEED_S = 2.0 * STROKE_S  # speeds are counted over whole periods of the clock


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is trained and recorded."""

    updates: int = 16  # updates of the network
    episode_s: float = 3.3  # length of an episode [s]
    record_s: float = 4.4  # length of a recording [s]
    repeats: int = 2  # recordings of each controller whose mean speed counts
    fit: FitSettings = FIT  # how body and water are identified


QUICK = Effort(updates=2, episode_s=1.2, fit=replace(FIT, duration_s=0.6, max_evaluations=2))


def laboratory(seed: int, record_s: float) -> VirtualLaboratory:
    """The robot: what the simulation does not know, and ``HIDDEN``."""
    return VirtualLaboratory(
        seed=seed,
        duration_s=record_s,
        limits=LIMITS,
        truth=Truth(slack_m=HIDDEN.slack_m),
        rig=Rig(lag_s=HIDDEN.lag_s, rate_m_s=HIDDEN.rate_m_s or np.inf),
    )


def identified(runs: Sequence[Run], servo: Servo, effort: Effort, kept: Path) -> dict[str, float]:
    """Body and water that fit recordings best behind a servo; fitted once, then read."""
    if not kept.is_file():
        pulled = [replace(r, command={COMMAND: servo.pulls(r.command[COMMAND])}) for r in runs]
        start = {name: DATA_SHEET[name] for name in ("youngs_modulus", "axial_stiffness")}
        found = identify(Starfish(), pulled, effort.fit, start=start)
        write_json_atomic(kept, found.plain())
    values = json.loads(kept.read_text(encoding="utf-8"))["values"]
    return {name: float(values[name]) for name in DATA_SHEET}


def trained(
    seed: int, servo: Servo, body: Mapping[str, float], effort: Effort, folder: Path
) -> Steering:
    """A controller of the recipe of ``rl/train_gradient.py`` for swimmers, trained in a model."""
    swim = recipe("StarfishSwim")
    episode = round(effort.episode_s / CONTROL_S)
    setup = SwimSetup(
        "TendonSwim",
        swim_options(servo, effort.episode_s, LIMITS, body),
        seed=seed,
        steps=effort.updates * episode,
        evaluate_every=effort.updates * episode,
        evaluation_episodes=1,
        warm_up=10,
        output_gain=swim.setup["output_gain"],
        balance_clock=swim.setup["balance_clock"],
    )
    learner = GradientLearner(setup, swim.gradient_options(learning_rate=LEARNING_RATE))
    train(setup, learner, folder, resume=True)
    return Steering(learner.net, setup.make_task())


def recorded(folder: Path, name: str, make: Any) -> Run:
    """The recording of this name; executed once, then read."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        run = make()
        table = np.column_stack([run.time_s, run.command[COMMAND], run.measured])
        head = ",".join(["time_s", COMMAND, *CHANNELS])
        rows = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in table]
        write_text_atomic(path, "\n".join([head, *rows]) + "\n")
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    return Run(
        name=name,
        group=name,
        time_s=table[:, 0],
        measured=table[:, 2:],
        command={COMMAND: table[:, 1]},
    )


def speed_of(run: Run) -> float:
    """Forward speed of a recording from its second period to its last [m/s]."""
    return speed(run.time_s, run.measured[:, ::2], SPEED_S)


def swims(
    lab: VirtualLaboratory, steering: Steering, folder: Path, name: str, first: int, count: int
) -> list[Run]:
    """Recordings of a controller; every repeat has an order of its own."""
    return [
        recorded(
            folder,
            f"{name}_{k}",
            lambda k=k: lab.steer(Steering(steering.net, steering.task), order=first + k),
        )
        for k in range(count)
    ]


def diagnosed(folder: Path, out: Path) -> dict[str, Any]:
    """What ``diffsim diagnose explain`` says of the recordings in a folder; its report."""
    write_text_atomic(folder / "study.yaml", STUDY.read_text(encoding="utf-8"))
    report = out / "report.json"
    if not report.is_file():
        code = diffsim_cli(["diagnose", "explain", str(folder), "--quick", "--out", str(out)])
        if code:
            raise DiffsimError(f"diagnose explain {folder} ended with {code}; see its output")
    return dict(json.loads(report.read_text(encoding="utf-8")))


def extended(out: Path) -> Servo:
    """The servo as the diagnosis has it; what it does not name stays as it was.

    Raises:
        DiffsimError: it names a cause that the training has no form for.
    """
    model = yaml.safe_load((out / "extended_model.yaml").read_text(encoding="utf-8"))
    found = {name: float(e["value"]) for name, e in (model["effects"] or {}).items()}
    others = set(found) - {"lag", "rate_limit", "slack"}
    if others:
        raise DiffsimError(
            f"the diagnosis names {', '.join(sorted(others))}, of which TendonSwim has no form; "
            "write it into advance()"
        )
    rate = 1.0 / found["rate_limit"] if "rate_limit" in found else None
    return Servo(lag_s=found.get("lag", 0.0), rate_m_s=rate, slack_m=found.get("slack", 0.0))


def promised_m_s(folder: Path, effort: Effort) -> float:
    """Speed that the trained controller has in the model it was trained in [m/s].

    Rewards count from ``SETTLE_S`` on, and are means over the whole episode.
    """
    reward = float(read_rows(folder)[-1]["reward"])
    return UNIT_M_S * reward / (1.0 - SETTLE_S / effort.episode_s)


def misfit_mm(kept: Path) -> float:
    """Root mean square of what an identification leaves of a marker's coordinate [mm]."""
    return 1e3 * float(json.loads(kept.read_text(encoding="utf-8"))["rms_after"])


def chain(seed: int, effort: Effort, out: Path) -> dict[str, Any]:
    """Train, swim, diagnose, train, swim; the numbers of one seed. What is done is kept."""
    kept = out / "numbers.json"
    if kept.is_file():
        return dict(json.loads(kept.read_text(encoding="utf-8")))
    lab, data = laboratory(seed, effort.record_s), out / "recordings"
    data.mkdir(parents=True, exist_ok=True)
    runs = [
        recorded(data, name, lambda c=command, k=k: lab.execute(c, order=10 + k))
        for k, (name, command) in enumerate(STROKES.items())
    ]

    def learned(name: str, servo: Servo, first: int) -> list[Run]:
        body = identified(runs, servo, effort, out / f"{name}_identified.json")
        steering = trained(seed, servo, body, effort, out / name)
        return swims(lab, steering, data, name, first, effort.repeats)

    before = learned("plain", Servo(), 0)
    report = diagnosed(data, out / "diagnosis")
    servo = extended(out / "diagnosis")
    after = learned("extended", servo, 20)
    numbers = {
        "seed": seed,
        "verdict": report["verdict"],
        "named": report["named"],
        "servo": asdict(servo),
        "before_m_s": [speed_of(run) for run in before],
        "after_m_s": [speed_of(run) for run in after],
        "misfit_mm": [misfit_mm(out / f"{name}_identified.json") for name in ("plain", "extended")],
    }
    write_json_atomic(kept, numbers)
    return numbers


def interval(gains: Array) -> tuple[float, float, float]:
    """Mean of gains (num_seeds,) and its 95 % interval of Student's t over seeds."""
    from scipy.stats import t

    half = t.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / np.sqrt(len(gains))
    return float(gains.mean()), float(gains.mean() - half), float(gains.mean() + half)


def main(
    out: str = "runs/learned_swimmer",
    *,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    effort: Effort | None = None,
    plot: bool = True,
) -> dict[str, float]:
    """All chains, their gain, and a picture; returns the numbers that the story ends with."""
    effort = effort or Effort()
    rows = []
    for seed in seeds:
        folder = Path(out) / f"seed_{seed}"
        row = chain(seed, effort, folder)
        said = {name: promised_m_s(folder / name, effort) for name in ("plain", "extended")}
        rows.append(row | {"promised_m_s": said})
        print(_line(rows[-1]), flush=True)
    before, after = (
        np.array([np.mean(r[f"{when}_m_s"]) for r in rows]) for when in ("before", "after")
    )
    numbers = {"before_cm_s": 1e2 * before.mean(), "after_cm_s": 1e2 * after.mean()}
    for when, name, real in (("before", "plain", before), ("after", "extended", after)):
        promised = np.array([r["promised_m_s"][name] for r in rows])
        numbers[f"promised_{when}_cm_s"] = 1e2 * promised.mean()
        numbers[f"off_{when}_cm_s"] = 1e2 * np.abs(promised - real).mean()
    if len(rows) > 1:
        mean, low, high = interval(1e2 * (after - before))
        numbers |= {"gain_cm_s": mean, "gain_low_cm_s": low, "gain_high_cm_s": high}
    write_json_atomic(Path(out) / "gain.json", {"numbers": numbers, "rows": rows})
    if plot:
        draw(rows, Path(out))
    return {name: float(value) for name, value in numbers.items()}


def _line(row: dict[str, Any]) -> str:
    before, after = (
        " ".join(f"{1e2 * v:.2f}" for v in row[f"{when}_m_s"]) for when in ("before", "after")
    )
    known = {name: value for name, value in row["servo"].items() if value}
    named = ", ".join(f"{name} {value:.3g}" for name, value in known.items())
    plain, extended = (1e2 * row["promised_m_s"][name] for name in ("plain", "extended"))
    return (
        f"seed {row['seed']}: {row['verdict']}: {named}; {before} -> {after} cm/s, "
        f"promised {plain:.2f} -> {extended:.2f}; misfit "
        + " -> ".join(f"{value:.2f} mm" for value in row["misfit_mm"])
    )


def draw(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """Speeds of every seed before and after, and what the first seed's controllers do."""
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    colors = {"plain": "#9aa5a5", "extended": "#c0392b"}
    for row in rows:
        pair = [1e2 * np.mean(row[f"{when}_m_s"]) for when in ("before", "after")]
        said = [1e2 * row["promised_m_s"][name] for name in colors]
        first = row is rows[0]
        left.plot(
            [0, 1], pair, color="#5b7480", marker="o", lw=1.2, label="swum" if first else None
        )
        left.plot([0, 1], said, "x", color="#c0392b", label="promised" if first else None)
    left.set_xticks([0, 1], ["plain\nmodel", "extended by\nthe diagnosis"])
    left.set(xlim=(-0.3, 1.3), ylabel="speed [cm/s]", ylim=(0, None))
    left.legend(frameon=False)
    data = out / f"seed_{rows[0]['seed']}" / "recordings"
    for name, color in colors.items():
        table = np.genfromtxt(data / f"{name}_0.csv", delimiter=",", skip_header=1)
        middle.plot(table[:, 0], 1e3 * table[:, 1], color=color, lw=1.2, label=name)
        way = -np.nanmean(table[:, 2::2] - table[0, 2::2], axis=1)
        right.plot(table[:, 0], 1e2 * way, color=color, lw=1.6, label=name)
    middle.axhspan(0.0, 1e3 * HIDDEN.slack_m, color="#dfe6e9", zorder=0)
    middle.set(xlabel="time [s]", ylabel="command [mm], slack shaded", xlim=(0, 3))
    right.set(xlabel="time [s]", ylabel="way [cm]")
    right.legend(frameon=False)
    figure.savefig(out / "learned_swimmer.png", dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--out", default="runs/learned_swimmer", help="folder of the chains")
        parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
        parser.add_argument("--quick", action="store_true", help="one seed, hardly trained")
        parser.add_argument("--updates", type=int, help="of either network; 16 by default")
        parser.add_argument("--no-pictures", action="store_true")
        args = parser.parse_args()
        torch.set_num_threads(1)
        effort = QUICK if args.quick else Effort()
        found = main(
            args.out,
            seeds=args.seeds[:1] if args.quick else args.seeds,
            effort=replace(effort, updates=args.updates) if args.updates else effort,
            plot=not args.no_pictures,
        )
        for name, value in found.items():
            print(f"{name:16s} {value:.4g}")
