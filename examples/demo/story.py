"""The story in its order: recordings, meshes, stiffness, damping, fits, models, diagnosis, page."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diffsim import __version__
from diffsim.core.files import code_digest, write_bytes_atomic, write_json_atomic
from diffsim.data import find_dataset
from examples.data import beam_motion
from examples.data.beam import BeamStudy, load_beam_study
from examples.demo import diagnosis, early, fitting, ladder, mesh_study, numerics, stored, verdict
from examples.demo.plan import FULL, QUICK, Plan
from examples.demo.stages import Stages
from examples.demo.workers import Workers

# Written by labs/virtual/clamped_beam.py, which a wheel does not have.
VIRTUAL_BEAM = Path(__file__).with_name("virtual_beam")
FITTED = {"identified": 1, "joint": 2}  # recordings of each fit to the motion
# of the bar, so that it is not full while a diagnosis and a page are made: a third of a run's time
DIAGNOSIS_STEPS, PAGE_STEPS = 12_000, 500
VIRTUAL_BANNER = (
    "VIRTUAL DATA. No measured recordings were found, so these were computed by diffsim's "
    "virtual laboratory. Nothing on this page says anything about a real beam. "
    "Set DIFFSIM_DATA to the folder that holds silicone_beam/ to use the measured ones."
)


def main(**options: Any) -> int:
    """``diffsim demo``: :func:`run`, then the verdict and where to look, printed; returns 0."""
    results = run(**options)
    said = (*results["opening"], *results["diagnosis"].get("sentences", ()))
    for sentence in (*said, *results["hidden"], *results["stored"], *results["compared"]):
        print(f"\n{sentence}")
    print(f"\npage       {results['files']['page']}\nnumbers    {results['files']['numbers']}")
    if results["files"]["rerun"]:
        print(f"recording  {results['files']['rerun']} (open with: rerun FILE)")
    return 0


def run(
    data: str | Path | None = None,
    out: str | Path = "runs/demo",
    quick: bool = False,
    resume: bool = False,
    threads: int | None = None,
    plan: Plan | None = None,
    anew: bool = False,
) -> dict[str, Any]:
    """Compare simulation and measurement of the clamped silicone beam; write one page.

    Args:
        data: Folder that holds ``silicone_beam``; by default DIFFSIM_DATA, then
            ``../shared/data``; if there is none, recordings that a virtual laboratory made.
        out: ``report.html``, ``results.json``, ``beam.rrd``, ``figures/`` and ``stages/`` are
            written here.
        quick: A coarse mesh and large steps, for a first look.
        resume: Take finished stages of an earlier, interrupted run as they are.
        threads: Simulations side by side; by default all processors. Results do not depend on it.
        plan: Sizes, in place of the full or the quick ones.
        anew: Compute what stored answers would tell, too, and compare.

    Returns:
        All numbers of the report.
    """
    out = Path(out)
    plan = plan or (QUICK if quick else FULL)
    study = load_study(data)
    question = stored.asked(study, plan)
    code = {"version": __version__, "code": code_digest(Path(__file__).parent)}
    stages = Stages(out, code | question, resume=resume)
    kept = stored.answers(question)
    known = stored.Stored() if anew else kept
    workers = Workers(threads or os.cpu_count() or 1, _num_steps(study, plan, known))
    if study.is_virtual:
        workers.say(VIRTUAL_BANNER)
    try:
        results, models = _compute(study, plan, stages, workers, out, known)
        results["stored"] = known.words()
        results["compared"] = stored.distances(kept, results) if anew else []
        workers.stage("page", PAGE_STEPS)
        results["virtual_truth"] = study.metadata.get("truth")
        results["hidden"] = verdict.hidden(study, results)
        results["opening"] = verdict.opening(study, results)
        results["verdict"] = verdict.sentences(study, results)
        results["files"] = _write_extras(study, results, models, out)
        write_json_atomic(out / "results.json", _without_curves(results))
        _write_page(study, results, models, plan, out)
    finally:
        workers.close()
    return results


def load_study(data: str | Path | None) -> BeamStudy:
    """The measured beam, or the virtual one if there is none.

    Raises:
        ValueError: the folder lacks a case, or a repeat.
    """
    folder = find_dataset("silicone_beam", data) or VIRTUAL_BEAM
    study = load_beam_study(folder)
    loads = {case: trials[0].tip_load_mass_kg for case, trials in study.repeats().items()}
    short = [case for case, trials in study.repeats().items() if len(trials) < 2]
    if short or sorted(load > 0 for load in loads.values()) != [False, True]:
        raise ValueError(
            f"{folder}: the demo needs one case without and one with a weight, two repeats each; "
            f"found {loads} (mass in kg)" + (f", without repeat: {short}" if short else "")
        )
    return study


def _num_steps(study: BeamStudy, plan: Plan, known: stored.Stored) -> int:
    dear = sum(_dear_steps(study, plan, known, name) for name in stored.STAGES)
    return numerics.num_steps(plan) + ladder.num_steps(plan) + dear + PAGE_STEPS


def _dear_steps(study: BeamStudy, plan: Plan, known: stored.Stored, name: str) -> int:
    if name in known.results:
        return 0
    if name in FITTED:
        return _fit_steps(plan, FITTED[name])
    return 0 if diagnosis.why_skipped(study, plan) else DIAGNOSIS_STEPS


def _fit_steps(plan: Plan, runs: int) -> int:
    """About: evaluations count twice (gradient), then some for the uncertainty."""
    return round(runs * plan.fit_s / plan.dt_s * (plan.max_evaluations + 6))


def _compute(
    study: BeamStudy, plan: Plan, stages: Stages, workers: Workers, out: Path, known: stored.Stored
) -> tuple[dict[str, Any], list[ladder.Rung]]:
    def dear(name: str, title: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        workers.stage(title, _dear_steps(study, plan, known, name))
        return stages.run(name, lambda: known.results.get(name) or compute(), of=known.commit)

    bar = study.geometry
    results: dict[str, Any] = {"is_virtual": study.is_virtual, "data": str(study.folder)}

    workers.stage("recordings", 0)
    told = results["measured"] = stages.run("measured", lambda: beam_motion.describe(study))
    workers.stage("meshes", 0)
    results["mesh"] = stages.run("mesh", lambda: mesh_study.describe(bar, plan, workers))

    light, loaded = sorted(study.repeats().values(), key=lambda t: t[0].tip_load_mass_kg)
    floor = {case: repeat["vertical_rms_m"] for case, repeat in told["repeats"].items()}
    target = told["trials"][light[0].name]["static_sag_m"]
    workers.say(early.measured(target, floor[light[0].case]))
    workers.stage("stiffness from the sag", 0)
    sag = results["sag_fit"] = stages.run(
        "sag_fit", lambda: fitting.fit_sag(bar, plan.published(), target)
    )
    workers.say(early.stiffness(sag["youngs_modulus"], bar.youngs_modulus_published_Pa))
    workers.stage("numerical damping", numerics.num_steps(plan))
    results["numerics"] = stages.run(
        "numerics", lambda: numerics.describe(bar, plan, sag["youngs_modulus"], workers)
    )
    single = results["identified"] = dear(
        "identified",
        "identification, one case",
        lambda: fitting.fit_motion(
            bar,
            plan.better(),
            [(light[0], floor[light[0].case])],
            plan,
            workers,
            start={"youngs_modulus": sag["youngs_modulus"]},
            damping=["rayleigh_beta"],
        ),
    )
    workers.say(early.fitted("without the weight", single["value"]))
    joint = results["joint"] = dear(
        "joint",
        "identification, both cases",
        lambda: fitting.fit_motion(
            bar,
            plan.better().changed(weight_as="mass"),
            [(trials[0], floor[trials[0].case]) for trials in (light, loaded)],
            plan,
            workers,
            start=single["value"],
            damping=["rayleigh_beta", "rayleigh_alpha"],
        ),
    )
    workers.say(early.fitted("both cases", joint["value"]))
    models = ladder.rungs(bar, plan, sag, single, joint)
    workers.stage("simulations", ladder.num_steps(plan))
    results["simulated"] = stages.run(
        "simulated",
        lambda: ladder.simulate(study, models, workers, out / "stages"),
        valid=ladder.surfaces_exist,
    )["runs"]
    results["remaining"] = ladder.compare(study, models, results["simulated"])
    results["diagnosis"] = dear(
        "diagnosis", "diagnosis", lambda: diagnosis.describe(study, plan, out, workers.note)
    )
    results["models"] = {
        rung.name: {
            "title": rung.title,
            "integrator": rung.setup.integrator,
            "dt_s": rung.setup.dt_s,
            "cells": rung.setup.cells,
            "poissons_ratio": rung.setup.poissons_ratio,
            "weight_as": rung.setup.weight_as,
            "parameters": dict(rung.parameters),
        }
        for rung in models
    }
    results["youngs_modulus"] = _moduli(results, bar.youngs_modulus_published_Pa)
    return results, models


def _moduli(results: dict[str, Any], published: float) -> dict[str, float]:
    """The same stiffness as Young's moduli of this mesh, the finest mesh and beam theory [Pa]."""
    own = results["identified"]["value"]["youngs_modulus"]
    return {
        "published_Pa": published,
        "sag_on_this_mesh_Pa": results["sag_fit"]["youngs_modulus"],
        "motion_on_this_mesh_Pa": own,
        "motion_on_finest_mesh_Pa": own * results["mesh"]["factor_finest"],
        "motion_by_beam_theory_Pa": own * results["mesh"]["factor_beam_theory"],
    }


def _without_curves(results: dict[str, Any]) -> dict[str, Any]:
    """For results.json: curves and pictures stay in stages/."""
    runs = {
        rung: {
            case: {k: v for k, v in run.items() if k not in ("time_s", "tip_m")}
            for case, run in cases.items()
        }
        for rung, cases in results["simulated"].items()
    }
    diagnosed = {k: v for k, v in results["diagnosis"].items() if k != "charts"}
    return {**results, "simulated": runs, "diagnosis": diagnosed}


def _write_extras(
    study: BeamStudy, results: dict[str, Any], models: list[ladder.Rung], out: Path
) -> dict[str, str | None]:
    """Figure files and, where rerun is installed, the recording."""
    from examples.demo import picture, recording

    figure = write_bytes_atomic(out / "figures" / "beam.png", picture.beam(study, results))
    try:
        scene = str(recording.write(study, results, models, out / "beam.rrd"))
    except ImportError:
        scene = None
    return {
        "page": str(out / "report.html"),
        "numbers": str(out / "results.json"),
        "picture": str(figure),
        "rerun": scene,
    }


def _write_page(
    study: BeamStudy, results: dict[str, Any], models: list[ladder.Rung], plan: Plan, out: Path
) -> None:
    from diffsim.viz import report as rp
    from examples.demo import page, picture

    banner = VIRTUAL_BANNER if study.is_virtual else None
    wide = Path(results["files"]["picture"]).read_bytes()
    drawn = (wide, picture.beam(study, results, narrow=True))
    rp.write(page.report(study, results, models, plan, banner, drawn), out / "report.html")
