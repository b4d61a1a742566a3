"""An acrylic cube tossed onto a board, published recordings."""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.rigid_body.effects import TOSS
from diffsim.systems.rigid_body.model import TossModel


def setup(study: Study, *, max_effects: int = 4) -> DiagnosisSetup:
    """A rigid cube in flight, and through its first impact where that was recorded.

    Args:
        study: Study from ``import_study("cube_toss")``.
        max_effects: Largest number of effects in one set: flight, impact and cameras each have
            causes of their own.
    """
    return DiagnosisSetup(
        TossModel(study.runs, study.channels),
        TOSS,
        settings=DiagnosisSettings(
            search=SearchSettings(
                max_effects=max_effects,
                num_refits=2,
                max_rounds=2 * max_effects,
                rival_nats=5.0,
                unknown_steps=1,  # drifts of each run are many columns
            )
        ),
    )
