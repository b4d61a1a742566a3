"""Hold the answer to a sealed case against its label."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.identify.effect import Effect, effect_coordinates
from labs.blind.case import TWIN

ABSORBED = 3.0  # lambda: 4.5 nats, of which about 9 are needed to be seen


def score_answer(
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    effects: Sequence[Effect],
    sheets: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Verdict and sizes, without any simulation.

    Args:
        label: What was hidden.
        answer: Of ``blind_case``.
        effects: The whole library, with what this diagnosis was not given.
        sheets: Findings on data sheets beside the truth, as of ``held_sheets``; None: there are
            none, or nobody knows the truth.
    """
    known = {e.name: e for e in effects}
    truth = true_sizes(label, known)
    is_inside = None not in truth.values()
    kind = label["kind"]
    if kind in ("single", "pair", "twins", "confounded") and not is_inside:
        kind = "outside"  # the laboratory knows a cause that this library lacks
    sets = [sorted(s) for s in (answer.get("named", []), *answer.get("rivals", [])) if s]
    # a data sheet that is off, and said to be what it truly is: no cause, and no false alarm
    is_noise = answer["verdict"] == "none" or (
        answer["verdict"] == "data_sheet"
        and bool(sheets)
        and all(row["inside"] for row in (sheets or {}).values())
    )
    verdict, wanted = answer["verdict"], sorted(truth)
    in_set = verdict in ("named", "ambiguous") and wanted in sets
    # of sets that share what is named, the rest is open: only a foreign name is wrong then
    named, is_open = sorted(answer.get("named", [])), bool(answer.get("rivals"))
    is_wrong = not set(named) <= set(wanted) if is_open else named != wanted
    return {
        "kind": label["kind"],
        "scored_as": kind,
        "truth": {name: list(s) if s is not None else None for name, s in truth.items()},
        "decoys": label["decoys"],
        "verdict": verdict,
        "is_noise": is_noise,
        "sheets": {name: dict(row) for name, row in (sheets or {}).items()},
        "named": answer.get("named", []),
        "rivals": answer.get("rivals", []),
        "in_set": in_set,
        "alone": in_set and verdict == "named" and not is_open,
        "wrong_alone": verdict == "named" and is_wrong,
        "right": is_noise
        if kind in ("null", "decoy") and "scatter" not in label["decoys"]
        else _is_right(kind, label, answer, truth, in_set, sets, known),
        "class_given": _class_given(label, verdict, sets),
        "sizes": _sizes(truth, answer, known) if in_set else {},
        "gain": answer.get("gain"),
        "cpu_s": answer.get("cpu_s"),
        "error": answer.get("error"),
    }


def true_sizes(
    label: Mapping[str, Any], known: Mapping[str, Effect]
) -> dict[str, tuple[float, ...] | None]:
    """Hidden effects by the library's names; None where the library has none such.

    A laboratory's effect with several places is one effect per place in a library:
    ``weak_rotor: [0, 0.1, 0, 0]`` is weak_rotor_2.
    """
    out: dict[str, tuple[float, ...] | None] = {}
    for name, sizes in label["effects"].items():
        places = {f"{name}_{i + 1}": (s,) for i, s in enumerate(sizes) if s != 0.0}
        if name in known:
            out[name] = tuple(sizes)
        elif places and all(place in known for place in places):
            out |= places
        else:
            out[name] = None
    return out


def _is_right(
    kind: str,
    label: Mapping[str, Any],
    answer: Mapping[str, Any],
    truth: Mapping[str, Any],
    in_set: bool,
    sets: Sequence[Sequence[str]],
    known: Mapping[str, Effect],
) -> bool:
    verdict = answer["verdict"]
    if kind == "twins":
        (name,) = label["effects"]
        return verdict == "ambiguous" and in_set and [TWIN.format(name)] in sets
    if kind in ("single", "pair", "confounded"):
        return in_set
    if kind == "look_alike":
        # accepted: alternatives of what was left out, or honestly unknown
        family = {known[name].family for name in truth if name in known}
        named = {n for s in sets for n in s}
        mimics = bool(named) and all(n in known and known[n].family in family for n in named)
        return verdict == "unknown" or (verdict in ("named", "ambiguous") and mimics)
    if kind == "invisible":
        blind = {name.split(".")[0] for name in answer.get("cannot_see", {})}
        return verdict == "none" and blind >= set(truth)
    if kind == "decoy" and "scatter" in label["decoys"]:
        return verdict == "unrepeatable"
    return verdict == {"outside": "unknown", "numerical": "numerical"}.get(kind, "none")


def _class_given(
    label: Mapping[str, Any], verdict: str, sets: Sequence[Sequence[str]]
) -> bool | None:
    if "class" not in label:
        return None
    return verdict == "ambiguous" and {n for s in sets for n in s} >= set(label["class"])


def _sizes(
    truth: Mapping[str, tuple[float, ...] | None],
    answer: Mapping[str, Any],
    known: Mapping[str, Effect],
) -> dict[str, Any]:
    """By component: true, reported value and its 90 % interval, whether the truth is inside."""
    out = {}
    for name, sizes in truth.items():
        effect, found = known[name], answer["intervals"].get(name)
        if not found or sizes is None or len(sizes) != len(effect.components):
            continue
        pairs = zip(effect_coordinates([effect]), effect.components, sizes, strict=True)
        for coordinate, component, true in pairs:
            value, low, high = found[component]
            out[coordinate] = {
                "true": true,
                "found": value,
                "low": low,
                "high": high,
                "inside": low <= true <= high,
            }
    return out


def with_strength(score: Mapping[str, Any]) -> dict[str, Any]:
    """The score, where what the library lacks turned out to be absorbed by the base parameters.

    With a lambda below ``ABSORBED`` nothing is missing from the fitted model: to say so is right.
    """
    strength = max(score.get("lambda", {}).values(), default=np.inf)
    if score["scored_as"] in ("outside", "look_alike") and strength < ABSORBED:
        return {**score, "scored_as": "absorbed", "right": score["verdict"] == "none"}
    return dict(score)
