"""Reference results of recorded and virtual systems: data, models, causes, diagnoses, the demo.

Diagnoses run as ``diffsim diagnose explain`` does, in a process of their own, and are read from the
report that it writes: neither depends on where modules lie.
"""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

F64 = torch.float64
ROOT = Path(__file__).resolve().parents[1]  # whose ``diffsim`` is run


def recordings() -> Mapping[str, Any]:
    """Every published data set as it is imported, and one study of every laboratory."""
    return {
        name: study
        if isinstance(study, str)
        else {
            "channels": [channel.name for channel in study.channels],
            "uses": [f"{run.name} {run.use}" for run in study.runs],
            "times": np.concatenate([run.time_s for run in study.runs]),
            "measured": np.concatenate([run.measured.ravel() for run in study.runs]),
            "commands": np.concatenate(
                [np.zeros(0), *(c for run in study.runs for _, c in sorted(run.command.items()))]
            ),
        }
        for name, study in _studies()
    }


def predictions() -> Mapping[str, Any]:
    """What every system's model predicts at its prior, plainly and with each of its causes."""
    found: dict[str, Any] = {}
    for name, study in _studies():
        if isinstance(study, str):
            found[name] = study
            continue
        if study.model is None and not name.startswith("lab_"):
            continue  # an importer's: recordings alone
        with warnings.catch_warnings(), torch.no_grad():
            warnings.filterwarnings("ignore", message="the shape is thinner than a cell")
            setup = _setup_of(name, study)
            run = (setup.study or study).fit_runs[0]
            at = setup.model.at_prior()
            made = {"plain": setup.model.predict(run, at)}
            for effect in setup.effects:
                size = torch.full((len(effect.components),), 0.3 * effect.typical, dtype=F64)
                made[effect.name] = setup.model.predict(run, at, {effect: size})
        found[name] = {
            "parameters": [p.name for p in setup.model.base],
            "priors": [[p.value, p.sd] for p in setup.model.base],
            "units": [f"{effect.name} [{effect.unit}]" for effect in setup.effects],
            "bank": [run.name for run in setup.bank],
            "predicted": made,
        }
    return found


def _studies() -> Iterator[tuple[str, Any]]:
    """Published sets and one study of every laboratory; of a set without data, what is said."""
    from diffsim.cli.arguments import described
    from diffsim.data import load_study
    from labs.virtual import LABS

    for path in described():
        try:
            yield path.stem, load_study(path)
        except (FileNotFoundError, ValueError) as error:
            yield path.stem, f"not computed: {type(error).__name__}"
    for name, make in LABS.items():
        yield f"lab_{name}", make()(1)


def _setup_of(name: str, study: Any) -> Any:
    """The setup of one of ``_studies``: a laboratory's own, or that of its description."""
    from diffsim.systems import registry
    from labs import systems

    return (systems if name.startswith("lab_") else registry).setup_of(study)


def rotor_bench() -> Mapping[str, Any]:
    """The full diagnosis of the measured thrust stand."""
    return _explained("rotor_bench")


def silicone_beam() -> Mapping[str, Any]:
    """The quick diagnosis of the recorded silicone beam."""
    return _explained("silicone_beam", "--quick")


def lab_network() -> Mapping[str, Any]:
    """A virtual channel network with a hidden cause, diagnosed quickly among a few."""
    from labs.virtual import NetworkLab

    size = NetworkLab.effects["thinning"].typical
    study = NetworkLab().case(101, {"thinning": (size,)}).study
    few = ("thinning", "pressure_offset_2", "pump_gain_1", "blocked_branch_1", "entrance_loss")
    return _explained_study(study, "network", "--quick", "--effects", ",".join(few))


def lab_copter() -> Mapping[str, Any]:
    """Short flights of a virtual multicopter with a hidden cause, diagnosed among a few."""
    from labs.virtual import CopterLab

    study = CopterLab().case(5, {"body_drag": None}).study
    flights = ("sprint_a", "climb_a", "figure_eight")
    runs = [run.part(slice(150)) for run in study.runs if run.name in flights]
    few = ("body_drag", "lag", "wind", "inflow", "thrust_curvature")
    return _explained_study(replace(study, runs=tuple(runs)), "copter", "--effects", ",".join(few))


def _explained_study(study: Any, lab: str, *options: str) -> dict[str, Any]:
    """The diagnosis of a laboratory's study that is written to a folder first."""
    from diffsim.data import save_study
    from labs.systems import setup_file

    options = ("--setup", str(setup_file(lab)), *options)
    with TemporaryDirectory() as folder:
        save_study(study, Path(folder) / "study")
        return _explained(str(Path(folder) / "study"), *options)


def _explained(study: str, *options: str) -> dict[str, Any]:
    """What ``diffsim diagnose explain`` finds."""
    with TemporaryDirectory() as folder:
        command = ["diagnose", "explain", study, "--threads", "1", "--seed", "0", *options]
        done = subprocess.run(
            [sys.executable, "-m", "diffsim", *command, "--out", folder],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        if done.returncode != 0:
            raise RuntimeError(f"diffsim {' '.join(command)}: {done.stderr.strip()[-500:]}")
        report = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))
    return of_report(report)


def of_report(report: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict, sizes, evidence in nats, gains, fits and checks of a report."""
    keys = ("verdict", "named", "chi2_null", "chi2_best", "num_samples", "gain")
    rows = ("status", "size", "sd", "nats", "z", "smallest_visible", "gain", "share")
    hypotheses = [
        {
            "name": " + ".join([*h["effects"], *([h["unknown"]] if h["unknown"] else [])]),
            "nats": h["nats"],
            "chi2": h["chi2"],
        }
        for h in report["hypotheses"]
    ]
    return {
        **{key: report[key] for key in keys},
        "rivals": [" + ".join(rival) for rival in report["rivals"]],
        "effects": {row["effect"]: {key: row[key] for key in rows} for row in report["table"]},
        "hypotheses": [h["name"] or "none" for h in hypotheses],
        "nats": [h["nats"] for h in hypotheses],
        "chi2": [h["chi2"] for h in hypotheses],
        "confounding_names": report["confounding_names"],
        "confounding": _numbers(report["confounding"]),
        "gates": {gate["name"]: gate["value"] for gate in report["gates"]},
        "noise": report["noise"]["sd"],
        "next_run": _numbers(report["next_run"]),
        "force_map": _numbers(report["force_map"]),
        **{
            fit: {key: report[fit][key] for key in ("values", "sd", "converged")}
            | {"correlation": _numbers(report[fit]["correlation"])}
            for fit in ("null", "best")
        },
        "work": report["settings"]["work"],
    }


def demo() -> Mapping[str, Any]:
    """The demo on the recorded beam, coarse and short, without its diagnosis."""
    from examples import demo as story
    from examples.demo.plan import Plan

    plan = Plan(
        cells=(6, 2, 2),
        dt_s=5e-3,
        fit_s=0.6,
        max_evaluations=8,
        mesh_cells=((6, 2, 2), (10, 4, 4)),
        mesh_poissons_ratios=(0.499, 0.45),
        damping_dt_s=(1e-2, 5e-3),
        diagnosis_effects=(),
    )
    with TemporaryDirectory() as folder:
        results = story.run(out=folder, plan=plan, threads=1)
    shown = ("youngs_modulus", "measured", "mesh", "sag_fit", "numerics", "remaining", "simulated")
    return {
        **{name: _numbers(results[name]) for name in shown},
        **{
            fit: {
                "evaluations": results[fit]["num_evaluations"],
                "value": results[fit]["value"],
                "std": results[fit]["std"],
                "history": _numbers(results[fit]["history"]),
            }
            for fit in ("identified", "joint")
        },
    }


def _numbers(value: Any) -> Any:
    """All numbers inside a nested value, in order; None counts as not a number."""
    found: list[float] = []

    def collect(part: Any) -> None:
        if isinstance(part, Mapping):
            for inner in part.values():
                collect(inner)
        elif isinstance(part, np.ndarray | torch.Tensor):
            found.extend(float(v) for v in np.asarray(part, np.float64).ravel())
        elif isinstance(part, Sequence) and not isinstance(part, str):
            for inner in part:
                collect(inner)
        elif part is None or isinstance(part, int | float | np.number):
            found.append(np.nan if part is None else float(part))

    collect(value)
    return np.array(found)


ITEMS = {
    f.__name__: f
    for f in (recordings, predictions, rotor_bench, silicone_beam, lab_network, lab_copter, demo)
}
