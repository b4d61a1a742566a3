"""Marker recordings in the tidy CSV format: one row per frame, meters and seconds, gaps marked.

Columns: ``time_s``, then ``<marker>_x_m, <marker>_y_m, <marker>_z_m`` for each marker; ``frame``
and other columns are allowed and ignored. An empty cell or ``nan`` is a gap (the marker was not
seen); everything else that is not a finite number is refused, with file, row and column.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.data.table import open_table, parse_number, time_column

Array = NDArray[np.float64]

_COORDINATE = re.compile(r"^(?P<marker>.+)_(?P<axis>[xyz])_m$")
_OTHER_UNIT = re.compile(r"^(?P<marker>.+)_(?P<axis>[xyz])_(?P<unit>mm|cm|um|in|ft)$")
#: Largest coordinate accepted [m]: no marker system sees further, and millimeters read as meters
#: are nearly always beyond it.
MAX_COORDINATE_M = 100.0


@dataclass(frozen=True)
class Recording:
    """Positions of markers over time."""

    time_s: Array  # (T,) strictly increasing [s]
    position_m: Array  # (T, num_markers, 3) [m]; NaN where a marker was not seen
    markers: tuple[str, ...]  # marker names, in the order of the second axis
    name: str = "recording"  # short name, by default the file's stem
    # whatever the source says about this recording
    metadata: dict[str, Any] = field(default_factory=dict)
    source: Path | None = None  # the file it came from; None if it was made in memory

    def __post_init__(self) -> None:
        expected = (len(self.time_s), len(self.markers), 3)
        if self.position_m.shape != expected:
            raise ValueError(
                f"position_m of recording {self.name!r} must have shape (T, num_markers, 3) = "
                f"{expected}, got {self.position_m.shape}"
            )

    @property
    def num_gaps(self) -> int:
        """Number of (frame, marker) pairs in which the marker was not seen."""
        return int(self.is_gap.sum())

    @property
    def is_gap(self) -> NDArray[np.bool_]:
        """(T, num_markers): True where the marker was not seen."""
        return np.asarray(np.isnan(self.position_m).any(axis=2))

    @property
    def rate_Hz(self) -> float:
        """Sampling rate, from the median step."""
        return 1.0 / float(np.median(np.diff(self.time_s)))

    @property
    def is_uniform(self) -> bool:
        """Whether every step is within 1 % of the median step."""
        step = np.diff(self.time_s)
        return bool(np.all(np.abs(step / np.median(step) - 1.0) < 0.01))

    def select(self, markers: Sequence[str]) -> Recording:
        """The same recording with these markers only, in this order."""
        idx = [self._marker_idx(name) for name in markers]
        return replace(self, position_m=self.position_m[:, idx], markers=tuple(markers))

    def position_of(self, marker: str) -> Array:
        """(T, 3) places of one marker [m]."""
        return self.position_m[:, self._marker_idx(marker)]

    def _marker_idx(self, marker: str) -> int:
        if marker not in self.markers:
            raise ValueError(
                f"recording {self.name!r} has no marker {marker!r}; it has "
                f"{', '.join(self.markers)}{did_you_mean(marker, self.markers)}"
            )
        return self.markers.index(marker)


def load_csv(
    path: str | Path,
    *,
    markers: Sequence[str] | None = None,
    metadata: dict[str, Any] | None = None,
    min_frames: int = 20,
) -> Recording:
    """Read a recording and refuse, with file, row and column, what cannot be one.

    Args:
        path: CSV file in the tidy format (see the module's docstring).
        markers: Markers that must be there, in this order; by default all that the file has.
        metadata: Facts about the recording, stored with it.
        min_frames: Smallest number of frames that is accepted.

    Raises:
        FileNotFoundError: no such file; the message lists the CSV files beside it.
        ValueError: a column is missing or in another unit, a cell is not a number, time does not
            increase, a marker is never seen, or there are fewer than ``min_frames`` rows.
    """
    path = Path(path)
    time_s: list[float] = []
    position_m: list[list[float]] = []
    with open_table(path, "recording") as (header, rows):
        time_col, coordinates = _columns(path, header, markers)
        for line, row in rows:
            before = time_s[-1] if time_s else None
            time_s.append(_parse_time(path, line, header[time_col], row[time_col], before))
            position_m.append(
                [
                    _coordinate(path, line, header[col], row[col])
                    for cols in coordinates.values()
                    for col in cols
                ]
            )
    if len(time_s) < min_frames:
        raise ValueError(
            f"{path}: {len(time_s)} frames; a recording needs at least {min_frames} "
            "(is this the right file, or was the export cut short?)"
        )
    places = np.array(position_m).reshape(len(time_s), len(coordinates), 3)
    for marker, unseen in zip(coordinates, np.isnan(places).any(2).all(0), strict=True):
        if unseen:
            raise ValueError(
                f"{path}: marker {marker} is never seen: its cells are empty in all "
                f"{len(time_s)} rows; leave it out with markers=[...]"
            )
    return Recording(
        time_s=np.array(time_s),
        position_m=places,
        markers=tuple(coordinates),
        name=path.stem,
        metadata=dict(metadata or {}),
        source=path,
    )


def format_csv(recording: Recording) -> str:
    """The recording in the tidy format, micrometers and microseconds kept; gaps are empty."""
    columns = [f"{m}_{axis}_m" for m in recording.markers for axis in "xyz"]
    lines = [",".join(["frame", "time_s", *columns])]
    flat = recording.position_m.reshape(len(recording.time_s), -1)
    for frame, (now, row) in enumerate(zip(recording.time_s, flat, strict=True)):
        cells = ("" if math.isnan(value) else f"{value:.6f}" for value in row)
        lines.append(",".join([str(frame), f"{now:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def _parse_time(path: Path, line: int, column: str, cell: str, before: float | None) -> float:
    """A time [s], later than the one before."""
    now = parse_number(path, line, column, cell)
    if math.isnan(now):
        raise ValueError(f"{path}, row {line}, column {column}: time is missing")
    if before is not None and now <= before:
        raise ValueError(
            f"{path}, row {line}, column {column}: time must increase, got "
            f"{now:g} s after {before:g} s; sort the file, one row a stamp"
        )
    return now


def _columns(
    path: Path, header: list[str], markers: Sequence[str] | None
) -> tuple[int, dict[str, list[int]]]:
    """Index of the time column and, per marker, of its x, y and z columns."""
    time_col = time_column(path, header)
    for name in header:
        if wrong := _OTHER_UNIT.match(name):
            raise ValueError(
                f"{path}: column {name} is in {wrong['unit']}; positions must be in meters: "
                f"convert it and name it {wrong['marker']}_{wrong['axis']}_m"
            )
    present = [m["marker"] for name in header if (m := _COORDINATE.match(name))]
    names = list(markers) if markers is not None else list(dict.fromkeys(present))
    if not names:
        raise ValueError(
            f"{path}: no marker columns; expected names such as tip1_x_m, tip1_y_m, tip1_z_m, "
            f"the file has {', '.join(header)}"
        )
    coordinates: dict[str, list[int]] = {}
    for marker in names:
        wanted = [f"{marker}_{axis}_m" for axis in "xyz"]
        missing = [name for name in wanted if name not in header]
        if missing:
            raise ValueError(
                f"{path}: column {missing[0]} is missing{did_you_mean(missing[0], header)}; "
                f"the file has markers {', '.join(dict.fromkeys(present)) or 'none'}"
            )
        coordinates[marker] = [header.index(name) for name in wanted]
    return time_col, coordinates


def _coordinate(path: Path, line: int, column: str, cell: str) -> float:
    value = parse_number(path, line, column, cell, missing="the marker was not seen")
    if abs(value) > MAX_COORDINATE_M:
        raise ValueError(
            f"{path}, row {line}, column {column}: {value:g} m is not a marker position "
            f"(limit {MAX_COORDINATE_M:g} m); are these millimeters?"
        )
    return value
