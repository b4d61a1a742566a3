"""The published figures of the positioning system, by the published rules, for saved models.

``python -m studies.servo_metrics --model runs/diagnoses/emps`` prints relative errors [%], the
norm of the difference over the norm of what was measured:

- inverse model: force of the measured motion against drive gain times recorded voltage. Position
  filtered forwards and backwards (Butterworth, 4th order, 100 Hz), central differences, decimated
  by 10.
- closed loop: position, velocity, acceleration and force, simulated from the reference alone.

Rules: Janot, Gautier, Brunot, "Data set and reference models of EMPS", nonlinearbenchmark.org.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.cli.diagnose_inputs import read_study
from diffsim.core import interruptible
from diffsim.data.study import Run, Study
from diffsim.identify.extended import extended_at
from diffsim.identify.model import SimModel
from diffsim.systems import load_extended, setup_of
from diffsim.systems.ode.scene import OdeScene

Array = NDArray[np.float64]
RATE, CUT = 1000.0, 100.0  # of the recorder and of the filter [Hz]
DECIMATION, EDGE = 10, 50  # samples; ends of the filter are left out
GAIN = 35.150652  # of the drive [N/V]
PUBLISHED = {"mass": 95.109, "viscous": 203.50, "dry": 20.394, "offset": 3.165}
RUNS = {"steps": "first", "second": "second"}


def whole_study(study: Study, runs: Mapping[str, Run]) -> Study:
    """The study with its records in one piece each."""
    return replace(study, runs=tuple(runs.values()))


def joined(study: Study) -> dict[str, Run]:
    """The blocks of each record put together again, by the record's name."""
    out = {}
    for name in RUNS:
        parts = [r for r in study.runs if r.setup["block_of"] == name]
        first = parts[0]
        out[name] = replace(
            first,
            name=name,
            use="test",
            time_s=np.concatenate([r.time_s for r in parts]),
            measured=np.concatenate([r.measured for r in parts]),
            command={k: np.concatenate([r.command[k] for r in parts]) for k in first.command},
            columns={k: np.concatenate([r.columns[k] for r in parts]) for k in first.columns},
        )
    return out


def motion(position: Array) -> tuple[Array, Array, Array]:
    """Filtered position, velocity and acceleration, (num_samples,) each."""
    from scipy import signal

    b, a = signal.butter(4, CUT / (0.5 * RATE))
    q = signal.filtfilt(b, a, position)
    v = np.gradient(q) * RATE
    return q, v, np.gradient(v) * RATE


def relative(measured: Array, other: Array) -> float:
    """Norm of the difference over that of what was measured [%]."""
    inside = slice(EDGE, -EDGE)
    off = np.linalg.norm((measured - other)[inside])
    return 100.0 * float(off / np.linalg.norm(measured[inside]))


def loop_errors(run: Run, simulated: Array) -> dict[str, float]:
    """Errors of a closed-loop simulation (num_samples, 2) of position and voltage [%]."""
    seen, made = motion(run.measured[:, 0]), motion(simulated[:, 0])
    names = ("position", "velocity", "acceleration")
    out = {n: relative(a, b) for n, a, b in zip(names, seen, made, strict=True)}
    return out | {"force": relative(run.measured[:, 1], simulated[:, 1])}


def simulated(model: SimModel, run: Run) -> Array:
    """Closed-loop prediction of a run, (num_samples, 2)."""
    with torch.no_grad():
        return np.asarray(model.predict(run, model.at_prior()).numpy())


def inverse_error(model: SimModel, run: Run) -> tuple[float, float]:
    """Force error of the inverse model of a run: relative [%], and rms [N]."""
    scene = model.scene(run, model.at_prior())
    assert isinstance(scene, OdeScene)
    q, v, a = (torch.from_numpy(x.copy()) for x in motion(run.measured[:, 0]))
    voltage = torch.from_numpy(run.measured[:, 1].clip(-10.0, 10.0))
    solver = scene.network.solver(scene.changes)
    at = torch.searchsorted(scene.grid.times, torch.from_numpy(run.time_s))
    values = {"t": scene.grid.times[at], "q": q, "v": v, "v_seen": v, "driven": voltage}
    given = dict(zip(solver.ode.inputs, solver.inputs, strict=True))
    values |= {name: scene.inputs[source][at] for name, source in given.items()}
    names = dict(zip(solver.ode.parameters, solver.parameters, strict=True))
    values |= {name: scene.values[source] for name, source in names.items()}
    for state in solver.ode.rates:  # states that causes have added do not enter here
        values.setdefault(state, torch.zeros_like(q))
    off = (a - solver.ode.rates["v"](values)) * scene.values["mass"]
    return force_error(off.numpy(), GAIN * voltage.numpy())


def force_error(off: Array, force: Array) -> tuple[float, float]:
    """Error of a force (num_samples,) by the published rule: relative [%], and rms [N]."""
    from scipy import signal

    inside = slice(EDGE, -EDGE)
    left, whole = (signal.decimate(x[inside], DECIMATION, zero_phase=True) for x in (off, force))
    return 100.0 * float(np.linalg.norm(left) / np.linalg.norm(whole)), float(left.std())


def published_inverse(run: Run) -> tuple[float, float]:
    """Force error of the published inverse model, its dry friction a sign: as ``inverse_error``."""
    _, v, a = motion(run.measured[:, 0])
    force = GAIN * run.measured[:, 1].clip(-10.0, 10.0)
    p = PUBLISHED
    needed = p["mass"] * a + p["viscous"] * v + p["dry"] * np.sign(v) - p["offset"]
    return force_error(needed - force, force)


def published_model(study: Study) -> SimModel:
    """The published symmetric model in the same loop."""
    setup = setup_of(study)
    effects = {e.name: e for e in setup.effects}
    sizes = {
        "viscous_friction": PUBLISHED["viscous"],
        "dry_friction": PUBLISHED["dry"],
        "constant_force": PUBLISHED["offset"],
    }
    values = {p.name: p.value for p in setup.model.base} | {"mass": PUBLISHED["mass"]} | sizes
    chosen = [effects[name] for name in sizes]
    return extended_at(setup.model, chosen, values, dict.fromkeys(values, 1e-3), None)


def main(model: str = "runs/diagnoses/emps") -> dict[str, dict[str, float]]:
    """Print and return the errors [%] of each record and model."""
    study = read_study("emps")
    runs = joined(study)
    whole = whole_study(study, runs)
    models = {"published": published_model(whole), "ours": load_extended(Path(model), whole)}
    out: dict[str, dict[str, float]] = {}
    for record, run in runs.items():
        for name, made in models.items():
            errors = loop_errors(run, simulated(made, run))
            inverse = published_inverse(run) if name == "published" else inverse_error(made, run)
            errors["inverse"], errors["inverse_rms_N"] = inverse
            out[f"{record} {name}"] = errors
            said = ", ".join(f"{k} {v:.4g}" for k, v in errors.items())
            print(f"{record:8s}{name:10s} {said}")
    return out


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
        parser.add_argument("--model", default="runs/diagnoses/emps", help="folder of the answer")
        main(**vars(parser.parse_args()))
