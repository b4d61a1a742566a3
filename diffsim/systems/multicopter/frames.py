"""Frames of recordings against those of the model, north-east-down and forward-right-down."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_product,
)

FRAMES = "frames"  # name of the recording's frames in a saved model
_HALF = 0.5**0.5
# Each is a half turn of the model's frame (or none), so that it is its own inverse.
_TURNS = {
    "NED": (1.0, 0.0, 0.0, 0.0),
    "ENU": (0.0, _HALF, _HALF, 0.0),
    "NWU": (0.0, 1.0, 0.0, 0.0),
    "FRD": (1.0, 0.0, 0.0, 0.0),
    "FLU": (0.0, 1.0, 0.0, 0.0),
}
WORLDS = ("NED", "ENU", "NWU")
BODIES = ("FRD", "FLU")
AXES = ("x", "y", "z")  # of the recording's world: places at which forces may act
#: Readings of each group.
SENSORS = {
    "position": ("x_m", "y_m", "z_m"),
    "attitude": ("roll_rad", "pitch_rad", "yaw_rad"),
    "body_rates": ("p_rad_s", "q_rad_s", "r_rad_s"),
    "accelerometer": ("ax_m_s2", "ay_m_s2", "az_m_s2"),
    "velocity": ("vx_m_s", "vy_m_s", "vz_m_s"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "specific_force_in_world": ("fx_m_s2", "fy_m_s2", "fz_m_s2"),
    "acceleration": ("ax_world_m_s2", "ay_world_m_s2", "az_world_m_s2"),
}


@dataclass(frozen=True)
class RecordingFrames:
    """World and body frame that a recording is written in."""

    # one of ``WORLDS``: x, y and z point north, east, down; east, north, up; or north, west, up.
    # Without a compass "north" is where x (ENU: y) happens to point.
    world: str = "NED"
    body: str = "FRD"  # one of ``BODIES``: forward, right, down; or forward, left, up

    def saved(self) -> dict[str, str]:
        """Names of both, for a saved model."""
        return {"world": self.world, "body": self.body}

    def in_world(self, vectors: Tensor) -> Tensor:
        """World vectors (..., 3) of the model as the recording writes them, and back."""
        return vectors if self.world == "NED" else vectors @ _make_turn_of_vectors(self.world)

    def in_body(self, vectors: Tensor) -> Tensor:
        """Body vectors (..., 3) of the model as the recording writes them, and back."""
        return vectors if self.body == "FRD" else vectors @ _make_turn_of_vectors(self.body)

    def rotation(self, rotation: Tensor) -> Tensor:
        """World from body (..., 3, 3) of the model as the recording writes it, and back."""
        if self.world != "NED":
            rotation = _make_turn_of_vectors(self.world) @ rotation
        return rotation if self.body == "FRD" else rotation @ _make_turn_of_vectors(self.body)

    def quaternion(self, quaternion: Tensor) -> Tensor:
        """World from body (w, x, y, z), (..., 4), of the model as the recording writes it."""
        return (
            quaternion
            if self == RecordingFrames()
            else quaternion @ _make_turn_matrix(self.world, self.body)
        )

    def inertia(self, inertia: Tensor) -> Tensor:
        """Inertia (..., 3, 3) about body axes of the recording in those of the model."""
        turn = _make_turn_of_vectors(self.body)
        return turn @ inertia @ turn.mT


@cache
def _make_turn(name: str) -> Tensor:
    return torch.tensor(_TURNS[name], dtype=torch.float64)


@cache
def _make_turn_matrix(world: str, body: str) -> Tensor:
    """(4, 4): products with the turns of both frames are linear in the quaternion between them."""
    units = quaternion_product(_make_turn(world), torch.eye(4, dtype=torch.float64))
    return quaternion_product(units, quaternion_conjugate(_make_turn(body)))


@cache
def _make_turn_of_vectors(name: str) -> Tensor:
    """The half turn (3, 3): symmetric, and its own inverse."""
    return matrix_from_quaternion(_make_turn(name)).round()
