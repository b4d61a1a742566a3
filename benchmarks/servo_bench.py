"""``python -m benchmarks.servo_bench ANSWER``: servos on a pendulum by the rule of their authors.

Mean of |simulated - measured position| over samples and runs, from the file of an answer of
``diffsim diagnose explain servo_sts3215`` (``servo_sts3250``, ``servo_go1``): whole runs, and the
first 3.5 s (STS3215) or 3.1 s (STS3250) that the authors' program counts. Samples that jump by more
than 0.25 rad from the last good one are left out everywhere, as the README of the data says.
``constant`` is the best constant of each run: what no model at all gives.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.cli.diagnose_inputs import read_study
from diffsim.core import interruptible
from diffsim.data.study import Run
from diffsim.identify.model import SimModel
from diffsim.identify.model_file import read_extended, rebuilt, without_effects
from diffsim.systems.registry import setup_of

Array = NDArray[np.float64]
JUMP = 0.25  # rad
COUNTED = {"servo_sts3215": 3.5, "servo_sts3250": 3.1}  # s, of the authors' program


def is_read(position: Array) -> NDArray[np.bool_]:
    """Samples (num_samples,) that are no misreadings: close to the last good one, per step."""
    good = np.isfinite(position)
    last = -1
    for k in np.flatnonzero(good):
        if last >= 0 and abs(position[k] - position[last]) > JUMP * (k - last):
            good[k] = False
        else:
            last = int(k)
    return good


def errors(model: SimModel, run: Run, until_s: float) -> tuple[float, float]:
    """Mean error of the whole run and of its beginning [rad]."""
    with torch.no_grad():
        simulated = np.asarray(model.predict(run, model.at_prior()).numpy())[:, 0]
    measured = run.measured[:, 0]
    good = is_read(measured)
    off = np.abs(simulated - measured)
    return float(off[good].mean()), float(off[good & (run.time_s < until_s)].mean())


def constant_error(run: Run) -> float:
    """Mean error of the best constant [rad]."""
    measured = run.measured[is_read(run.measured[:, 0]), 0]
    return float(np.abs(measured - np.median(measured)).mean())


def main(answer: str = "runs/diagnose/servo_sts3215") -> dict[str, dict[str, float]]:
    """Print and return mean errors [mrad] by use and trajectory, of both models."""
    saved = read_extended(answer)
    study = saved.framed(read_study(saved.study))
    setup = setup_of(study)
    models = {"plain": rebuilt(without_effects(saved), setup), "named": rebuilt(saved, setup)}
    until_s = COUNTED.get(saved.study, np.inf)
    rows: dict[str, dict[str, float]] = {}
    for run in study.runs:
        row = rows[run.name] = {"constant": constant_error(run)}
        for name, model in models.items():
            row[name], row[f"{name}, counted"] = errors(model, run, until_s)
    kind = {run.name: run.setup.get("trajectory", "") for run in study.runs}
    for use in ("fit", "select", "test"):
        there = [run.name for run in study.runs if run.use == use]
        _tell(f"{use}, {len(there)} runs", {name: rows[name] for name in there})
        for what in dict.fromkeys(kind[name] for name in there if kind[name]):
            some = {name: rows[name] for name in there if kind[name] == what}
            _tell(f"  {what}, {len(some)} runs", some)
    return rows


def _tell(what: str, rows: Mapping[str, Mapping[str, float]]) -> None:
    if rows:
        names = next(iter(rows.values()))
        means = {name: 1e3 * np.mean([row[name] for row in rows.values()]) for name in names}
        print(f"{what:28s}" + ", ".join(f"{name} {value:.1f}" for name, value in means.items()))


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
        parser.add_argument("answer", help="folder or extended_model.yaml of an answer")
        main(**vars(parser.parse_args()))
