"""Description of a system for the diagnosis: a record that systems fill."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown


@dataclass(frozen=True, eq=False)
class DiagnosisSetup:
    """Model, candidate causes and options that ``diagnose`` takes beside the study.

    Attributes:
        model: Model of the recorded system, without effects.
        effects: Candidate causes of a misfit.
        unknowns: Generic causes of this system; drifts of channels are added by ``diagnose``.
        bank: Runs that could be recorded next.
        settings: Effort of the diagnosis, such as the largest set and the derivatives.
        remade: The same setup by the magnitudes that a saved model was made from (``made_from`` of
            its model), not by those of this study; None: it depends on no recording.
        study: Study to diagnose, where a setup cuts or combines the recordings; None: the study as
            recorded.
    """

    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...] = ()
    bank: tuple[Run, ...] = ()
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    remade: Callable[[Mapping[str, Any]], DiagnosisSetup] | None = None
    study: Study | None = None
