"""From a video file to tracks of round things of one color, in pixels.

OpenCV reads the frames (extra ``video``). A pixel belongs to a ball if its hue, saturation and
value lie within bounds; pixels that touch are one region, whose center is the mean of its pixels.
Balls that touch in the picture make one region, which is cut in two by k-means, started from where
the balls were going: right for discs side by side, off where one hides part of the other. Tracks
are joined by least total distance from the places that constant velocity predicts.

As a study, tracks are without merged frames, and have the noise of the tracker.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.check import require_number
from diffsim.core.errors import DiffsimError
from diffsim.core.files import csv_text, write_text_atomic
from diffsim.core.optional import optional
from diffsim.data.signal import scatter
from diffsim.data.study import Channel, Run, Study

_FULL = 0.6  # of a ball's usual area: below it, a region is noise or a ball that leaves


class TrackingError(DiffsimError):
    """A video that cannot be read, or in which the balls are not seen."""


@dataclass(frozen=True)
class ColorBounds:
    """Which pixels belong to a ball, in OpenCV's HSV."""

    # low, high: (hue, saturation, value), hue in 0..179, the others in 0..255; a low hue above the
    # high one means that hues wrap around red
    low: tuple[int, int, int]
    high: tuple[int, int, int]

    def __post_init__(self) -> None:
        for name, values in (("low", self.low), ("high", self.high)):
            limits = (179, 255, 255)
            if len(values) != 3 or any(
                not 0 <= v <= top for v, top in zip(values, limits, strict=True)
            ):
                raise ValueError(
                    f"{name} must be (hue 0..179, saturation 0..255, value 0..255), got {values}"
                )
        if any(a > b for a, b in zip(self.low[1:], self.high[1:], strict=True)):
            raise ValueError(
                f"saturation and value of low must not exceed those of high, got {self.low}, "
                f"{self.high}"
            )

    def mask(self, hsv: NDArray[np.uint8]) -> Mask:
        """(height, width) of a picture (height, width, 3)."""
        hue, rest = hsv[..., 0], hsv[..., 1:]
        if self.low[0] <= self.high[0]:
            inside = (hue >= self.low[0]) & (hue <= self.high[0])
        else:
            inside = (hue >= self.low[0]) | (hue <= self.high[0])
        inside &= (rest >= np.array(self.low[1:])).all(-1)
        return np.asarray(inside & (rest <= np.array(self.high[1:])).all(-1))


TENNIS_BALL = ColorBounds((25, 60, 70), (50, 255, 255))
"""Optic yellow under room light."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Centers of balls over the frames of a video."""

    frames: IntArray  # (num_frames,) numbers of the video's frames
    time_s: Array  # (num_frames,) since the first of them [s]
    # (num_frames, num_balls, 2) u to the right, v down [px]; NaN where a ball was not seen
    centers: Array
    merged: Mask  # (num_frames,) whether balls touched in the picture: centers are then less sure

    def save(self, path: str | Path) -> Path:
        """Write CSV with the columns of the tennis balls' data set; empty cells are missing."""
        count = self.centers.shape[1]
        names = [f"ball{k}_{c}_px" for k in range(count) for c in "uv"]
        places = self.centers.reshape(len(self.frames), -1)
        both = zip(self.frames, self.time_s, places, strict=True)
        rows = ([frame, f"{time:.6f}", *place] for frame, time, place in both)
        return write_text_atomic(Path(path), csv_text(["frame", "time_s", *names], rows, ".3f"))


def track_video(
    path: str | Path,
    num_balls: int,
    color: ColorBounds = TENNIS_BALL,
    *,
    first: int = 0,
    last: int | None = None,
    min_area: int = 20,
) -> Tracks:
    """Centers of balls of one color.

    Args:
        path: Video that OpenCV can read.
        num_balls: Number of balls to follow; ball 0 is the leftmost in the first frame.
        color: Color range that marks a pixel as belonging to a ball.
        first, last: Frames to read, both included; None: to the end.
        min_area: Smaller regions are noise [px].

    Raises:
        FileNotFoundError: no such file.
        TrackingError: not a video, or the first frame does not show ``num_balls`` regions.
    """
    require_number("num_balls", num_balls, at_least=1)
    require_number("min_area", min_area, at_least=1)
    follower: _Follower | None = None
    frames, centers, merged, rates = [], [], [], []
    for number, mask, rate in _masks(Path(path), color, first, last):
        regions = _regions(mask, min_area)
        if follower is None:
            follower = _Follower.first(regions, num_balls, path, number)
            row, touching = follower.places, False
        else:
            row, touching = follower.follow(regions)
        frames.append(number)
        rates.append(rate)
        centers.append(row.copy())
        merged.append(touching)
    if follower is None:
        raise TrackingError(f"{path}: no frame from {first} on; the video is shorter")
    number_of = np.array(frames)
    return Tracks(
        number_of, (number_of - number_of[0]) / rates[0], np.stack(centers), np.array(merged)
    )


@dataclass
class _Region:
    """Pixels that touch: (n, 2) as u, v."""

    pixels: Array

    @property
    def center(self) -> Array:
        return np.asarray(self.pixels.mean(0))


class _Follower:
    """Where the balls are, where they were, how large they are."""

    def __init__(self, places: Array, area: float):
        self.places, self.before, self.area = places, places.copy(), area

    @classmethod
    def first(
        cls, regions: Sequence[_Region], count: int, path: str | Path, number: int
    ) -> _Follower:
        """From the largest regions of the first frame."""
        if len(regions) < count:
            raise TrackingError(
                f"{path}, frame {number}: {len(regions)} regions of the given color, expected "
                f"{count} balls; widen the color bounds, lower min_area, or start at a frame "
                "where all balls are seen apart"
            )
        largest = sorted(regions, key=lambda r: -len(r.pixels))[:count]
        largest.sort(key=lambda r: float(r.center[0]))
        area = float(np.median([len(r.pixels) for r in largest]))
        return cls(np.stack([r.center for r in largest]), area)

    def follow(self, regions: Sequence[_Region]) -> tuple[Array, bool]:
        """Centers in the next frame, and whether balls touch."""
        expected = np.where(np.isnan(self.places), self.before, 2.0 * self.places - self.before)
        expected = np.where(np.isnan(expected), self.before, expected)
        points, touching = self._points(regions, expected)
        row = np.full_like(self.places, np.nan)
        if len(points):
            distance = np.linalg.norm(expected[:, None] - points[None], axis=-1)
            for ball, point in zip(*linear_sum_assignment(distance), strict=True):
                row[ball] = points[point]
        seen = np.isfinite(row)
        self.before = np.where(seen, np.where(np.isnan(self.places), row, self.places), expected)
        self.places = np.where(seen, row, np.nan)
        return row, touching

    def _points(self, regions: Sequence[_Region], expected: Array) -> tuple[Array, bool]:
        """One point per ball: centers of regions, those of two balls cut in two."""
        large = [r for r in regions if len(r.pixels) >= _FULL * self.area]
        missing = len(expected) - len(large)
        if missing <= 0 or not large:
            return np.array([r.center for r in large]).reshape(-1, 2), False
        widest = max(large, key=lambda r: len(r.pixels))
        if len(widest.pixels) < (1.0 + _FULL) * self.area:
            return np.array([r.center for r in large]), False
        near = np.linalg.norm(expected - widest.center, axis=1).argsort()[: missing + 1]
        cut, _ = kmeans2(widest.pixels, expected[near], minit="matrix", missing="raise")
        others = [r.center for r in large if r is not widest]
        return np.array([*others, *cut]), True


def _regions(mask: Mask, min_area: int) -> list[_Region]:
    labels, count = ndimage.label(mask)
    rows, cols = np.nonzero(labels)
    of = labels[rows, cols]
    places = np.stack([cols, rows], -1).astype(np.float64)
    regions = [_Region(places[of == k]) for k in range(1, count + 1)]
    return [r for r in regions if len(r.pixels) >= min_area]


def _masks(
    path: Path, color: ColorBounds, first: int, last: int | None
) -> Iterator[tuple[int, Mask, float]]:
    """Number, mask and frame rate of every frame asked for."""
    cv2 = opencv()
    if not path.is_file():
        raise FileNotFoundError(f"no video {path}")
    video = cv2.VideoCapture(str(path))
    try:
        rate = float(video.get(cv2.CAP_PROP_FPS))
        if not video.isOpened() or not rate > 0.0:
            raise TrackingError(f"{path} is no video that OpenCV can read")
        number = 0
        while last is None or number <= last:
            read, picture = video.read()
            if not read:
                return
            if number >= first:
                yield number, color.mask(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)), rate
            number += 1
    finally:
        video.release()


def opencv() -> Any:
    """The module ``cv2``, which is an optional dependency.

    Raises:
        ImportError: OpenCV is not installed.
    """
    return optional("cv2", purpose="reading a video")


def without_merged(tracks: Tracks) -> Tracks:
    """The same track with NaN where balls touch in the picture, and their centers are biased."""
    centers = np.where(tracks.merged[:, None, None], np.nan, tracks.centers)
    return replace(tracks, centers=centers)


def noise_px(tracks: Tracks) -> np.ndarray:
    """Noise of every ball's u and v, (num_balls, 2) [px]: median third difference over sqrt(20).

    Smooth motion leaves little in a third difference; the median passes over the impacts. NaN
    where fewer than four frames in a row were seen.
    """
    third = np.diff(tracks.centers, n=3, axis=0)
    out = np.full(tracks.centers.shape[1:], np.nan)
    seen = np.isfinite(third).any(0) if len(third) else np.zeros_like(out, dtype=bool)
    out[seen] = scatter(third[:, seen], 3)
    return out


def tracks_study(tracks: Tracks, name: str) -> Study:
    """A study of one run, channels ball0_u_px, ball0_v_px, ... with the noise of ``noise_px``."""
    count = tracks.centers.shape[1]
    noise = noise_px(tracks)
    channels = tuple(
        Channel(f"ball{k}_{c}_px", "px", "image", float(sd) if sd > 0.0 else None)
        for k in range(count)
        for c, sd in zip("uv", noise[k], strict=True)
    )
    run = Run(
        name="tracks",
        time_s=tracks.time_s,
        measured=tracks.centers.reshape(len(tracks.frames), -1),
        command={},
        group="tracks",
        setup={"first_frame": float(tracks.frames[0])},
    )
    merged = tracks.frames[tracks.merged].tolist()
    metadata = {"source": f"video {name}", "frames_in_which_balls_touch": merged}
    return Study(name, "rigid_body", channels, (run,), metadata)
