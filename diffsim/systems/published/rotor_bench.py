"""Motors with propellers on a thrust stand, published sweeps."""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.bench.effects import BENCH
from diffsim.systems.bench.model import bench_model


def setup(study: Study, *, max_effects: int = 6) -> DiagnosisSetup:
    """Quadratic rotors and everything a stand may do to their readings.

    Args:
        study: Study from ``import_study("rotor_bench")`` or ``import_study("rotor_drive")``.
        max_effects: Largest number of effects in one set; two quantities, each with causes of its
            own, need more than three.
    """
    return DiagnosisSetup(
        bench_model(study.runs, [c.name.removeprefix("scaled_") for c in study.channels]),
        BENCH,
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
