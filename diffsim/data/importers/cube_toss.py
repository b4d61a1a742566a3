"""An acrylic cube tossed by hand onto a board: its flight, and the height at which it rests.

What follows the first impact is chaotic. ``after=False`` (the study) cuts each toss before it;
``after=True`` goes on until another corner comes near the board or the first one comes down again,
where at least three frames are left after it (not for a cube that lands on an edge or a face).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffsim.data.importers.common import facts, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

Array = NDArray[np.float64]
POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
REST = "rest_z_m"
TWIST = ("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
HOLD_OUT_EVERY = 8
NEAR_M = 0.003  # the first corner this low: the flight is over
CLEAR_M = 0.006  # another corner this low: the second impact is near (6 mm per frame at most)
MIN_FRAMES_AFTER = 3
SPARED = 1  # frames before the touch, which a camera or a filter may already smear
MIN_FRAMES = 10
REST_FRAMES = 10  # at the end of each toss
CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)


@dataclass(frozen=True)
class Window:
    """Which part of a toss is used.

    Attributes:
        corner: Index into ``CORNERS`` of the one that hits first.
        touch: First frame with that corner near the board.
        end: Frames used.
    """

    corner: int
    touch: int
    end: int


def import_cube_toss(folder: Path, *, after: bool = False) -> Study:
    """Poses as tracked; the velocities of the first frame are start values in ``setup``.

    Args:
        folder: Folder of the downloaded data set.
        after: Go on through the first impact.
    """
    meta = read_metadata(folder)
    half_width = float(meta["geometry"]["half_width_m"])
    data, text = read_columns(folder / "tosses.csv", ["time_s", *POSE, *TWIST], ["toss"])
    tosses = np.array(text["toss"])
    runs, flights, rests = [], [], []
    for order, toss in enumerate(dict.fromkeys(text["toss"])):
        rows = tosses == toss
        pose = np.column_stack([data[c][rows] for c in POSE])
        pose[:, 3:] = continuous(pose[:, 3:])
        window = first_impact(pose, half_width)
        hits = after and window.end > window.touch
        end = window.end if hits else window.touch - SPARED
        if end < MIN_FRAMES:
            continue
        rest = np.full((end, 1), np.nan)
        rest[-1] = np.median(pose[-REST_FRAMES:, 2])
        flights.append(pose[: window.touch - SPARED])
        rests.append(rest[-1, 0])
        runs.append(
            Run(
                name=f"toss_{int(toss):03d}",
                time_s=data["time_s"][rows][:end],
                measured=np.hstack([pose[:end], rest]),
                command={},
                group=f"toss_{int(toss):03d}",
                order=order,
                use="test" if order % HOLD_OUT_EVERY == HOLD_OUT_EVERY - 1 else "fit",
                setup={f"start_{c}": float(data[c][rows][0]) for c in TWIST}
                | {
                    "corner": float(window.corner),
                    "touch_s": float(data["time_s"][rows][window.touch]),
                    "hits": float(hits),
                },
            )
        )
    kinds = ["position"] * 3 + ["orientation"] * 4 + ["position"]
    units = ["m"] * 3 + ["-"] * 4 + ["m"]
    noise = [*np.median([flight_scatter(f) for f in flights], axis=0), np.std(rests)]
    return Study(
        name="cube_toss",
        system="rigid_body",
        channels=tuple(
            Channel(name, unit, kind, float(sd))
            for name, unit, kind, sd in zip((*POSE, REST), units, kinds, noise, strict=True)
        ),
        runs=tuple(runs),
        metadata=facts(
            meta,
            held_out=f"every {HOLD_OUT_EVERY}th toss, by number and not by outcome",
            notes="each toss is its own command: the start state, thrown by hand, never repeats; "
            "the start velocities are filtered finite differences. Noise: scatter in flight about "
            "a parabola and a turn of constant rate, whatever their constants. rest_z_m, at the "
            "last sample: height at the end of the toss, noise: its scatter over the tosses",
        )
        | {"authors_model_parameters": meta["authors_model_parameters"]},
    )


def continuous(quaternions: Array) -> Array:
    """The same rotations, (num_frames, 4), without jumps of sign."""
    flips = np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def first_impact(pose: Array, half_width: float) -> Window:
    """From poses (num_frames, 7), scalar part of the quaternion first."""
    turns = Rotation.from_quat(pose[:, [4, 5, 6, 3]]).as_matrix()
    height = half_width * (turns @ CORNERS.T)[:, 2] + pose[:, 2:3]
    touch = int(np.argmax(height.min(axis=1) < NEAR_M))
    lowest = touch + int(np.argmin(height[touch : touch + 4].min(axis=1)))
    corner = int(np.argmin(height[lowest]))
    others = np.delete(height, corner, axis=1).min(axis=1)
    end = lowest + 1
    while end < len(pose) and height[end, corner] > height[end - 1, corner]:
        if others[end] < CLEAR_M:
            break
        end += 1
    if end - lowest <= MIN_FRAMES_AFTER or others[touch:end].min() < CLEAR_M:
        end = touch
    return Window(corner, touch, end)


def flight_scatter(pose: Array) -> Array:
    """(7,) sd about what any rigid cube in free flight does: a parabola, a constant body rate.

    That of the quaternion is half that of the angle, the same for all its entries.
    """
    time = np.linspace(-1.0, 1.0, len(pose))

    def about(values: Array, degree: int) -> Array:
        left = values - np.vander(time, degree + 1) @ np.polyfit(time, values, degree)
        return np.asarray(np.sqrt((left**2).sum(axis=0) / (len(time) - degree - 1)))

    turns = Rotation.from_quat(pose[:, [4, 5, 6, 3]])
    angle = about((turns[0].inv() * turns).as_rotvec(), 1)
    quaternion = 0.5 * float(np.sqrt(np.mean(angle**2)))
    return np.concatenate([about(pose[:, :3], 2), np.full(4, quaternion)])
