"""``python -m benchmarks.nanobench --model FOLDER``: the nano-drone rule on NanoBench's flights.

From every tenth sample with a mean command above 0.4 and more than 0.3 m of height throughout, 50
samples ahead under recorded commands and battery (``benchmarks.ahead``), against motion capture.
Two rows for each model. State alone: of the flight before a start only the commands that motors lag
behind count. Past known: the flight before each start tells the balance of the rotors, too
(``Balance``). Controls: hold everything, and hold velocity and rates. ``--refit OUT`` first fits
the sizes of the model by the same rule on whole flights of use fit (``benchmarks.ahead_fit``).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from benchmarks.ahead import AHEAD, Balance, Predict, Record, coasting, compared, flown, naive
from benchmarks.ahead_fit import Flights, fitted, free_names, save
from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.multicopter.cutting import evenly_sampled
from diffsim.systems.registry import load_extended, setup_of

STUDY = Path(__file__).parents[1] / "diffsim/systems/published/nanobench.yaml"
FLIGHTS = ("B7_oval_medium_rep1", "B9_trefoil_slow_rep1")  # its test flights
FIT = (
    "B2_circle_slow_rep1",
    "B2_circle_fast_rep1",
    "B3_figure8_fast_rep1",
    "B5_helix_fast_rep1",
)
RATE_HZ = 100.0
EVERY, LEAST_COMMAND, LEAST_HEIGHT = 10, 0.4, 0.3  # samples, share of full, m
EVERY_IN_FIT = 30  # samples from start to start
HELD = ("inertia_zz", "attitude_offset_z")  # yaw shows the ratio of torque to inertia only


def whole_flights(names: Sequence[str]) -> Study:
    """The study of the published YAML with whole flights in place of its runs."""
    stated = yaml.safe_load(STUDY.read_text())
    stated["runs"] = [{"name": name, "file": f"{name}.csv"} for name in names]
    stated["commands"].append({"name": "mean_command", "formula": "+".join(_MOTORS), "scale": 0.25})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(yaml.safe_dump(stated, sort_keys=False))
        study = load_study(path)
    # steps of 20 and 30 ms are gaps, in which nothing was recorded
    return evenly_sampled(study, RATE_HZ, [False] * len(study.channels))


_MOTORS = [f"motor{i}_command" for i in (1, 2, 3, 4)]


def starts_of(run: Run) -> Tensor:
    """Samples that the rule starts from: in flight until the last sample compared."""
    flies = flying(run)
    starts = np.arange(0, len(flies) - AHEAD, EVERY)
    return torch.tensor([s for s in starts if flies[s : s + AHEAD + 1].all()], dtype=torch.long)


def flying(run: Run) -> Tensor:
    """Samples in flight, (num_samples,) bool."""
    flies = run.command["mean_command"] > LEAST_COMMAND
    return torch.as_tensor(flies & (np.asarray(run.measured)[:, 2] > LEAST_HEIGHT))


def refit(path: Path | None, out: Path, runs: Sequence[str]) -> None:
    """Fit a model's sizes by the rule, on whole flights of use fit."""
    study = whole_flights(runs)
    model = _model(path, study)
    flights = Flights(study.runs, EVERY_IN_FIT, starts_of)
    save(model, fitted(model, free_names(model, HELD), flights), study.name, out)


def _model(path: Path | None, study: Study) -> ExtendedModel:
    if path is not None:
        return load_extended(path, study)
    setup = setup_of(study)
    return ExtendedModel(setup.model, (), setup.model.base)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--runs", default=",".join(FLIGHTS), help="flights, comma between them")
    parser.add_argument("--plain", action="store_true", help="the YAML's own numbers, too")
    parser.add_argument(
        "--refit", type=Path, help="file of the first model after a fit by the rule"
    )
    args = parser.parse_args(argv)
    if args.refit is not None:
        refit(args.model[0] if args.model else None, args.refit, FIT)
        args.model.append(args.refit)
    print("| model | run | p, m | v, m/s | R, rad | rates, rad/s |\n|---|---|---|---|---|---|")
    for name in args.runs.split(","):
        study = whole_flights((name,))
        run = study.runs[0]
        truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
        models: dict[str, Predict] = {"hold": naive(truth), "rates held": coasting(truth)}
        paths: list[Path | None] = [*([None] if args.plain else []), *args.model]
        for path in paths:
            model, shown = _model(path, study), "plain" if path is None else str(path)
            balance = Balance(flying(run))
            models[f"{shown}, state alone"] = flown(model, run)
            models[f"{shown}, past known"] = flown(model, run, balance=balance)
        found = compared(models, truth, starts=starts_of(run))
        for shown, count in found.failed.items():
            print(f"{shown} cannot fly {count} of {found.num_starts} starts: left out of all")
        for shown, errors in found.errors.items():
            row = " | ".join(f"{x:.3f}" for x in errors.sum(0).tolist())
            print(f"| {shown} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
