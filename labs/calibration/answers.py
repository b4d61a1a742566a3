"""Answers to stored cases: followed by which thresholds could change them, or with one changed."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffsim.core.errors import DiffsimError
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.core.threads import one_thread
from diffsim.diagnose.diagnosis import diagnosed
from labs.answers import answer_of, failure
from labs.calibration.probe import probed
from labs.calibration.thresholds import FACTORS, listed, put, variant
from labs.rates.case import case_inputs, make
from labs.rates.score import scored

MADE = "made.json"  # beside the study of a stored case: what is hidden in it
Item = Mapping[str, Any]
BRIEF = ("verdict", "named", "rivals", "outcome", "is_certain")


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
def followed(item: Item) -> dict[str, Any]:
    """The ``plain`` answer to a case, and the variants ``asked`` for: those that may change it.

    Args:
        item: Of the case, with its ``effort``.

    Returns:
        Both; nothing of a case that its generator cannot record. All variants are asked for where
        following the thresholds failed.
    """
    try:
        made = store(item)
    except (DiffsimError, ValueError, RuntimeError):
        return {}
    plain = brief(item, made)
    every = {variant(threshold, factor) for threshold in listed() for factor in FACTORS}
    try:
        with probed() as asked:
            same = brief(item, made) == plain
    except (TypeError, AttributeError):  # code that takes plain numbers alone
        same = False
    return {"plain": plain, "asked": sorted(asked if same else every), "followed": same}


@one_thread
def changed(item: Item) -> dict[str, Any]:
    """The answer to a case with one threshold changed.

    Args:
        item: Of the case, with its ``effort``, ``key`` of the threshold, and ``factor``.
    """
    made = store(item)
    (threshold,) = (t for t in listed() if t.key == item["key"])
    with put(threshold, threshold.times(item["factor"])):
        return brief(item, made)


def brief(item: Item, made: Mapping[str, Any]) -> dict[str, Any]:
    """What of an answer is compared.

    Args:
        item: Of the case, with its ``effort``.
        made: Of ``store``.
    """
    try:
        answer = answer_of(diagnosed(case_inputs(made, Path(made["study"]), item["effort"])))
    except (DiffsimError, ValueError) as error:
        answer = failure(error)
    whole = {**made, **answer, **scored({**made, **answer}, made["base"])}
    kept: dict[str, Any] = to_plain({name: whole[name] for name in BRIEF})
    return kept
