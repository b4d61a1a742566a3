"""All that a diagnosis is given beside the recorded runs: a record that systems fill."""

from __future__ import annotations

from dataclasses import dataclass, field

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown


@dataclass(frozen=True, eq=False)
class DiagnosisSetup:
    """What ``diagnose`` is given beside the study.

    Attributes:
        model: Of the recorded system.
        effects: Candidate causes.
        unknowns: Generic causes of this system; drifts of channels are added by ``diagnose``.
        bank: Runs that could be recorded next.
        settings: Effort.
        study: What is diagnosed, where a setup cuts or combines the recordings; None: as recorded.
    """

    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...] = ()
    bank: tuple[Run, ...] = ()
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    study: Study | None = None
