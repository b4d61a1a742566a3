"""The pneumatic arm as one bending mode: a chamber that bends it in proportion to the set pressure.

A soft-body simulation of the whole record takes minutes per fit; the reduced model keeps what the
markers of the end show (arc, rotation, lengthening) and one mode.
"""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify import Parameter
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.model import SimModel
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.bending.arc import calibrated_arc
from diffsim.systems.bending.effects import BENDING_EFFECTS
from diffsim.systems.bending.scene import PRESSURE_UNIT, STEP, Layout, bending_scene
from diffsim.systems.bending.unknown import unknown_moment

LENGTH = 0.104  # [m] clamped end to the plane of the tip markers, at rest
CENTER_TOWARD = 0.0158  # [m] nominal places of the tip markers
KNOTS_PER_S = 8.0  # of the unknown moment
LAYOUT = Layout(axes=(0, 1, 2), moving=3, command="set_pressure_Pa", unit=PRESSURE_UNIT)


def setup(study: Study, *, max_effects: int = 4) -> DiagnosisSetup:
    """Plain: bending angle in proportion to the set pressure, which is there at once.

    Args:
        study: Study of one of the two campaigns.
        max_effects: Largest number of effects in one set.
    """
    arc = calibrated_arc(study.fit_runs, LAYOUT.axes, length=LENGTH, center_toward=CENTER_TOWARD)
    base = [
        # seen after the release, without any model: 8.3 Hz, each period 0.62 of the last
        Parameter("frequency", 8.3, 0.03, "Hz", log=True, lower=7.9, upper=8.7),
        Parameter("damping_ratio", 0.075, 0.2, "-", log=True, lower=0.05, upper=0.11),
        Parameter("gain", 0.7, 0.7, "rad/(100 kPa)", log=True),
        Parameter("slow_time", 1.0, 0.7, "s", log=True),
    ]
    for run in study.runs:
        # the moments of the valve, known from the motion seen only
        base += [
            Parameter(f"onset@{run.name}", 0.0, 0.015, "s"),
            Parameter(f"release@{run.name}", 0.0, 0.015, "s"),
        ]
    model = SimModel(
        lambda values, run, numerics: bending_scene(
            values, run, LAYOUT, arc, STEP * numerics.time_step
        ),
        base,
        "arm of one bending mode, moment in proportion to the pressure",
        batched=True,
    )
    settings = DiagnosisSettings(search=SearchSettings(max_effects=max_effects, num_refits=3))
    unknown = unknown_moment(study.runs, KNOTS_PER_S)
    return DiagnosisSetup(model, BENDING_EFFECTS, (unknown,), settings=settings)


__all__ = ["setup"]
