"""Two tennis balls in one video: frictionless balls, a pinhole camera that the clicks calibrate."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim.data.study import Study
from diffsim.diagnose.beds.balls.effects import BALL_EFFECTS
from diffsim.diagnose.beds.balls.scene import ball_scene
from diffsim.diagnose.model import SimModel
from diffsim.diagnose.search import SearchSettings
from diffsim.diagnose.setups import DiagnosisSetup
from diffsim.diagnose.stages import DiagnosisSettings
from diffsim.identify import Parameter


def setup(study: Study, *, max_effects: int = 6) -> DiagnosisSetup:
    """Plain: balls that glide without loss and rebound with a restitution.

    The camera is that of the authors with wide priors, the corners are fitted with the balls.

    Args:
        study: As imported.
        max_effects: In one set.
    """
    camera: dict[str, Any] = study.metadata["camera_by_authors"]
    rotation = np.array(camera["R"], dtype=np.float64)
    diameter = float(study.runs[0].setup["ball_diameter_m"])
    base = [
        Parameter("focal", float(camera["alpha_px"]), 0.15, "px", log=True),
        *(Parameter(f"turn_{a}", 0.0, 0.1, "rad") for a in "xyz"),
        *(
            Parameter(f"shift_{a}", float(t), 0.1, "m")
            for a, t in zip("xyz", camera["T_m"], strict=True)
        ),
        Parameter("x0", 0.5275, 0.02, "m"),
        Parameter("y0", 0.2875, 0.02, "m"),
        Parameter("x1", 0.773, 0.02, "m"),
        Parameter("y1", 0.291, 0.02, "m"),
        Parameter("vx1", -1.2, 0.2, "m/s"),
        Parameter("vy1", 0.17, 0.1, "m/s"),
        Parameter("wx1", -1.0, 0.3, "m/s"),
        Parameter("wy1", 0.17, 0.2, "m/s"),
        Parameter("sidespin", 0.0, 0.3, "m/s"),
        # rules of the game: 65.4 to 68.6 mm, felt included
        Parameter("diameter", diameter, 0.001, "m"),
        Parameter("restitution", 0.75, 0.15, "-", lower=0.0, upper=1.0),
    ]
    model = SimModel(
        lambda values, run, numerics: ball_scene(values, run, rotation),
        base,
        "two balls without friction, pinhole camera",
        batched=True,
    )
    effects = tuple(make() for make in BALL_EFFECTS)
    settings = DiagnosisSettings(search=SearchSettings(max_effects=max_effects))
    return DiagnosisSetup(model, effects, settings=settings)


__all__ = ["setup"]
