"""An acrylic cube tossed onto a board, published recordings."""

from __future__ import annotations

from dataclasses import replace

from diffsim.data.study import Run, Study
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.rigid_body.description import RigidBodyDescription
from diffsim.systems.rigid_body.layout import REST
from diffsim.systems.rigid_body.windows import Poses, start_facts

_MODEL = {
    "system": "rigid_body",
    "bodies": [{"name": "cube", "box": ["104.8 mm"], "mass": "0.37 kg"}],
    "contacts": [
        {
            "between": ["cube", "ground"],
            "restitution": {"value": 0.125, "percent": 50, "upper": 1.0},
            "friction": {"value": 0.18, "percent": 50},
        }
    ],
    "window": {"until": "touch", "near": "3 mm", "rest_frames": 10},
    "measures": [
        {"body": "cube", "position": {"x": "x_m", "y": "y_m", "z": "z_m"}},
        {"body": "cube", "quaternion": ["qw", "qx", "qy", "qz"]},
    ],
}


def setup(study: Study) -> DiagnosisSetup:
    """A rigid cube in flight, and through its first impact where that was recorded.

    Args:
        study: Study from ``import_study("cube_toss")``, which has cut the tosses already.
    """
    return RigidBodyDescription.model_validate(_MODEL).setup_of_cut(_with_starts(study))


def _with_starts(study: Study) -> Study:
    channels = (*study.channels[:-1], replace(study.channels[-1], name=REST))
    return replace(study, channels=channels, runs=tuple(_with_start(r) for r in study.runs))


def _with_start(run: Run) -> Run:
    poses = Poses(run.measured[:, :3], run.measured[:, 3:7])
    return replace(run, setup={**start_facts(run, poses, 9.81), **run.setup})
