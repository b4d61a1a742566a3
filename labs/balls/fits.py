"""Fits of two balls in one video, soft ones and rigid ones; clicks calibrate the camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from diffsim.causes.listing import list_causes
from diffsim.data.study import Run, Study
from diffsim.identify import Parameter
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.rigid_body.ball_setup import Balls
from diffsim.systems.rigid_body.camera import (
    HEIGHT_PX,
    WIDTH_PX,
    on_plane,
    plain_camera,
    projected,
)
from diffsim.systems.rigid_body.description import RigidBodyDescription
from labs.balls.soft import SoftBallModel, SoftBalls

Array = NDArray[np.float64]


def setup(study: Study) -> DiagnosisSetup:
    """Plain: balls that glide without loss and rebound with a restitution.

    The camera is that of the authors with wide priors, the corners are fitted with the balls.

    Args:
        study: Study as imported, which holds clicks beside the balls.
    """
    described = RigidBodyDescription.model_validate(_build_description(study))
    balls = described.described
    assert isinstance(balls, Balls)
    model = balls.model(study, {r.name: _get_corners(r) for r in study.runs})
    settings = DiagnosisSettings(search=SearchSettings(max_effects=6))
    causes = list_causes(described.plant(study))
    return DiagnosisSetup(model, causes, settings=settings)


def _build_description(study: Study) -> dict[str, Any]:
    rotation, camera = camera_prior(study)
    shift = [{"value": p.value, "sd": p.sd} for p in camera[-3:]]

    def known(value: float, sd: float) -> dict[str, float]:
        return {"value": value, "sd": sd}

    return {
        "system": "rigid_body",
        "bodies": [
            {
                "name": "struck",
                # rules of the game: 65.4 to 68.6 mm, felt included
                "sphere": known(_get_diameter(study), 0.001),
                "inertia_ratio": 0.52,
                "begins": "at_rest",
                "start": {"place": [known(0.5275, 0.02), known(0.2875, 0.02)]},
            },
            {
                "name": "coming",
                "like": "struck",
                "begins": "on_ground",
                "start": {
                    "place": [known(0.773, 0.02), known(0.291, 0.02)],
                    "velocity": [known(-1.2, 0.2), known(0.17, 0.1)],
                    "roll": [known(-1.0, 0.3), known(0.17, 0.2)],
                },
            },
        ],
        "contacts": [
            {
                "between": ["struck", "coming"],
                "restitution": {"value": 0.75, "sd": 0.15, "lower": 0.0, "upper": 1.0},
            }
        ],
        "starts": {"per": "once"},
        "camera": {
            "size": list(_get_picture_size(study)),
            "focal": {"value": camera[0].value, "percent": 15.0},
            "rotation": rotation.tolist(),
            "shift": shift,
        },
        "measures": [
            {"body": "struck", "pixels": ["ball0_u_px", "ball0_v_px"]},
            {"body": "coming", "pixels": ["ball1_u_px", "ball1_v_px"]},
        ],
    }


def _get_corners(run: Run) -> Array:
    return np.column_stack([run.command[f"corner_{a}_m"] for a in "xyz"])


def soft_model(
    study: Study, *, steps: int = 3, subdivisions: int = 2, radial: bool = False
) -> SoftBallModel:
    """The thesis's balls: soft, on an exact table, pushing each other through their centers.

    Args:
        study: Study as imported, or read from a video.
        steps: Number of time steps per frame.
        subdivisions: Subdivisions of the balls' icosahedra, see :class:`SoftBalls`.
        radial: Fit a radial distortion of the lens too.
    """
    rotation, camera = camera_prior(study)
    camera = calibrated(study, camera, rotation)
    base = [
        *camera,
        *motion_prior(study, camera, rotation),
        Parameter("pair_stiffness", 3000.0, 0.7, "N/m", log=True),
        Parameter("ball_friction", 0.1, 0.1, "-", lower=0.0),
        Parameter("table_friction", 0.25, 0.4, "-", log=True),
        Parameter("youngs_modulus", 4e5, 1.0, "Pa", log=True),
        *([Parameter("radial", 0.0, 0.1, "-")] if radial else []),
    ]
    setup = study.runs[0].setup
    balls = SoftBalls(
        0.5 * setup["ball_diameter_m"],
        setup["ball_mass_kg"],
        steps=steps,
        subdivisions=subdivisions,
        frame_s=float(np.median(np.diff(study.fit_runs[0].time_s))),
    )
    return SoftBallModel(base, torch.from_numpy(rotation), balls, _get_picture_size(study))


def camera_prior(study: Study) -> tuple[Array, list[Parameter]]:
    """Rotation (3, 3) of the first guess, and the camera's parameters about it."""
    meta = study.metadata
    camera: dict[str, Any] = meta.get("camera") or meta["camera_by_authors"]
    base = [
        Parameter("focal", float(camera["alpha_px"]), 0.15, "px", log=True),
        *(Parameter(f"turn_{a}", 0.0, 0.1, "rad") for a in "xyz"),
        *(
            Parameter(f"shift_{a}", float(t), 0.1, "m")
            for a, t in zip("xyz", camera["T_m"], strict=True)
        ),
    ]
    return np.array(camera["R"], dtype=np.float64), base


def calibrated(study: Study, camera: list[Parameter], rotation: Array) -> list[Parameter]:
    """The same parameters about the values that suit the clicked corners, each good to 1 px."""
    run = study.fit_runs[0]
    clicks = run.measured[:, 4:]
    clicked = np.isfinite(clicks[:, 0])
    corners = np.column_stack([run.command[f"corner_{a}_m"] for a in "xyz"])[clicked]
    places, turned = torch.from_numpy(corners), torch.from_numpy(rotation)

    plain = plain_camera(_get_picture_size(study))

    def values_at(q: Array) -> dict[str, Tensor]:
        return {p.name: p.value_at(torch.tensor(x)) for p, x in zip(camera, q, strict=True)}

    def misfit(q: Array) -> Array:
        seen = projected({**plain, **values_at(q)}, turned, places).numpy()
        return np.concatenate([(seen - clicks[clicked]).ravel(), q])

    solution = least_squares(misfit, np.zeros(len(camera))).x
    return [replace(p, value=float(values_at(solution)[p.name])) for p in camera]


def motion_prior(study: Study, camera: list[Parameter], rotation: Array) -> list[Parameter]:
    """Where the balls are in the first picture by the camera's first guess, and how fast ball 1
    comes, by a parabola through its first ten places. It rolls, but for what the prior leaves open.
    """
    run = study.fit_runs[0]
    values = {p.name: torch.tensor(p.value, dtype=torch.float64) for p in camera}
    height = 0.5 * _get_diameter(study)
    pixels = torch.from_numpy(run.measured[:10, :4].reshape(-1, 2, 2))
    plain = {**plain_camera(_get_picture_size(study)), **values}
    places = on_plane(plain, torch.from_numpy(rotation), pixels, height).numpy()
    seen = np.isfinite(places).all((1, 2))
    if seen.sum() < 3:
        raise ValueError(
            f"run {run.name}: both balls are seen in {seen.sum()} of the first ten pictures, "
            "expected three or more before they meet; start the track earlier"
        )
    bend = 2 if seen.sum() > 5 else 1  # the ball slows down
    time_s = run.time_s[:10][seen] - run.time_s[0]
    slope = np.polyfit(time_s, places[seen, 1], bend)[-2]  # at the start
    (x0, y0), (x1, y1) = places[seen][0]
    return [
        *(Parameter(n, float(v), 0.01, "m") for n, v in zip(("x0", "y0"), (x0, y0), strict=True)),
        *(Parameter(n, float(v), 0.01, "m") for n, v in zip(("x1", "y1"), (x1, y1), strict=True)),
        Parameter("vx1", float(slope[0]), 0.2, "m/s"),
        Parameter("vy1", float(slope[1]), 0.1, "m/s"),
        Parameter("wx1", float(slope[0]), 0.3, "m/s"),
        Parameter("wy1", float(slope[1]), 0.2, "m/s"),
    ]


def _get_picture_size(study: Study) -> tuple[float, float]:
    width, height = study.metadata.get("size_px", (WIDTH_PX, HEIGHT_PX))
    return float(width), float(height)


def _get_diameter(study: Study) -> float:
    return float(study.runs[0].setup["ball_diameter_m"])


__all__ = ["camera_prior", "motion_prior", "setup", "soft_model"]
