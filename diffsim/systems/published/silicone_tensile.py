"""Pull tests of casting silicones, published recordings."""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.tensile.effects import TENSILE
from diffsim.systems.tensile.model import pull_model


def setup(study: Study, *, max_effects: int = 4) -> DiagnosisSetup:
    """Neo-Hookean specimens and what a pull test may have beyond them.

    Args:
        study: Study from ``import_study("silicone_tensile")``.
        max_effects: Largest number of effects in one set.
    """
    return DiagnosisSetup(
        pull_model(study.runs),
        TENSILE,
        settings=DiagnosisSettings(search=SearchSettings(max_effects=max_effects)),
    )
