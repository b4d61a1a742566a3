"""Hold an answer against what was hidden: one outcome per case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from diffsim.diagnose.judge.records import CERTAIN, DATA_SHEET, EFFECT
from labs.rates.draw import DENIED, NULL
from labs.rates.sheets import held_sheets

RIGHT, HELD, OPEN = "right", "ambiguous", "unknown"
LIKELY_WRONG, CERTAIN_WRONG = "likely wrong", "certain wrong"
ALARM, MISSED, NO_ANSWER = "false alarm", "missed", "no answer"
OUTCOMES = (RIGHT, HELD, OPEN, LIKELY_WRONG, CERTAIN_WRONG, ALARM, MISSED, NO_ANSWER)
SILENT = ("none", "data_sheet")
SPEAKING = ("named", "ambiguous", "unknown", "described")
ABSORBED = 3.0  # lambda: 4.5 nats, of which about 9 are needed to be seen
FAR_SHEET = 2.0  # half widths of its 90 % interval by which a data sheet's finding is surely wrong


def scored(row: Mapping[str, Any], base: Mapping[str, float]) -> dict[str, Any]:
    """Outcome, findings on data sheets beside the truth, and sizes beside their intervals.

    Args:
        row: What was hidden, and the answer.
        base: True base parameters by name; what is not known of them is held to be on its sheet.
    """
    sheets = held_sheets(base, row.get("sheets", {}))
    return {
        "outcome": outcome(row, sheets),
        "held_sheets": sheets,
        "sizes": held_sizes(row),
        "is_certain": sorted(certain_names(row)),
    }


def outcome(row: Mapping[str, Any], sheets: Mapping[str, Mapping[str, Any]]) -> str:
    """One of ``OUTCOMES``.

    Where nothing is hidden, ``none`` is right, and so is a data sheet that is off and said to be
    what it truly is. Where the library lacks the cause, ``unknown`` is right, and a look-alike that
    is not said to be certain stands as ambiguous, and so does a law: whether it is the right one is
    counted by ``labs.unlisted``. What no data could show is rightly not found.

    Args:
        row: What was hidden, and the answer.
        sheets: Findings on data sheets beside the truth.
    """
    verdict, kind = row["verdict"], row["kind"]
    if verdict not in (*SILENT, *SPEAKING):
        return NO_ANSWER
    holds = all(sheet["inside"] for sheet in sheets.values())
    if kind == NULL:
        if verdict == "none" or (verdict == "data_sheet" and holds):
            return RIGHT
        return HELD if verdict == "ambiguous" and [] in row.get("rivals", []) else ALARM
    own = {*row["truth"]["sizes"], *row["truth"]["also"]}
    free = set(row.get("laws", ())) if kind == DENIED else own
    if is_wrong_sheet(row, sheets) or certain_names(row) - free:
        return CERTAIN_WRONG
    if verdict in SILENT:
        return RIGHT if row["lambda"] < ABSORBED else MISSED
    if kind == DENIED:
        return RIGHT if verdict == "unknown" else HELD
    return _outcome_of_known(row, own)


def _outcome_of_known(row: Mapping[str, Any], own: set[str]) -> str:
    if row["verdict"] == "unknown":
        return OPEN
    wanted = [sorted(row["truth"]["sizes"]), *([name] for name in row["truth"]["also"])]
    named, rivals = sorted(row["named"]), [sorted(r) for r in row["rivals"]]
    if named in wanted and not rivals and row["verdict"] == "named":
        return RIGHT
    if any(names in wanted for names in (named, *rivals)):
        return HELD
    # of sets that share what is named, the rest is open: only a foreign name is wrong then
    return HELD if named and set(named) <= own and rivals else LIKELY_WRONG


def certain_names(row: Mapping[str, Any]) -> set[str]:
    """Effects that are said to be certain."""
    causes = row.get("statuses", {})
    sheets = set(row.get("sheets", {}))
    stated = row.get("stated", {})
    return {
        name
        for name, status in causes.items()
        if status == CERTAIN and name not in sheets and stated.get(name, [EFFECT])[0] == EFFECT
    }


def is_wrong_sheet(row: Mapping[str, Any], sheets: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether a data sheet is certainly off, the truth being far from what is said instead."""
    for name, sheet in sheets.items():
        if row.get("statuses", {}).get(name) != CERTAIN:
            continue
        if row.get("stated", {}).get(name, [DATA_SHEET])[0] != DATA_SHEET:
            continue
        if sheet["true"] is None:
            return True
        reach = FAR_SHEET * 0.5 * (sheet["high"] - sheet["low"])
        if abs(sheet["true"] - 0.5 * (sheet["high"] + sheet["low"])) > reach:
            return True
    return False


def held_sizes(row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """By component of what was hidden: true size, the one that is said, whether it is inside.

    Sizes of causes that the answer neither names nor holds among its rivals are not said.
    """
    if row["kind"] == DENIED:
        return {}
    said = {n for names in (row.get("named", []), *row.get("rivals", [])) for n in names}
    out = {}
    for name, sizes in row["truth"]["sizes"].items():
        found = row.get("intervals", {}).get(name)
        if name not in said or not found or sizes is None or len(found) != len(sizes):
            continue
        for (component, (value, low, high)), true in zip(found.items(), sizes, strict=True):
            key = name if len(sizes) == 1 else f"{name}.{component}"
            out[key] = held(true, value, low, high)
    return out


def held(true: float, value: float, low: float, high: float) -> dict[str, Any]:
    """A true size beside what is said of it."""
    inside = low <= true <= high
    return {"true": true, "found": value, "low": low, "high": high, "inside": inside}


def stated_pairs(row: Mapping[str, Any]) -> Sequence[tuple[float, bool]]:
    """Stated probabilities of the library's causes, and whether each of them acts."""
    own = set() if row["kind"] == DENIED else {*row["truth"]["sizes"], *row["truth"]["also"]}
    return [
        (float(probability), name in own)
        for name, (origin, probability) in row.get("stated", {}).items()
        if origin == EFFECT
    ]
