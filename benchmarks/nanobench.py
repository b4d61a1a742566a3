"""``python -m benchmarks.nanobench --model FOLDER``: the nano-drone rule on NanoBench's flights.

From every tenth sample with a mean command above 0.4 and more than 0.3 m of height throughout, 50
samples ahead under recorded commands and battery (``benchmarks.ahead``), against motion capture.
Without an estimator in the description nothing of the flight before a start is used but the lag of
the motors behind their commands. Controls: hold everything, and the plain description.
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

from benchmarks.ahead import AHEAD, Predict, Record, compared, flown, naive
from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.multicopter.sampling import evenly_sampled
from diffsim.systems.registry import load_extended, setup_of

STUDY = Path(__file__).parents[1] / "diffsim/systems/published/nanobench.yaml"
FLIGHTS = ("B7_oval_medium_rep1", "B9_trefoil_slow_rep1")  # its test flights
RATE_HZ = 100.0
EVERY, LEAST_COMMAND, LEAST_HEIGHT = 10, 0.4, 0.3  # samples, share of full, m


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
    flies = run.command["mean_command"] > LEAST_COMMAND
    flies &= np.asarray(run.measured)[:, 2] > LEAST_HEIGHT
    starts = np.arange(0, len(flies) - AHEAD, EVERY)
    return torch.tensor([s for s in starts if flies[s : s + AHEAD + 1].all()], dtype=torch.long)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--runs", default=",".join(FLIGHTS), help="flights, comma between them")
    args = parser.parse_args(argv)
    print("| model | run | p, m | v, m/s | R, rad | rates, rad/s |\n|---|---|---|---|---|---|")
    for name in args.runs.split(","):
        study = whole_flights((name,))
        run, setup = study.runs[0], setup_of(study)
        truth = Record.of(torch.as_tensor(run.measured, dtype=torch.float64))
        plain = ExtendedModel(setup.model, (), setup.model.base)
        models: dict[str, Predict] = {"hold": naive(truth), "plain": flown(plain, run)}
        models |= {str(path): flown(load_extended(path, study), run) for path in args.model}
        found = compared(models, truth, starts=starts_of(run))
        for shown, errors in found.errors.items():
            row = " | ".join(f"{x:.3f}" for x in errors.sum(0).tolist())
            print(f"| {shown} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
