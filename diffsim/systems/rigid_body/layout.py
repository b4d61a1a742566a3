"""From the motion of a body to the channels that show it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_product,
    rpy_from_matrix,
)

REST = "rest_height_m"


@dataclass(frozen=True, eq=False)
class TossMotion:
    """Motion of a body in the frame whose z points up."""

    # place, velocity: (..., 3) of the tracked point [m, m/s]
    place: Tensor
    turn: Tensor  # (..., 4) quaternion from the body to the world
    velocity: Tensor
    rates: Tensor  # body rates, (..., 3) [rad/s]
    rest: Tensor  # height of the center at rest, (..., 1) [m]


@dataclass(frozen=True, eq=False)
class PoseLayout:
    """What each channel shows."""

    # kind and component of each channel; the kinds of a measure, or "rest"
    rows: Sequence[tuple[str, int]]
    up: Tensor  # (4,) quaternion of the turn from the recorded frame to the one whose z points up

    def channels(self, flown: TossMotion, measured: Tensor) -> Tensor:
        """(..., num_channels); angles within half a turn of what was measured (same shape)."""
        back = quaternion_conjugate(self.up)
        kinds = {kind for kind, _ in self.rows}
        frame = matrix_from_quaternion(back)
        shown = {"rest": flown.rest, "spin": flown.rates}
        if "position" in kinds:
            shown["position"] = flown.place @ frame.mT
        if "velocity" in kinds:
            shown["velocity"] = flown.velocity @ frame.mT
        if kinds & {"quaternion", "angles"}:
            turn = quaternion_product(back.expand_as(flown.turn), flown.turn)
            shown["quaternion"] = turn
            if "angles" in kinds:
                shown["angles"] = rpy_from_matrix(matrix_from_quaternion(turn))
        columns = []
        for i, (kind, component) in enumerate(self.rows):
            column = shown[kind][..., component]
            if kind == "angles":
                off = (measured[..., i] - column.detach()).nan_to_num(0.0)
                column = column + 2.0 * math.pi * torch.round(off / (2.0 * math.pi))
            columns.append(column)
        return torch.stack(columns, -1)
