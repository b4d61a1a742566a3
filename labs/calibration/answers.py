"""Answers to stored cases with one threshold changed; one search is judged many times."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diffsim.core.errors import DiffsimError
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.core.threads import one_thread
from diffsim.diagnose import diagnosis
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.gain import validation_of
from diffsim.diagnose.say.assemble import report_of, tested
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.search.evidence import screen
from diffsim.diagnose.search.simulations import NONE
from labs.answers import answer_of, failure
from labs.calibration.thresholds import FACTORS, JUDGE, Threshold, changed, listed
from labs.rates.case import case_inputs, diagnosed, make
from labs.rates.score import scored

MADE = "made.json"  # beside the study of a stored case: what is hidden in it
Item = Mapping[str, Any]
BRIEF = ("verdict", "named", "rivals", "outcome", "is_certain")


def variant(threshold: Threshold, factor: float) -> str:
    """Name of a threshold at a factor."""
    return f"{threshold.key}_x{factor:g}"


def store(item: Item) -> dict[str, Any]:
    """The case of an item, made once in ``studies``: its study, and apart from it what is hidden.

    Args:
        item: ``master``, ``domain`` and ``index`` of the case, and the folder ``studies``.
    """
    folder = Path(item["studies"]) / f"{item['domain']}_{item['index']:04d}"
    if not (folder / MADE).is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making_") as room:
            made = make(item, Path(room) / "case" / "study")
            write_json_atomic(Path(room) / "case" / MADE, made)
            shutil.rmtree(folder, ignore_errors=True)
            (Path(room) / "case").rename(folder)
    stored: dict[str, Any] = json.loads((folder / MADE).read_text(encoding="utf-8"))
    return {**stored, "study": str(folder / "study")}


@one_thread
def judged(item: Item) -> dict[str, Any]:
    """The answer to a case, and its search judged with each threshold that acts afterwards changed;
    nothing of a case that its generator cannot record.

    Args:
        item: Of the case, with its ``effort``.
    """
    try:
        made = store(item)
    except (DiffsimError, ValueError, RuntimeError):
        return {}
    with _kept_search() as kept:
        inputs = case_inputs(made, Path(made["study"]), item["effort"])
        out = {"plain": _brief(made, lambda: diagnosed(inputs))}
    for threshold in listed():
        for factor in FACTORS:
            if threshold.acts == JUDGE:
                with changed(threshold, factor):
                    out[variant(threshold, factor)] = (
                        _brief(made, lambda: judge_again(kept, inputs)) if kept else out["plain"]
                    )
    return out


def searched(item: Item) -> dict[str, Any]:
    """The whole answer to a case with one threshold changed.

    Args:
        item: Of the case, with its ``effort``, ``key`` of the threshold, and ``factor``.
    """
    made = store(item)
    (threshold,) = (t for t in listed() if t.key == item["key"])
    with changed(threshold, item["factor"]):
        inputs = case_inputs(made, Path(made["study"]), item["effort"])
        return _brief(made, lambda: diagnosed(inputs))


def judge_again(kept: list[Any], inputs: Inputs) -> Report:
    """The report of a search that was made before, as thresholds are now.

    Args:
        kept: What the search handed to the judgment.
        inputs: Of the diagnosis.
    """
    search, checks, _, seed = kept
    validation = validation_of(search.fit_of(NONE), search.null.case.study.select_runs)
    checks, judgment = diagnosis._judge_search(search, checks, validation, seed)
    screened = screen(search.plain.evidence)
    frozen = report_of(search.null, checks, judgment, screened, seed, inputs.setup.bank, validation)
    return tested(frozen, inputs.study, seed)


@contextmanager
def _kept_search() -> Iterator[list[Any]]:
    """What the next diagnosis hands from its search to its judgment."""
    kept: list[Any] = []
    plain = diagnosis._judge_search

    def keep(*given: Any) -> Any:
        kept[:] = given
        return plain(*given)

    diagnosis._judge_search = keep
    try:
        yield kept
    finally:
        diagnosis._judge_search = plain


def _brief(made: Mapping[str, Any], diagnose: Any) -> dict[str, Any]:
    """What of an answer is compared."""
    try:
        answer = answer_of(diagnose())
    except (DiffsimError, ValueError) as error:
        answer = failure(error)
    whole = {**made, **answer, **scored({**made, **answer}, made["base"])}
    brief: dict[str, Any] = to_plain({name: whole[name] for name in BRIEF})
    return brief
