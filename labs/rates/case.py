"""One case: recorded into a study folder, diagnosed as by anybody, held against what was hidden."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.data.study_save import save_study
from diffsim.diagnose.diagnosis import diagnosed
from diffsim.diagnose.inputs import Inputs
from diffsim.identify.effect import Effect
from labs.answers import answer_of, failure
from labs.rates.draw import DENIED, FAMILY, Draw, draw
from labs.rates.rig import Recorded
from labs.rates.score import scored
from labs.rates.strength import size_for

QUICK, FULL = "quick", "full"
EFFORTS = (QUICK, FULL)
LEAST_FITTED = 2  # commands: of one alone no band is told
Item = Mapping[str, Any]


def solve(item: Item) -> dict[str, Any]:
    """Make a case, diagnose it, and hold the answer against the truth.

    Args:
        item: ``master``, ``domain``, ``index`` and ``effort`` of the case.
    """
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="rates_") as room:
        try:
            made = make(item, Path(room) / "study")
        except (DiffsimError, ValueError, RuntimeError) as error:
            return {**item, **not_made(item, error)}
        made |= {"far": bool(item.get("far"))}
        row = {**item, **made, **solved(made, Path(room) / "study", item["effort"])}
    return {**row, "wall_s": time.perf_counter() - started}


def not_made(item: Item, error: Exception) -> dict[str, Any]:
    """The row of a case that its generator could not record; it counts as no answer."""
    case = draw(item["master"], item["domain"], item["index"])
    row = {**_drawn_facts(case), "size": [], "truth": {"sizes": {}, "also": []}, "lambda": 0.0}
    answer = {**failure(error), "verdict": "not made", "cpu_s": 0.0, "simulations": 0}
    return {**row, **answer, **scored({**row, **answer}, {})}


def _drawn_facts(case: Draw) -> dict[str, Any]:
    return {
        "rig": case.rig.name,
        "kind": case.kind,
        "hidden": case.hidden,
        "denies": case.denies if case.kind == DENIED else "",
        "trouble": case.trouble,
        "wanted": case.wanted,
    }


def make(item: Item, folder: Path) -> dict[str, Any]:
    """Record a case into a study folder, and tell apart from it what is hidden.

    Args:
        item: ``master``, ``domain`` and ``index`` of the case.
        folder: Made; all that a diagnosis sees.
    """
    case = draw(item["master"], item["domain"], item["index"])
    started = time.process_time()
    size, strength = size_for(case) if case.hidden else (0.0, 0.0)
    recorded = case.rig.record(case.seed, case.sizes(size), case.trouble)
    write_study(recorded, folder)
    effects = inputs_of(load_study(folder), seed=0, setup_file=case.rig.setup_file).setup.effects
    truth = truth_of(case, size, effects)
    setup_file = case.rig.setup_file
    return {
        **_drawn_facts(case),
        "size": list(case.sizes(size).get(case.hidden, ())),
        "truth": truth,
        "base": dict(recorded.base),
        "without": list(denied_names(case, truth, effects)),
        "lambda": strength,
        "setup_file": None if setup_file is None else str(setup_file),
        "making_cpu_s": time.process_time() - started,
    }


def solved(made: Mapping[str, Any], folder: Path, effort: str) -> dict[str, Any]:
    """The answer to a study folder with its outcome; a diagnosis that fails is an answer, too."""
    inputs = case_inputs(made, folder, effort)
    simulations, started = inputs.setup.model.simulations, time.process_time()
    before = simulations.count
    try:
        answer = answer_of(diagnosed(inputs))
    except (DiffsimError, ValueError) as error:
        answer = failure(error)
    answer |= {"cpu_s": time.process_time() - started, "simulations": simulations.count - before}
    return {**answer, **scored({**made, **answer}, made["base"])}


def farthest_kept(study: Study) -> Study:
    """The study with one more command judged: the fitted one that moved what was measured most.

    Strokes are standard deviations over those of all runs. Two commands at least stay fitted.
    """
    runs = [run for run in study.runs if run.use == "fit"]
    if len({run.group for run in runs}) <= LEAST_FITTED:
        return study
    usual = np.nanstd(np.concatenate([run.measured for run in runs]), axis=0)
    strokes = {r.name: np.nanmax(np.nanstd(r.measured, axis=0) / usual) for r in runs}
    far = max(runs, key=lambda run: strokes[run.name]).group
    kept = [replace(r, use="test") if r in runs and r.group == far else r for r in study.runs]
    return replace(study, runs=tuple(kept))


def case_inputs(made: Mapping[str, Any], folder: Path, effort: str) -> Inputs:
    """What a user's command makes of a study folder, with the causes that are denied left out.

    Args:
        made: Of ``make``.
        folder: Of the study.
        effort: One of ``EFFORTS``.
    """
    study = load_study(folder)
    return inputs_of(
        farthest_kept(study) if made.get("far") else study,
        seed=0,
        setup_file=None if made["setup_file"] is None else Path(made["setup_file"]),
        without=made["without"],
        budget=effort,
    )


def write_study(recorded: Recorded, folder: Path) -> Path:
    """Write what a diagnosis sees: a description and tables, called after nothing that was drawn.

    Args:
        recorded: Recordings.
        folder: Made.
    """
    study = recorded.study
    metadata = {k: v for k, v in study.metadata.items() if k != "title"}
    save_study(replace(study, name="case", metadata=metadata), folder)
    return folder


def truth_of(case: Draw, size: float, effects: Sequence[Effect]) -> dict[str, Any]:
    """What is hidden by the library's names: sizes by component, and names that say the same.

    A rig's cause with several places is one effect per place in a library:
    ``weak_rotor: [0, 0.1, 0, 0]`` is weak_rotor_2. What the library lacks has no size.
    """
    if not case.hidden:
        return {"sizes": {}, "also": []}
    by_name = {e.name: e for e in effects}
    names, sizes = case.cause.names or (case.hidden,), case.sizes(size)[case.hidden]
    places = {f"{case.hidden}_{i + 1}": [s] for i, s in enumerate(sizes) if s != 0.0}
    found: dict[str, list[float] | None]
    if names[0] in by_name:
        is_sized = case.cause.sized and len(by_name[names[0]].components) == len(sizes)
        found = {names[0]: list(sizes) if is_sized else None}
    elif all(place in by_name for place in places):
        found = dict(places)
    else:
        found = {case.hidden: None}
    return {"sizes": found, "also": [n for n in names[1:] if n in by_name]}


def denied_names(
    case: Draw, truth: Mapping[str, Any], effects: Sequence[Effect]
) -> tuple[str, ...]:
    """Names of the effects that a denied library lacks.

    Args:
        case: What is hidden.
        truth: The same by the library's names, of ``truth_of``.
        effects: The whole library.
    """
    if case.kind != DENIED:
        return ()
    own = {*truth["sizes"], *truth["also"]}
    rows = {row_of(name) for name in own}
    families = {e.family for e in effects if e.name in own and case.denies == FAMILY}
    return tuple(e.name for e in effects if row_of(e.name) in rows or e.family in families)


def row_of(name: str) -> str:
    """The row of a cause, without the place where it acts: dry_friction_at_load, weak_rotor_2."""
    return re.sub(r"(_\d+|_(of|at)_.*)$", "", name)
