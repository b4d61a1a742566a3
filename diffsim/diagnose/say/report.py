"""The answer of a diagnosis: the verdict in sentences with its evidence, ready to be saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.data.study import USES, Study
from diffsim.diagnose.checks.noise import ArWhitener
from diffsim.diagnose.judge.apart import ApartRow
from diffsim.diagnose.judge.band import Band
from diffsim.diagnose.judge.data_sheet import ranges_of_answer
from diffsim.diagnose.judge.frozen import facts_of
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import OwnRow
from diffsim.diagnose.judge.records import BaseRow, ErrorRow, OutsideRow
from diffsim.diagnose.say.force_map import ForceMap
from diffsim.diagnose.say.law_records import LawAnswer
from diffsim.diagnose.say.next_run import NextRun
from diffsim.diagnose.say.tables import EffectRow, HypothesisRow
from diffsim.diagnose.say.wording import Answer
from diffsim.diagnose.search.evidence import Screen
from diffsim.identify import Fit
from diffsim.identify.extended import extended_model
from diffsim.identify.model import SimModel
from diffsim.identify.model_file import MODEL_FILE, save_extended
from diffsim.identify.ranges import Range


@dataclass(frozen=True, eq=False, kw_only=True)
class Report(Answer):
    """The verdict with its evidence.

    Attributes:
        sentences: The verdict in words, with numbers and units.
        hypotheses: Sets of effects by evidence, best first.
        table: Candidate causes by evidence, best first.
        screened: Scores of all candidates at the plain model.
        cannot_see: Effect or component -> why, or the smallest visible size.
        num_spikes: Samples that were taken out as spikes.
        num_misread: Jumps of measured commands that were taken out.
        gain: Gain of the extended model on test runs; None without such runs.
        next_run: Advice, None if no bank of commands was given.
        force_map: Where and when a force is missing; None without an ``UnknownForce``.
        settings: Thresholds, seed and versions that decided the answer.
        null, best: Fits of the plain model and of the best set.
        study, model: Study and model as given.
        headline: The answer in at most 25 plain words, with the error on unseen runs before and
            after in the recordings' own unit.
        base: Base parameters: fitted value, data sheet, and how far apart they are.
        errors: Error before and after on every test run, by kind of channel.
        outside: Where test runs lie outside of what was fitted.
        own: What was fitted to test runs for the extended model, with its prior.
        unknown_share: Share of the misfit above the noise that no named cause explains.
        interval_factor: How many times wider the widest interval is than noise alone makes it.
        band: What bands of unseen runs are made from; None: nothing tells of them.
        bands: Half of the width of the band by unseen run, (num_samples, num_channels) [unit of the
            channel].
        described: Laws that nobody listed, and the table that they were chosen from; None: they
            were not looked for.
        apart: Numbers that groups of runs have of their own, and how far they are apart.
    """

    hypotheses: tuple[HypothesisRow, ...]
    table: tuple[EffectRow, ...]
    screened: Screen
    cannot_see: Mapping[str, str]
    num_spikes: int
    num_misread: int = 0
    gain: Gain | None
    settings: Mapping[str, Any]
    null: Fit
    best: Fit
    study: Study
    model: SimModel
    next_run: NextRun | None = None
    force_map: ForceMap | None = None
    headline: str = ""
    sentences: tuple[str, ...] = ()
    base: tuple[BaseRow, ...] = ()
    errors: tuple[ErrorRow, ...] = ()
    outside: tuple[OutsideRow, ...] = ()
    own: tuple[OwnRow, ...] = ()
    unknown_share: float | None = None
    interval_factor: float = 1.0
    band: Band | None = None
    bands: Mapping[str, Array] = field(default_factory=dict)
    described: LawAnswer | None = None
    apart: tuple[ApartRow, ...] = ()

    @property
    def chi2_null(self) -> float:
        """Misfit |W (y - S)|^2 of the plain model on the fitted runs."""
        return self.null.chi2

    @property
    def chi2_best(self) -> float:
        """The same with the best set."""
        return self.best.chi2

    @property
    def num_samples(self) -> int:
        """Number of samples of the fitted runs."""
        return self.null.num_samples

    @property
    def confounding_names(self) -> tuple[str, ...]:
        """Components, in the order of ``confounding``."""
        return self.screened.names

    @property
    def confounding(self) -> Array:
        """(n, n) cosines between what base parameters cannot absorb."""
        return self.screened.confounding

    @property
    def noise(self) -> dict[str, Any]:
        """Source of the noise floor, sd by channel, repeat scatter over sensor noise, spikes."""
        names = [channel.name for channel in self.study.channels]
        return {
            "sd": dict(zip(names, self.floor.sd.tolist(), strict=True)),
            "source": self.floor.source,
            "scatter_ratio": self.floor.scatter_ratio,
            "num_spikes": self.num_spikes,
            "num_misread": self.num_misread,
        }

    @property
    def findings(self) -> tuple[str, ...]:
        """Base parameters that ended beyond the limit of their row, 3 prior sd or more."""
        return tuple(row.name for row in self.base if row.finding)

    def extended_model(self) -> SimModel:
        """The model with the named effects; base parameters and sizes at their posterior."""
        return extended_model(self.best)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the fits' matrices and the recordings, in types that JSON has."""
        left_out = {"decision", "floor", "best_names", "beside", "drives", "is_full"}
        left_out |= {"screened", "num_spikes", "num_misread", "bands"}
        own = (name for name in self.__dataclass_fields__ if name not in left_out)
        more = ("chi2_null", "chi2_best", "num_samples", "confounding_names", "confounding")
        first = ("headline", "verdict")  # before the tables: of a long file, lists read the head
        names = (*first, *own, *more, "noise", "findings")
        plain = {name: getattr(self, name) for name in names}
        plain["band"] = None if self.band is None else self.band.to_dict()
        plain["study"], plain["model"] = self.study.name, self.model.name
        plain["runs"] = {use: [r.name for r in self.study.runs_for(use)] for use in USES}
        for name in ("null", "best"):
            plain[name] = fit_to_dict(getattr(self, name))
        return to_plain(plain)

    @checked
    def save(self, folder: str | Path) -> Path:
        """Write report.json and extended_model.yaml.

        Returns:
            ``folder``.
        """
        folder = Path(folder)
        write_json_atomic(folder / "report.json", self.to_dict())
        save_model(
            self.best,
            self.null,
            folder,
            study=self.study,
            verdict=self.verdict,
            band=self.band,
            ranges=ranges_of_answer(self.best, self.base, self.causes),
        )
        return folder

    @property
    def shared(self) -> tuple[str, ...]:
        """Parameters and causes of the extended model that are one number for all runs."""
        told = [row.name for row in self.base if row.is_told and row.run is None]
        sizes = [e.name for e in self.best.problem.effects if len(e.components) == 1]
        return (*(name for name in told if "[" not in name), *sizes)


def save_model(
    best: Fit,
    null: Fit,
    folder: Path,
    *,
    study: Study,
    verdict: str,
    band: Band | None,
    ranges: Mapping[str, Range],
) -> Path:
    """Write extended_model.yaml with all that judging new runs needs.

    Args:
        null: Fit of the plain model to the same runs.
        band: What bands of unseen runs are made from.
        ranges: 90 % intervals of parameters and sizes, by name, each in its unit.
    """
    noise = null.problem.whitener
    facts = facts_of(study, noise, band) if isinstance(noise, ArWhitener) else None
    return save_extended(
        best,
        folder / MODEL_FILE,
        study=study,
        verdict=verdict,
        plain=null,
        facts=facts,
        ranges=ranges,
    )


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
