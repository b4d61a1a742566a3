"""From published practice to the identified model, each rung held against all trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffsim.core.files import file_digest, write_bytes_atomic
from diffsim.mesh import surface_quads
from diffsim.viz.frames import pack
from examples.data.beam import BeamGeometry, BeamStudy, BeamTrial
from examples.data.beam_motion import COMPARE_S
from examples.demo.beam import Beam, Release, Setup
from examples.demo.numerics import motion
from examples.demo.plan import Plan
from examples.demo.tip_window import MAX_RELEASE_SHIFT_S, rms, window
from examples.demo.workers import Workers

FRAME_S = 0.01  # of the kept surface, as the camera's


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One model of the beam.

    Attributes:
        name, title: For files and for people.
        setup: Numerics and the meaning of the weight.
        parameters: Young's modulus and damping.
        cases: ``light``, ``loaded``: what it simulates; a rung without ``light`` is there the same
            as ``light_as``.
        keep_surface: Keep the moving surface for the recording.
    """

    name: str
    title: str
    setup: Setup
    parameters: Mapping[str, float]
    light_as: str | None = None
    keep_surface: bool = False


def rungs(
    bar: BeamGeometry,
    plan: Plan,
    sag_fit: Mapping[str, Any],
    single: Mapping[str, Any],
    joint: Mapping[str, Any],
) -> list[Rung]:
    """All models, in the order in which they are told."""
    published, better = plan.published(), plan.better()
    number = {"youngs_modulus": bar.youngs_modulus_published_Pa}
    sag = {"youngs_modulus": sag_fit["youngs_modulus"]}
    return [
        Rung(
            name="published_number",
            title="published E and ν",
            setup=published.changed(poissons_ratio=bar.poissons_ratio),
            parameters=number,
        ),
        Rung(
            name="published",
            title="published practice",
            setup=published,
            parameters=sag,
            keep_surface=True,
        ),
        Rung(
            name="undamped",
            title="no numerical damping",
            setup=better,
            parameters=sag,
        ),
        Rung(
            name="identified",
            title="E and damping identified",
            setup=better,
            parameters=single["value"],
            keep_surface=True,
        ),
        Rung(
            name="mass",
            title="…weight as a mass",
            setup=better.changed(weight_as="mass"),
            parameters=single["value"],
            light_as="identified",
            keep_surface=True,
        ),
        Rung(
            name="joint",
            title="…fitted on both cases",
            setup=better.changed(weight_as="mass"),
            parameters=joint["value"],
            keep_surface=True,
        ),
    ]


def num_steps(plan: Plan) -> int:
    """Time steps of ``simulate`` for all rungs and both cases."""
    until = COMPARE_S + MAX_RELEASE_SHIFT_S
    return round(4 * until / plan.published_dt_s) + round(7 * until / plan.dt_s)


def simulate(
    study: BeamStudy, ladder: Sequence[Rung], workers: Workers, folder: Path
) -> dict[str, Any]:
    """Both cases on every rung.

    Returns:
        ``runs``: by rung and case, tip motion, frequency, damping, sag, and the file of the moving
        surface where it was kept.
    """
    cases = {case: trials[0] for case, trials in study.repeats().items()}

    def job(rung: Rung, case: str, trial: BeamTrial) -> Callable[[], dict[str, Any]]:
        def compute() -> dict[str, Any]:
            beam = Beam(study.geometry, rung.setup, trial.tip_load_mass_kg)
            nodes, quads = torch.unique(surface_quads(beam.mesh).faces, return_inverse=True)
            with torch.no_grad():
                run = beam.release(
                    rung.parameters,
                    COMPARE_S + MAX_RELEASE_SHIFT_S,
                    tick=workers.tick,
                    keep_nodes=nodes if rung.keep_surface else None,
                )
                elastic = {"youngs_modulus": rung.parameters["youngs_modulus"]}
                sag = float(beam.sag(elastic))
            tip = run.tip_m.numpy()
            found: dict[str, Any] = {
                "time_s": run.time_s,
                "tip_m": tip,
                "static_sag_m": sag,
                "lowest_m": float(tip[:, 2].min()),
                **motion(run.time_s, tip[:, 2]),
            }
            if rung.keep_surface:
                found["surface"] = _write_surface(folder / f"{rung.name}_{case}.npz", run, quads)
                found["surface_sha256"] = file_digest([Path(found["surface"])])
            return found

        return compute

    keys = [
        (rung, case, trial)
        for rung in ladder
        for case, trial in cases.items()
        if trial.tip_load_mass_kg > 0 or rung.light_as is None
    ]
    found = workers.run([job(*key) for key in keys])
    runs: dict[str, Any] = {rung.name: {} for rung in ladder}
    for (rung, case, _), result in zip(keys, found, strict=True):
        runs[rung.name][case] = result
    return {"runs": runs}


def surfaces_exist(result: Mapping[str, Any]) -> bool:
    """Whether every kept surface is still on disk as it was (a stage is of no use without)."""
    kept = [run for cases in result["runs"].values() for run in cases.values() if "surface" in run]
    files = [(Path(run["surface"]), run["surface_sha256"]) for run in kept]
    return all(path.is_file() and file_digest([path]) == sha for path, sha in files)


def run_of(runs: Mapping[str, Any], rung: Rung, case: str) -> Mapping[str, Any]:
    """A rung's run of a case; where it has none, that of the rung it equals."""
    own = runs[rung.name]
    return own[case] if case in own else runs[str(rung.light_as)][case]


def compare(study: BeamStudy, ladder: Sequence[Rung], runs: Mapping[str, Any]) -> dict[str, Any]:
    """Every rung against every trial: what is left, aligned at release and at the best shift."""
    return {
        rung.name: {
            trial.name: _left(trial, run_of(runs, rung, trial.case)) for trial in study.trials
        }
        for rung in ladder
    }


def _left(trial: BeamTrial, run: Mapping[str, Any]) -> dict[str, Any]:
    measured = window(trial.time_s, trial.tip_displacement_m, COMPARE_S)
    time_s, tip = np.asarray(run["time_s"]), torch.tensor(run["tip_m"], dtype=torch.float64)
    shift = measured.best_shift(time_s, tip)
    total, per_axis = rms(measured.residual(time_s, tip))
    total_best, per_axis_best = rms(measured.residual(time_s, tip, shift))
    return {
        "vertical_rms_m": per_axis[2],
        "vertical_rms_best_shift_m": per_axis_best[2],
        "best_shift_s": shift,
        "rms_xyz_m": per_axis,
        "rms_m": total,
        "rms_best_shift_m": total_best,
    }


def _write_surface(path: Path, run: Release, quads: torch.Tensor) -> str:
    """Places of the surface nodes at the camera's rate, and the faces between them."""
    assert run.nodes_m is not None
    stride = max(1, round(FRAME_S / (run.time_s[1] - run.time_s[0])))
    write_bytes_atomic(
        path,
        pack(
            time_s=run.time_s[::stride],
            nodes_m=run.nodes_m[::stride].numpy().astype(np.float32),
            quads=quads.numpy(),
        ),
    )
    return str(path)
