"""How much of a recorded toss counts, and what its first frames say of the start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from diffsim.core.arrays import Array
from diffsim.data.study import Run

TURN = ("qw", "qx", "qy", "qz")
TWIST = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
MIN_FRAMES = 10
CLEAR = 2.0  # times the height that counts as touching: another corner may come down next
CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)


@dataclass(frozen=True)
class Touch:
    """Where a toss first touches the ground."""

    corner: int  # index into ``CORNERS`` of the one that hits first
    touch: int  # first frame with that corner near the ground
    end: int  # frames used, if the rebound counts; equal to ``touch`` if it cannot


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """Recorded motion of one body in the frame whose z points up."""

    place: Array  # (num_frames, 3) [m], NaN where nothing shows it
    turn: Array | None  # (num_frames, 4) quaternion, scalar part first; None if nothing shows it


def continuous(quaternions: Array) -> Array:
    """The same rotations, (num_frames, 4), without jumps of sign."""
    out = quaternions.copy()
    seen = np.flatnonzero(np.isfinite(quaternions).all(axis=1))
    products = np.sum(quaternions[seen[1:]] * quaternions[seen[:-1]], axis=1)
    out[seen] *= np.cumprod([1.0, *np.where(products < 0.0, -1.0, 1.0)])[: len(seen), None]
    return out


def filled(poses: RecordedPoses) -> RecordedPoses:
    """Poses with straight lines over frames in which the body was not tracked."""
    columns = poses.place if poses.turn is None else np.hstack([poses.place, poses.turn])
    frames = np.arange(len(columns))
    out = columns.copy()
    for column in out.T:
        seen = np.isfinite(column)
        if seen.any():
            column[~seen] = np.interp(frames[~seen], frames[seen], column[seen])
    return RecordedPoses(out[:, :3], None if poses.turn is None else out[:, 3:])


def first_touch(poses: RecordedPoses, half: Array, near: float, ground: float) -> Touch | None:
    """The corner that first comes down to the ground, and when.

    Args:
        poses: Complete poses of a box.
        half: Half of its edges, (3,) [m].
        near: Height of a corner that counts as touching [m].
        ground: Height of the ground [m].

    Returns:
        None if no corner comes down.
    """
    height = _make_matrices(poses.turn) @ (CORNERS * half).T
    height = height[:, 2] + poses.place[:, 2:3] - ground
    is_near = height.min(axis=1) < near
    if not is_near.any():
        return None
    touch = int(np.argmax(is_near))
    lowest = touch + int(np.argmin(height[touch : touch + 4].min(axis=1)))
    corner = int(np.argmin(height[lowest]))
    others = np.delete(height, corner, axis=1).min(axis=1)
    end = lowest + 1
    while end < len(height) and height[end, corner] > height[end - 1, corner]:
        if others[end] < CLEAR * near:
            break
        end += 1
    if end - lowest <= 3 or others[touch:end].min() < CLEAR * near:
        end = touch
    return Touch(corner, touch, end)


def cut(run: Run, end: int, facts: dict[str, Any]) -> Run:
    """The first frames of a run, with facts for the simulation in its setup."""
    return replace(run.part(slice(end)), setup={**run.setup, **facts})


def start_facts(run: Run, poses: RecordedPoses, gravity: float) -> dict[str, float]:
    """First guess of the start: a parabola of known curvature, a constant body rate.

    Args:
        run: Recorded toss.
        gravity: Strength of gravity [m/s^2].
    """
    few = slice(0, max(min(8, len(run.time_s)), 3))
    time = run.time_s[few] - run.time_s[0]
    place = poses.place[few] + 0.5 * gravity * time[:, None] ** 2 * np.array([0.0, 0.0, 1.0])
    first, speed = _fit_lines(time, place)
    turn, rates = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    if poses.turn is not None:
        seen = np.isfinite(poses.turn[few]).all(axis=1)
        if seen.any():
            turn = poses.turn[few][seen][0]
            turns = Rotation.from_quat(poses.turn[few][seen][:, [1, 2, 3, 0]])
            rates = _fit_lines(time[seen], (turns[0].inv() * turns).as_rotvec())[1]
    found = np.concatenate([first, speed, rates])
    names = [f"_start_{n}" for n in (*TWIST, *TURN)]
    return dict(zip(names, [*found.tolist(), *turn.tolist()], strict=True))


def rest_height(poses: RecordedPoses, frames: int) -> float:
    """Median height of the last frames [m]."""
    return float(np.nanmedian(poses.place[-frames:, 2]))


def face_below(poses: RecordedPoses) -> int:
    """Axis of the body that is upright at the end: it rests on a face across that one."""
    if poses.turn is None or not np.isfinite(poses.turn).all(axis=1).any():
        return 2
    last = poses.turn[np.isfinite(poses.turn).all(axis=1)][-1:]
    return int(np.argmax(np.abs(_make_matrices(last)[0, 2])))


def _fit_lines(time: Array, values: Array) -> tuple[Array, Array]:
    """Value at 0 and slope of each column; 0 where nothing was recorded."""
    out = np.zeros((2, values.shape[1]))
    for i, column in enumerate(values.T):
        seen = np.isfinite(column)
        if seen.sum() >= 2:
            out[:, i] = np.polyfit(time[seen], column[seen], 1)[::-1]
        elif seen.any():
            out[0, i] = column[seen][0]
    return out[0], out[1]


def _make_matrices(turn: Array | None) -> Array:
    assert turn is not None
    return np.asarray(Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_matrix())


def angles_to_quaternions(angles: Sequence[Array]) -> Array:
    """Quaternions, scalar part first, of roll, pitch and yaw (num_frames,) each [rad]."""
    rpy = np.column_stack(angles)
    seen = np.isfinite(rpy).all(axis=1)
    out = np.full((len(rpy), 4), np.nan)
    if seen.any():
        out[seen] = Rotation.from_euler("ZYX", rpy[seen][:, ::-1]).as_quat()[:, [3, 0, 1, 2]]
    return out
