"""Hold an answer's ``report.json`` against the truth of a case."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from diffsim.diagnose.judge.records import CERTAIN, DATA_SHEET, EFFECT
from labs.rates.score import FAR_SHEET, SILENT
from labs.unlisted.catalog import LISTED, SOUND, UNLISTED

Report = Mapping[str, Any]
Truth = Mapping[str, Any]
REMOVED = 0.8  # share of the error above the noise that a good model removes


def scored(
    truth: Truth, report: Report, errors: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """What of an answer is right, in types that JSON has; None: it does not apply.

    Args:
        truth: Of the case, as ``truth.yaml`` has it.
        report: The answer; ``{"verdict": "failed"}`` where there is none.
        errors: Of its extended model on the unseen runs without noise; none without a model.
    """
    group, laws = truth["group"], _laws(report)
    hits = best_hits(truth, laws) if group == UNLISTED else {}
    gain = share_removed(errors)
    wrong = certain_and_wrong(truth, report)
    return {
        "verdict": report["verdict"],
        "said": _said(report),
        "place": hits.get("place"),
        "variable": hits.get("variable"),
        "form": hits.get("form"),
        "sizes": hits.get("sizes", {}),
        "num_laws": len(laws),
        "certain_and_wrong": wrong,
        "share_removed": gain if group != SOUND else None,
        "share_said": (report.get("gain") or {}).get("value", 0.0),
        "removed": gain >= REMOVED if group != SOUND else None,
        "false_find": is_false_find(truth, report) if group == SOUND else None,
        "false_name": bool(laws or report.get("named")) if group == SOUND else None,
        "name_kept": is_name_kept(truth, report) if group == LISTED else None,
        "extra_cpu_s": (report.get("described") or {}).get("cpu_s"),
    }


def share_removed(errors: Sequence[Mapping[str, Any]]) -> float:
    """Share of the plain model's squared error that is gone, each kind in its noise.

    Args:
        errors: On runs without noise: all of it is error above the noise.
    """
    before = sum(e["num_samples"] * (e["before"] / e["noise"]) ** 2 for e in errors)
    after = sum(e["num_samples"] * (e["after"] / e["noise"]) ** 2 for e in errors)
    return 1.0 - after / before if before else 0.0


def _laws(report: Report) -> list[Mapping[str, Any]]:
    return list((report.get("described") or {}).get("laws", []))


def best_hits(truth: Truth, laws: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Place, variable and form of the law that fits the truth best; all wrong without a law.

    Args:
        truth: Of the case.
        laws: Of the answer.
    """
    every = [hits_of(truth, law) for law in laws]
    none: dict[str, Any] = {"place": False, "variable": False, "form": False, "sizes": {}}
    return max(every, key=lambda h: (h["place"] + h["variable"], h["form"]), default=none)


def hits_of(truth: Truth, law: Mapping[str, Any]) -> dict[str, Any]:
    """Whether place, variable and form of a law are right, and its sizes beside the true ones.

    A form counts where place and variable are right, and a size where the form is, too.

    Args:
        truth: Of the case.
        law: Of the answer.
    """
    place = {"kind": law["entry"]["kind"], "target": law["entry"]["target"]} in truth["entry"]
    memory = law.get("memory")
    remembers = memory in truth["memory"] if truth["memory"] else memory is None
    names = {_plain(name) for name in law["variables"]}
    variable = remembers and any(names == set(own) for own in truth["variables"])
    is_found = place and variable
    form = is_found and law["form"] in truth["forms"]
    return {
        "place": place,
        "variable": variable,
        "form": form,
        "sizes": _held_numbers(truth["numbers"], law.get("numbers", {})) if form else {},
    }


def _plain(name: str) -> str:
    """A column's name without its unit: `temp [degC]` is temp."""
    return name.split("[")[0].split("(")[0].strip(" _`")


def _held_numbers(
    true: Mapping[str, float], said: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Numbers that truth and law both have; but for a threshold, signs depend on the writing."""
    out: dict[str, dict[str, Any]] = {}
    for name in true.keys() & said.keys():
        low, high, value = said[name]["low"], said[name]["high"], true[name]
        if low is None or high is None:
            continue
        mirrored = name != "threshold" and -high <= value <= -low
        inside = low <= value <= high or mirrored
        out[name] = {"true": value, "low": low, "high": high, "inside": inside}
    return out


def certain_and_wrong(truth: Truth, report: Report) -> list[str]:
    """What is said to be certain and is not: laws, causes of the library, data sheets.

    Args:
        truth: Of the case.
        report: The answer.
    """
    wrong = []
    for law in _laws(report):
        hits = hits_of(truth, law) if truth["group"] == UNLISTED else {}
        is_right = hits.get("place", False) and hits.get("variable", False)
        if law["status"] == CERTAIN and not is_right:
            wrong.append(f"law {law['name']}")
    bases = {row["name"]: row for row in report.get("base", [])}
    for cause in report.get("causes", []):
        name = cause["name"]
        if cause["status"] != CERTAIN or name in {law["name"] for law in _laws(report)}:
            continue
        if cause["origin"] == EFFECT and not _is_alike(name, truth):
            wrong.append(name)
        if cause["origin"] == DATA_SHEET and _is_far(truth, bases.get(name)):
            wrong.append(f"data sheet of {name}")
    return wrong


def _is_alike(name: str, truth: Truth) -> bool:
    """Whether a library's name, with its place or without, says what is hidden."""
    return any(name == own or name.startswith(f"{own}_") for own in truth.get("alike", []))


def _is_far(truth: Truth, base: Mapping[str, Any] | None) -> bool:
    """Whether the true number lies far outside of the interval of a finding."""
    if base is None or base["name"] not in truth["numbers_of_machine"]:
        return False
    half = 0.5 * (base["high"] - base["low"])
    middle = 0.5 * (base["high"] + base["low"])
    true = truth["numbers_of_machine"][base["name"]]
    return bool(abs(true - middle) > FAR_SHEET * half)


def is_false_find(truth: Truth, report: Report) -> bool:
    """Whether something is found where nothing is hidden; a data sheet's true error is not.

    Args:
        truth: Of the case.
        report: The answer.
    """
    if report["verdict"] in SILENT:
        findings = [row for row in report.get("base", []) if row["finding"]]
        return bool(_laws(report)) or any(_is_far(truth, row) for row in findings)
    return not (report["verdict"] == "ambiguous" and [] in report.get("rivals", []))


def is_name_kept(truth: Truth, report: Report) -> bool:
    """Whether a cause of the library is named, alone or among its rivals, and no law beside it.

    Args:
        truth: Of the case.
        report: The answer.
    """
    sets: Iterable[Sequence[str]] = (report.get("named", []), *report.get("rivals", []))
    is_said = any(len(names) == 1 and _is_alike(names[0], truth) for names in sets)
    return is_said and report["verdict"] in ("named", "ambiguous") and not _laws(report)


def _said(report: Report) -> str:
    """The answer in a few words."""
    laws = [
        f"{law['status']}: {law['entry']['kind']} {law['entry']['target']} of "
        f"{', '.join(law['variables'])}"
        + (f" ({law['memory']})" if law.get("memory") else "")
        + f", {law['form']}"
        for law in _laws(report)
    ]
    names = " + ".join(report.get("named", []))
    others = [" + ".join(s) or "none" for s in report.get("rivals", [])]
    rest = f"{names}" + (f" (or {'; '.join(others[:2])})" if others else "")
    return "; ".join([*laws, *([rest] if rest else [])]) or report.get("error", "")
