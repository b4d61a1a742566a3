"""Description of a system for the diagnosis: a record that systems fill."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.law import LAWS, Entry, Gains, Law, Variable, numbers_of
from diffsim.identify.model import SimModel
from diffsim.identify.problem import Problem
from diffsim.identify.unknown import Unknown


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class DiagnosisSetup:
    """Model, candidate causes and options that ``diagnose`` takes beside the study.

    Attributes:
        model: Model of the recorded system, without effects.
        effects: Candidate causes of a misfit.
        unknowns: Generic causes of this system; drifts of channels are added by ``diagnose``.
        bank: Runs that could be recorded next.
        settings: Effort of the diagnosis, such as the largest set and the derivatives.
        laws: Where laws that nobody listed may enter; None: the system offers nothing.
        study: Study to diagnose, where a setup cuts or combines the recordings; None: the study as
            recorded.
    """

    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...] = ()
    bank: tuple[Run, ...] = ()
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    laws: LawPort | None = None
    study: Study | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class LawPort(ABC):
    """What a system offers to laws that nobody listed."""

    model: SimModel  # plain model
    study: Study  # study with the recordings as the system cuts it
    whole: Study  # study as it was recorded, with the runs to test by
    # function (study) -> setup, of a study whose frame holds laws
    make: Callable[[Study], DiagnosisSetup]

    @property
    @abstractmethod
    def entries(self) -> Sequence[Entry]:
        """Places where a term may be added."""

    @abstractmethod
    def variables(self) -> Sequence[Variable]:
        """What a term may depend on."""

    def drives(self, run: Run, most_knots: int) -> Sequence[Effect]:
        """Free courses over a run, by which its simulation can be led along the recording; a
        component for each knot, at most so many in all."""
        return ()

    @abstractmethod
    def gains(self, problem: Problem, x: Array, entry: Entry) -> Gains | None:
        """What a unit at an entry does along the simulation of a problem's one run at a point;
        None where terms must be simulated for that."""

    @abstractmethod
    def courses(self, problem: Problem, x: Array, variables: Sequence[Variable]) -> list[Array]:
        """Variables as a problem simulates them at a point, (num_samples, num_variables) for each
        of its runs."""

    @abstractmethod
    def terms(
        self, entry: Entry, variable: Variable, terms: Sequence[str], name: str, typical: float
    ) -> Effect:
        """An effect whose components are the factors of terms, formulas of ``u``.

        Args:
            entry: Where the sum of the terms is added.
            variable: What ``u`` is.
            typical: Factor that would be no surprise.
        """

    @abstractmethod
    def action(self, law: Law) -> Mapping[str, Any]:
        """Where a law acts and how, in the keys of a user's own cause."""

    def block(self, law: Law) -> Mapping[str, Any]:
        """A law as a user would write it under ``effects.own``."""
        return {
            "name": law.name,
            **self.action(law),
            "shapes": {name: numbers_of(s) for name, s in law.shapes.items()},
            "typical": law.typical,
            "unit": law.unit,
            "one_sided": not law.signed,
            "scanned": True,
            "family": "law",
            "price": law.price,
        }

    def made_by(self, make: Callable[[Study], DiagnosisSetup], study: Study) -> LawPort:
        """The same for a study of more runs, whose setup another function makes."""
        return replace(self, make=make, whole=study)

    def setup_with(self, blocks: Sequence[Mapping[str, Any]]) -> DiagnosisSetup:
        """The system with laws among its candidate causes."""
        frame = {**self.whole.frame, **self.model.frame, LAWS: [dict(b) for b in blocks]}
        return self.make(replace(self.whole, frame=frame))


def law_effect(
    name: str, entry: Entry, num_terms: int, typical: float, apply: Callable[..., Any]
) -> Effect:
    """A law without a form, whose components are the factors of its terms."""
    return Effect(
        name=name,
        family="law",
        kind="force",
        unit=entry.unit,
        typical=typical,
        components=tuple(f"term_{k}" for k in range(num_terms)),
        apply=apply,
    )
