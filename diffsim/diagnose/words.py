"""The verdict in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffsim.diagnose.decide import EXPLAINED, Decision
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.gate_result import GateResult
from diffsim.diagnose.noise import NoiseFloor
from diffsim.diagnose.repeatability import PREFIX
from diffsim.diagnose.report import EffectRow
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import Unknown

MAX_TOLD = 3  # rival sets in a sentence; the page lists all
Z90 = 1.645  # half-width of a 90 % interval in standard deviations


def sentences(
    decision: Decision,
    rows: Sequence[EffectRow],
    rivals: Sequence[tuple[str, ...]],
    gained: Gain | None,
    gates: Sequence[GateResult],
    noise: NoiseFloor,
    effects: Sequence[Effect],
    unknowns: Sequence[Unknown],
) -> tuple[str, ...]:
    """Two to five sentences with numbers and units."""
    members = [r for r in rows if r.effect in {effects[i].name for i in decision.best}]
    first = {
        "none": lambda: "The misfit is noise: no effect of the library pays for itself.",
        "named": lambda: f"The model lacks {_sizes(members)}.",
        "ambiguous": lambda: (
            f"The data ask for {_sizes(members)}, but cannot tell it from {_sets(rivals)}."
        ),
        "unknown": lambda: (
            "Something real and repeatable is missing that the library does not hold"
            + (f"; {_sizes(members)} would mimic part of it." if members else ".")
        ),
        "unrepeatable": lambda: (
            f"Repeats scatter {_scatter(noise, gates)}: the misfit is not a function of the "
            "command."
        ),
        "numerical": lambda: (
            "The numerical settings move the record by "
            + ", ".join(f"{g.value:.1f} noise sd ({g.name})" for g in _failed_numerics(gates))
            + ": refine them before any physics is blamed."
        ),
    }[decision.verdict]()
    out = [first]
    if decision.verdict in ("named", "ambiguous") and decision.share < EXPLAINED:
        out.append(
            f"That explains {decision.share:.0%} of the misfit; what is left is no cause that "
            "repeats and evidence single out."
        )
    if decision.beside is not None and decision.beside.unknown is not None:
        out.append(
            f"With an {unknowns[decision.beside.unknown].name} the evidence is "
            f"{decision.lead:.0f} nats better: the names carry most of the misfit, but the record "
            "holds more than the library does."
        )
    if gained is not None:
        out.append(
            f"On held-out runs this removes {gained.value:.0%} (90 %: {gained.low:.0%} to "
            f"{gained.high:.0%}) of the error above the noise: {gained.status}."
        )
    if np.isnan(noise.scatter_ratio).all():
        out.append("Repeatability was not judged: that needs repeats and a stated sensor noise.")
    out += [
        f"{g.name}: {g.value:g}, wanted {g.limit:g} ({g.note})."
        for g in gates
        if not g.passed
        and g.name not in ("time_step", "mesh", "tolerance")
        and not g.name.startswith(PREFIX)
    ]
    return tuple(out)


def _scatter(noise: NoiseFloor, gates: Sequence[GateResult]) -> str:
    """In the channels, else in what was fitted to each run."""
    if not noise.is_repeatable:
        return f"{np.nanmax(noise.scatter_ratio):.2g} times as much as the sensor noise"
    failed = [g for g in gates if g.name.startswith(PREFIX) and not g.passed]
    worst = max(failed, key=lambda g: g.value)
    return f"in {worst.name.removeprefix(PREFIX)} {worst.value:.2g} times as much as was stated"


def _failed_numerics(gates: Sequence[GateResult]) -> list[GateResult]:
    return [g for g in gates if not g.passed and g.name in ("time_step", "mesh", "tolerance")]


def _sets(rivals: Sequence[tuple[str, ...]]) -> str:
    """The nearest rival sets in words, and how many more there are."""
    told = " or ".join(" with ".join(r) for r in rivals[:MAX_TOLD])
    more = len(rivals) - MAX_TOLD
    return told if more <= 0 else f"{told}, or {more} more {'sets' if more > 1 else 'set'}"


def _sizes(rows: Sequence[EffectRow]) -> str:
    parts = []
    for row in rows:
        sizes = ", ".join(
            f"{'' if len(row.size) == 1 else c + ' '}{v:.3g} +- {Z90 * row.sd[c]:.2g}"
            for c, v in row.size.items()
        )
        unit = "" if row.unit == "-" else f" {row.unit}"
        parts.append(f"{row.effect} ({sizes}{unit})")
    return " and ".join(parts)
