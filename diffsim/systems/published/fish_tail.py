"""The pneumatic fish tail as one bending mode, its one recording a step of unknown pressure."""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify import Parameter
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.model import SimModel
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.bending.effects import BENDING_EFFECTS
from diffsim.systems.bending.scene import Layout, bending_scene
from diffsim.systems.bending.unknown import unknown_moment

STEP = 0.001  # [s]
KNOTS_PER_S = 8.0  # of the unknown moment
LAYOUT = Layout(axes=(2, 1, 0), moving=1, command="pressure_share", unit=1.0)


def setup(study: Study, *, max_effects: int = 3) -> DiagnosisSetup:
    """Plain: the tail bends as an arc, driven at once by a pressure that stays.

    Nothing but one marker's path is known, so the arc's shape has wide priors.

    Args:
        study: Study as imported.
        max_effects: Largest number of effects in one set.
    """
    base = [
        Parameter("frequency", 7.0, 0.4, "Hz", log=True),
        Parameter("damping_ratio", 0.08, 0.5, "-", log=True, upper=0.5),
        Parameter("gain", 0.6, 0.5, "rad", log=True),
        # from the clamp to the marker, nominal place
        Parameter("length", 0.05221, 0.05, "m", log=True, lower=0.047, upper=0.058),
        Parameter("shape", 0.5, 0.05, "-", lower=0.4, upper=0.6),
        Parameter("direction", 0.0, 0.2, "rad"),
        Parameter("neutral_axis", 0.0, 0.005, "m", lower=-0.015, upper=0.015),
        Parameter("slow_time", 0.6, 0.7, "s", log=True),
        *(Parameter(f"onset@{run.name}", 0.0, 0.015, "s") for run in study.runs),
    ]
    # a single marker has no face to sit off
    known = {"center_toward": 0.0, "release": 0.0}
    model = SimModel(
        lambda values, run, numerics: bending_scene(
            values, run, LAYOUT, known, STEP * numerics.time_step
        ),
        base,
        "tail of one bending mode, pressure at once",
        batched=True,
    )
    settings = DiagnosisSettings(search=SearchSettings(max_effects=max_effects))
    unknown = unknown_moment(study.runs, KNOTS_PER_S)
    return DiagnosisSetup(model, BENDING_EFFECTS, (unknown,), settings=settings)


__all__ = ["setup"]
