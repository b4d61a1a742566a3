"""Description of a system for the diagnosis: a record that systems fill."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown

if TYPE_CHECKING:
    from diffsim.identify.law import LawPort


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
