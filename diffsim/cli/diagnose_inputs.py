"""Inputs of a diagnosis from the command line: study, setup, chosen causes; and their hash."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from diffsim.cli.arguments import FULL, QUICK, study_file
from diffsim.core.check import as_spelled, require_choice
from diffsim.core.files import code_digest, to_plain
from diffsim.core.version import __version__
from diffsim.data.bank import generated_bank
from diffsim.data.study import Run, Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.inputs import Inputs
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.effect import Effect
from diffsim.identify.effort import FIRST_STEPS, DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.ode.traced import with_function
from diffsim.systems.registry import setup_of

MAX_PATH = 200  # longer texts of a description are no paths
SEARCH: dict[str, Any] = {"scan_steps": FIRST_STEPS, "refit_steps": FIRST_STEPS, "law_steps": None}
FULL_TIMES = 5.0  # a full answer may cost as many first ones
PLAIN_SHARE = 0.5  # of the steps of an answer, that the plain model's fit may take
TABLE_SHARE = 1.0 / 16.0  # of a first answer, that slopes along all causes may cost, of many runs
LEAST_RUNS = 8  # that it is fitted to
FIRST: dict[str, Any] = {
    "first_mesh": 2.0,
    "dear_steps": 0.3e6,
    "plain_steps": PLAIN_SHARE * FIRST_STEPS,
}


def read_study(given: str) -> Study:
    """A study from a file, a folder, or the name of a published data set.

    Raises:
        FileNotFoundError: neither; the message offers the closest names.
    """
    return load_study(study_file(given), strict=False)


def choose(
    effects: Sequence[Effect], only: Sequence[str] = (), without: Sequence[str] = ()
) -> tuple[Effect, ...]:
    """Effects by name, in their own order.

    Args:
        effects: Effects to choose from.
        only: Names of the effects to keep; empty: all.
        without: Names of the effects to leave out.

    Raises:
        ValueError: no such name; the message offers the closest ones.
    """
    known = [e.name for e in effects]
    only, without = ([as_spelled(name, known) for name in names] for names in (only, without))
    for option, names in (("--effects", only), ("--without", without)):
        for name in names:
            require_choice(option, name, known)
    return tuple(e for e in effects if (not only or e.name in only) and e.name not in without)


def own_setup(path: Path, study: Study) -> DiagnosisSetup:
    """Setup that ``setup(study)`` of a Python file makes, or that of rates which are in it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file has no such function, or it makes something else.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--setup must be a Python file with setup(study), got {path}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"--setup must be a Python file (.py), got {path}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    make = getattr(module, "setup", None)
    if not callable(make):
        make = _of_function(path, module, study)
    made = make(study)
    if not isinstance(made, DiagnosisSetup):
        raise ValueError(
            f"setup(study) of {path} must return a DiagnosisSetup, got {type(made).__name__}"
        )
    return made


def _of_function(path: Path, module: ModuleType, study: Study) -> Callable[[Study], DiagnosisSetup]:
    """The maker of a setup whose rates are a function of the file, as the study names it.

    Raises:
        ValueError: the study names another file, or a function that the file lacks.
    """
    file, _, name = str((study.model or {}).get("function", "")).partition(":")
    folder = study.folder or Path()
    if not file or (folder / file).resolve() != path.resolve():
        raise ValueError(
            f"--setup {path} has no function setup(study), and the study has no "
            f"model.function {path.name}:NAME"
        )
    function = getattr(module, name, None)
    if not callable(function):
        raise ValueError(f"model.function: {path} has no function {name!r}")

    def make(study: Study) -> DiagnosisSetup:
        written = with_function(study, function)
        return replace(setup_of(written), study=written)

    return make


def inputs_of(
    study: Study,
    *,
    seed: int,
    setup_file: Path | None = None,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    budget: str | float = FULL,
    workers: int = 1,
    accept_numerics: bool = False,
    with_bank: bool = False,
) -> Inputs:
    """The setup of a study with the user's choices.

    Args:
        study: Study as it was read.
        setup_file: Python file with the user's own ``setup(study)``; None: that of the study.
        only: Names of the effects to keep; empty: all.
        without: Names of the effects to leave out.
        budget: "quick" for a first answer, "full", or the number of weighted steps of a search
            (``SimModel.cost``) after which no further set is fitted and no further size tried.
        workers: Threads over runs.
        accept_numerics: Go on although numerical settings matter.
        with_bank: Make runs that could be recorded next, where the setup has none.

    Raises:
        ValueError: no setup, or names that it does not have.
    """
    make = setup_of if setup_file is None else partial(own_setup, setup_file)
    setup = make(study)
    asked = choose(setup.effects, only, without)
    if budget == QUICK and (fewer := _fewer_runs(study, setup, asked)) is not None:
        study, setup = fewer, make(fewer)
    if with_bank and not setup.bank:
        setup = _with_bank(setup, setup.study or study, {run.name for run in study.runs})
    study = setup.study or study
    settings = replace(
        setup.settings,
        workers=workers,
        accept_numerics=accept_numerics or setup.settings.accept_numerics,
    )
    settings = _with_budget(settings, budget)
    setup = replace(setup, effects=choose(setup.effects, only, without), settings=settings)
    return Inputs(study, setup, seed, _fingerprint(study, setup, setup_file, seed))


def _fewer_runs(study: Study, setup: DiagnosisSetup, effects: Sequence[Effect]) -> Study | None:
    """The study of a first answer, where many short runs would cost most of it: some of them, from
    all kinds alike and with their repeats, are fitted. None: all can be.
    """
    used = setup.study or study
    runs, noise = used.fit_runs, WhiteNoise([replace(c, sd=c.sd or 1.0) for c in used.channels])
    table = Problem(setup.model, runs, noise, tuple(effects)).cost_of_table()
    share = max(TABLE_SHARE * FIRST_STEPS / max(table, 1.0), LEAST_RUNS / max(len(runs), 1))
    firsts = {run.group: run for run in reversed(runs)}
    groups = list(dict.fromkeys(run.group for run in runs))  # as they were recorded
    count = max(round(share * len(groups)), 1)
    if share >= 1.0 or count >= len(groups):
        return None
    chosen = set[str]()
    for kind in _kinds([firsts[group] for group in groups], count):
        num = max(round(share * len(kind)), 1)
        chosen |= {kind[int((k + 0.5) * len(kind) / num)].group for k in range(num)}
    dropped = {run.name for run in runs if run.group not in chosen}
    said = (
        f"{len(dropped)} of {len(runs)} runs to be fitted are left out of a first answer: slopes "
        "along all causes would cost too much of it; --budget full fits all"
    )
    kept = tuple(run for run in study.runs if run.name not in dropped)
    return replace(study, runs=kept, mended=(*study.mended, said))


def _kinds(runs: Sequence[Run], most: int) -> list[list[Run]]:
    """Runs by what their facts have in common; all in one, sorted by them, if these are too many.

    Args:
        runs: Runs, each of another command.
        most: Number of kinds; a fact of more values tells runs apart, not kinds.
    """
    facts = {key for run in runs for key in run.setup if not key.startswith("_")}
    values = {key: {str(run.setup.get(key)) for run in runs} for key in sorted(facts)}
    told = [key for key, found in values.items() if len(found) <= most]
    kinds: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        kinds.setdefault(tuple(str(run.setup.get(key)) for key in told), []).append(run)
    by_facts = [kinds[key] for key in sorted(kinds)]
    return by_facts if len(kinds) <= most else [[run for kind in by_facts for run in kind]]


def _with_budget(settings: DiagnosisSettings, budget: str | float) -> DiagnosisSettings:
    """Effort within a budget.

    Raises:
        ValueError: neither quick, full nor a count.
    """
    if budget == FULL:
        most = FULL_TIMES * FIRST_STEPS
        own = settings.search
        ends = {name: min(getattr(own, name), most) for name in ("scan_steps", "refit_steps")}
        # laws share them, so that the whole ends there, unless the study asks for its own
        laws = None if own.law_steps is None or not own.law_steps < most else own.law_steps
        plain = min(settings.plain_steps, PLAIN_SHARE * most)
        search = replace(own, **ends, law_steps=laws)
        return replace(settings, search=search, plain_steps=plain)
    if budget == QUICK:
        return replace(settings, search=replace(settings.search, **SEARCH), **FIRST)
    if isinstance(budget, str) or not budget > 0.0:
        raise ValueError(
            f"budget must be {QUICK!r}, {FULL!r} or a number of simulated steps above 0, such as "
            f"5e7, got {budget!r}"
        )
    n = float(budget)
    search = replace(settings.search, scan_steps=n, refit_steps=n, law_steps=n)
    return replace(settings, search=search)


def _with_bank(setup: DiagnosisSetup, study: Study, recorded: Collection[str]) -> DiagnosisSetup:
    """The setup with runs that could be recorded; each gets parameters of its own if runs do.

    Args:
        recorded: Names of its runs; others are what the setup adds, such as clicked points.
    """
    runs = tuple(run for run in study.runs if run.name in recorded)
    bank = generated_bank(replace(study, runs=runs))
    if study.model is not None and any("@" in p.name for p in setup.model.base):
        wider = setup_of(replace(study, runs=(*study.runs, *bank)))
        setup = replace(wider, study=setup.study)
    return replace(setup, bank=bank)


def _fingerprint(
    study: Study, setup: DiagnosisSetup, setup_file: Path | None, seed: int
) -> dict[str, Any]:
    effort = {k: v for k, v in asdict(setup.settings).items() if k != "workers"}
    base = [[p.name, p.value, p.sd, p.unit, p.log] for p in setup.model.base]
    source = "" if setup_file is None else setup_file.read_text(encoding="utf-8")
    return {
        "study": _study_hash(study),
        "model": hashlib.sha256(f"{setup.model.name} {base} {source}".encode()).hexdigest(),
        "effects": [e.name for e in setup.effects],
        "settings": to_plain(effort),
        "seed": seed,
        "version": __version__,
        "code": code_digest(),
    }


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Which parts of two fingerprints differ."""
    now = json.loads(json.dumps(now))  # as it is read back
    return [name for name in now if before.get(name) != now[name]]


def _files_of(stated: Any, folder: Path | None) -> Iterator[Path]:
    """Files that a description names: meshes, designs, simulators."""
    if isinstance(stated, Mapping):
        for value in stated.values():
            yield from _files_of(value, folder)
    elif isinstance(stated, (list, tuple)):
        for value in stated:
            yield from _files_of(value, folder)
    elif isinstance(stated, str) and folder is not None and 0 < len(stated) < MAX_PATH:
        path = folder / stated.rpartition(":")[0] if ".py:" in stated else folder / stated
        if path.is_file():
            yield path


def _study_hash(study: Study) -> str:
    total = hashlib.sha256()
    facts = {
        "name": study.name,
        "channels": [asdict(c) for c in study.channels],
        "metadata": to_plain(dict(study.metadata)),
        "model": to_plain(dict(study.model or {})),
    }
    for path in _files_of(study.model, study.folder):
        total.update(path.read_bytes())
    total.update(json.dumps(facts, sort_keys=True).encode())
    for run in study.runs:
        # what the system found in the recording, such as a start, is fitted: rounding moves it
        stated = sorted((k, v) for k, v in run.setup.items() if not k.startswith("_"))
        header = [run.name, run.group, run.order, run.use, stated]
        total.update(json.dumps(header).encode())
        beside = [(f"column {name}", run.columns[name]) for name in sorted(run.columns)]
        recorded = [("t", run.time_s), ("y", run.measured), *sorted(run.command.items()), *beside]
        for name, values in recorded:
            total.update(name.encode() + np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return total.hexdigest()
