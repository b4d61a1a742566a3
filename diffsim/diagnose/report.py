"""The answer of a diagnosis: the verdict in sentences with its evidence, ready to be saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.files import to_plain, write_json_atomic
from diffsim.data.study import Study
from diffsim.diagnose.force_map import ForceMap
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.gates import NUMERICS_GATES, REPEATS, GateResult
from diffsim.diagnose.judge import EXPLAINED, Decision
from diffsim.diagnose.next_run import NextRun
from diffsim.diagnose.noise import NoiseFloor
from diffsim.diagnose.records import BaseRow, CauseRow, ErrorRow, OutsideRow
from diffsim.diagnose.tables import EffectRow, HypothesisRow
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.extended import extended_model
from diffsim.identify.model import SimModel
from diffsim.identify.model_file import MODEL_FILE, save_extended
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]

VERDICTS = ("none", "named", "ambiguous", "unknown", "unrepeatable", "numerical")
MAX_RIVALS = 3  # rival sets in a sentence; the page lists all
Z90 = 1.645  # half-width of a 90 % interval in standard deviations


@dataclass(frozen=True, eq=False)
class Report:
    """The verdict with its evidence.

    Attributes:
        verdict: One of ``VERDICTS``.
        sentences: The verdict in words, with numbers and units.
        named: Effects of the best set; empty unless "named" or "ambiguous".
        rivals: Sets within 3 nats of it, each a tuple of effect names; a generic unknown cause
            stands as "unknown force" or the like.
        hypotheses: Sets of effects by evidence, best first.
        table: Candidate causes by evidence, best first.
        confounding_names: Components, in the order of ``confounding``.
        confounding: (n, n) cosines between what base parameters cannot absorb.
        cannot_see: Effect or component -> why, or the smallest visible size.
        gates: Checks of data, gradients and numerics.
        noise: Source of the noise floor, sd by channel, repeat scatter over sensor noise.
        gain: Gain of the best set on held-out runs; None without such runs.
        chi2_null, chi2_best, num_samples: Misfit |W (y - S)|^2 without and with the best set, and
            the number of samples, of the runs fitted.
        next_run: Advice, None if no bank of commands was given.
        force_map: Where and when a force is missing; None without an ``UnknownForce``.
        settings: Thresholds, seed and versions that decided the answer.
        null, best: Fits of the plain model and of the best set.
        study, model: Study and model as given.
        headline: The answer in at most 25 plain words, with the error on unseen runs before and
            after in the recordings' own unit.
        causes: Every candidate cause with its status, probability and size.
        findings: Base parameters that ended beyond 3 standard deviations of the data sheet.
        base: Base parameters: fitted value, data sheet, and how far apart they are.
        errors: Error before and after on every test run, by kind of channel.
        outside: Where test runs lie outside of what was fitted.
        unknown_share: Share of the misfit above the noise that no named cause explains.
        interval_factor: How many times wider the widest interval is than noise alone makes it.
        chosen_by: What chose between causes: "select runs", "leaving out one group of fit runs
            after the other", "leaving out blocks of 2.5 s".
    """

    verdict: str
    sentences: tuple[str, ...]
    named: tuple[str, ...]
    rivals: tuple[tuple[str, ...], ...]
    hypotheses: tuple[HypothesisRow, ...]
    table: tuple[EffectRow, ...]
    confounding_names: tuple[str, ...]
    confounding: Array
    cannot_see: Mapping[str, str]
    gates: tuple[GateResult, ...]
    noise: Mapping[str, Any]
    gain: Gain | None
    chi2_null: float
    chi2_best: float
    num_samples: int
    settings: Mapping[str, Any]
    null: Fit
    best: Fit
    study: Study
    model: SimModel
    next_run: NextRun | None = None
    force_map: ForceMap | None = None
    headline: str = ""
    causes: tuple[CauseRow, ...] = ()
    findings: tuple[str, ...] = ()
    base: tuple[BaseRow, ...] = ()
    errors: tuple[ErrorRow, ...] = ()
    outside: tuple[OutsideRow, ...] = ()
    unknown_share: float | None = None
    interval_factor: float = 1.0
    chosen_by: str = ""

    def extended_model(self) -> SimModel:
        """The model with the named effects; base parameters and sizes at their posterior."""
        return extended_model(self.best)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the fits' matrices and the recordings, in types that JSON has."""
        plain = {
            name: getattr(self, name)
            for name in self.__dataclass_fields__
            if name not in ("null", "best", "study", "model", "next_run", "gain", "force_map")
        }
        for name in ("hypotheses", "table", "gates", "causes", "base", "errors", "outside"):
            plain[name] = [asdict(row) for row in plain[name]]
        for name in ("next_run", "force_map", "gain"):
            value = getattr(self, name)
            plain[name] = None if value is None else asdict(value)
        plain["study"], plain["model"] = self.study.name, self.model.name
        for name in ("null", "best"):
            plain[name] = fit_to_dict(getattr(self, name))
        return to_plain(plain)

    def save(self, folder: str | Path) -> Path:
        """Write report.json and extended_model.yaml.

        Returns:
            ``folder``.
        """
        folder = Path(folder)
        write_json_atomic(folder / "report.json", self.to_dict())
        save_extended(self.best, folder / MODEL_FILE, study=self.study, verdict=self.verdict)
        return folder


def fit_to_dict(fit: Fit) -> dict[str, Any]:
    """A fit without its matrices but the correlations."""
    return {
        "values": dict(fit.values),
        "sd": dict(fit.sd),
        "names": list(fit.problem.names),
        "correlation": fit.correlation,
        "chi2": fit.chi2,
        "num_samples": fit.num_samples,
        "at_bound": fit.at_bound,
        "undetermined": fit.undetermined,
        "converged": fit.converged,
        "message": fit.message,
    }


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
        if not g.passed and g.name not in NUMERICS_GATES and not g.name.startswith(REPEATS)
    ]
    return tuple(out)


def _scatter(noise: NoiseFloor, gates: Sequence[GateResult]) -> str:
    """Scatter in the channels, else in what was fitted to each run."""
    if not noise.is_repeatable:
        return f"{np.nanmax(noise.scatter_ratio):.2g} times as much as the sensor noise"
    failed = [g for g in gates if g.name.startswith(REPEATS) and not g.passed]
    worst = max(failed, key=lambda g: g.value)
    return f"in {worst.name.removeprefix(REPEATS)} {worst.value:.2g} times as much as was stated"


def _failed_numerics(gates: Sequence[GateResult]) -> list[GateResult]:
    return [g for g in gates if not g.passed and g.name in NUMERICS_GATES]


def _sets(rivals: Sequence[tuple[str, ...]]) -> str:
    """The nearest rival sets in words, and how many more there are."""
    shown = " or ".join(" with ".join(r) for r in rivals[:MAX_RIVALS])
    more = len(rivals) - MAX_RIVALS
    return shown if more <= 0 else f"{shown}, or {more} more {'sets' if more > 1 else 'set'}"


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
