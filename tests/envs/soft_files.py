"""Small soft bodies as task files state them."""

from pathlib import Path
from typing import Any

import yaml

FISH = Path(__file__).parents[2] / "examples" / "learning" / "fish" / "fish.yaml"
HOVER = FISH.parents[1] / "copter" / "hover.yaml"


def finger(**changes: Any) -> dict[str, Any]:
    """A bar of four cells that two muscles bend, and whose tip shall reach a point."""
    half = {"direction": [1, 0, 0], "stiffness": 1e5, "command": "bend"}
    keys: dict[str, Any] = {
        "task": "SoftBody",
        "model": {
            "system": "soft_body",
            "body": {"bar": {"size": [0.08, 0.02, 0.02], "cells": [4, 1, 2]}},
            "material": {"youngs_modulus": "0.1 MPa", "density": 1000},
            "gravity": {"vector": [0, 0, 0]},
            "fixed": [{"x": 0}],
            "muscles": [
                {"name": "up", "where": {"z": [0.01, None]}, **half},
                {"name": "down", "gain": -1, "where": {"z": [None, 0.01]}, **half},
            ],
            "markers": {"tip": [0.08, 0.01, 0.01], "middle": [0.04, 0.01, 0.01]},
            "start": {"shape": "rest"},
            "numerics": {"time_step": 0.01, "tolerance": 1e-12, "correct_mesh": False},
        },
        "commands": {"bend": [-0.2, 0.2]},
        "goal": {"markers": "tip", "at": [0.07, 0.01, 0.04]},
        "reward": [{"term": "distance"}, {"term": "effort", "weight": 0.01}],
        "seconds": 0.1,
        "control_step": 0.02,
    }
    return {**keys, **changes}


def with_model(keys: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """The same task of a changed model."""
    return {**keys, "model": {**keys["model"], **changes}}


def block_on_floor() -> dict[str, Any]:
    """A free block on a floor that muscles bend."""
    keys = with_model(
        finger(),
        fixed=[],
        gravity={"vector": [0, 0, -9.81]},
        walls=[{"normal": [0, 0, 1], "friction": 0.5}],
        numerics={"time_step": 0.01, "tolerance": 1e-12, "integrator": "implicit_euler"},
    )
    terms = ["height", "upright", "alive", "change", "energy"]
    reward = [{"term": term} for term in terms]
    return {**keys, "reward": reward, "goal": None, "ends": {"tilt": "60 deg", "away": 0.5}}


def written(folder: Path, keys: dict[str, Any], name: str = "task.yaml") -> Path:
    """The task as a file."""
    path = folder / name
    path.write_text(yaml.safe_dump(keys))
    return path
