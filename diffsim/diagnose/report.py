"""What a diagnosis found, ready to be read, saved, and simulated with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.files import to_plain, write_json_atomic
from diffsim.data.study import Study
from diffsim.diagnose.force_map import ForceMap
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.gate_result import GateResult
from diffsim.identify import Fit
from diffsim.identify.extended import extended_model
from diffsim.identify.model import SimModel
from diffsim.identify.model_file import MODEL_FILE, save_extended

Array = NDArray[np.float64]

VERDICTS = ("none", "named", "ambiguous", "unknown", "unrepeatable", "numerical")


@dataclass(frozen=True)
class EffectRow:
    """One candidate cause in the table.

    Attributes:
        effect, family, kind, unit: Of the effect.
        status: "named", "rival", "mimic" (explains part of an unknown cause), "withdrawn" (the
            evidence asked for it, held-out runs refuted it), "screened", or "not judged".
        size: By component, [unit]; from the refit where there was one, else from the screen.
        sd: Of the sizes: statistical, numerical (shift under refined settings) and 1 % model form.
        nats: Evidence of the best hypothesis with this effect minus that of the best without it.
        z: Score over its standard deviation at the null fit, the length for a vector.
        smallest_visible: By component, [unit]: 6 / sqrt(information).
        gain: On held-out runs, of having this effect in the best set; None if not computed.
        share: Of chi2_null - N that this effect alone explains; None if it was not refitted alone.
        aliases: What these data may not tell from it.
        note: Why it was not judged, or that its gain is not confirmed.
    """

    effect: str
    family: str
    kind: str
    unit: str
    status: str
    size: Mapping[str, float]
    sd: Mapping[str, float]
    nats: float | None
    z: float
    smallest_visible: Mapping[str, float]
    gain: Gain | None
    share: float | None
    aliases: tuple[str, ...]
    note: str = ""


@dataclass(frozen=True)
class HypothesisRow:
    """A set of effects, with or without a generic unknown cause.

    Attributes:
        effects: Names.
        unknown: Name of the generic cause, or None.
        nats: Evidence relative to the plain model.
        chi2: |W (y - S)|^2, after the unknown cause's part.
        refitted: False: linear evidence of a set that is too far behind to be refitted.
    """

    effects: tuple[str, ...]
    unknown: str | None
    nats: float
    chi2: float
    refitted: bool = True


@dataclass(frozen=True, eq=False)
class Report:
    """The verdict with its evidence.

    Attributes:
        verdict: One of ``VERDICTS``.
        sentences: The verdict in words, with numbers and units.
        named: Effects of the best set; empty unless "named" or "ambiguous".
        rivals: Sets within 3 nats of it, each a tuple of effect names; a generic unknown cause
            stands as "unknown force" or the like.
        hypotheses: By evidence, best first.
        table: By evidence, best first.
        confounding_names: Components, in the order of ``confounding``.
        confounding: (n, n) cosines between what base parameters cannot absorb.
        cannot_see: Effect or component -> why, or the smallest visible size.
        gates: Data, gradients, numerics.
        noise: Source of the noise floor, sd by channel, repeat scatter over sensor noise.
        gain: Of the best set on held-out runs, None without such runs.
        chi2_null, chi2_best, num_samples: Of the runs fitted.
        next_run: Advice, None if no bank of commands was given.
        force_map: Where and when a force is missing; None without an ``UnknownForce``.
        settings: Thresholds, seed, versions.
        null, best: Fits.
        study, model: As given.
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
    next_run: Mapping[str, Any] | None = None
    force_map: ForceMap | None = None

    def extended_model(self) -> SimModel:
        """The model with the named effects; base parameters and sizes at their posterior."""
        return extended_model(self.best)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the fits' matrices and the recordings, in types that JSON has."""
        plain = {
            name: getattr(self, name)
            for name in self.__dataclass_fields__
            if name not in ("null", "best", "study", "model", "gain", "force_map")
        }
        for name in ("hypotheses", "table", "gates"):
            plain[name] = [asdict(row) for row in plain[name]]
        plain["force_map"] = None if self.force_map is None else asdict(self.force_map)
        plain["gain"] = None if self.gain is None else asdict(self.gain)
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
