"""Stretches of rows that two recordings share to the last digit, found in one pass over them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array, IntArray

Hashes = NDArray[np.uint64]
STRETCH = 8  # rows that are compared at once: fewer hold no information that counts
COMMON = 50  # places of a stretch from which it says nothing, such as a sensor at rest
SHARED_BITS = 60.0  # of the changes along an equal stretch: no chance explains them
_ODD = np.uint64(0x9E3779B97F4A7C15)


class SharedStretch(NamedTuple):
    """A stretch that two recordings share."""

    first: int  # place of the recording that has it first
    second: int  # place of the other one
    start: int  # row in the other one
    length: int  # number of rows


def shared_stretches(
    recordings: Sequence[Array], may_share: Callable[[int, int], bool], *, distinct: bool = False
) -> Iterator[SharedStretch]:
    """All stretches of ``STRETCH`` rows or more that two recordings share.

    Rows without any number are in no stretch; missing numbers equal each other.

    Args:
        recordings: (num_rows, num_columns) each.
        may_share: Whether a pair, by places, is of no interest.
        distinct: Whether all rows of a stretch must differ.
    """
    hashes, places, rows = [], [], []
    for k, values in enumerate(recordings):
        found, at = _windows(values, distinct=distinct)
        hashes.append(found)
        places.append(np.full(len(at), k))
        rows.append(at)
    if not hashes:
        return
    every, of, row = np.concatenate(hashes), np.concatenate(places), np.concatenate(rows)
    ordered = np.sort(every)
    if not (ordered[1:] == ordered[:-1]).any():
        return  # far faster to tell than where they are
    order = np.argsort(every, kind="stable")
    every, of, row = every[order], of[order], row[order]
    starts = np.flatnonzero(np.append(True, every[1:] != every[:-1]))
    counts = np.diff(np.append(starts, len(every)))
    matches: dict[tuple[int, int, int], list[int]] = {}
    for start, count in zip(
        *(a[(counts > 1) & (counts <= COMMON)] for a in (starts, counts)), strict=True
    ):
        for a, b in combinations(range(start, start + count), 2):
            if of[a] != of[b] and not may_share(int(of[a]), int(of[b])):
                key = (int(of[a]), int(of[b]), int(row[b]) - int(row[a]))
                matches.setdefault(key, []).append(int(row[b]))
    for (first, second, _), found_rows in matches.items():
        at = np.sort(np.array(found_rows))
        for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
            yield SharedStretch(first, second, int(part[0]), len(part) + STRETCH - 1)


def _windows(values: Array, *, distinct: bool) -> tuple[Hashes, IntArray]:
    """Hashes of all stretches of a recording, and their first rows."""
    count = len(values) - STRETCH + 1
    if count < 1 or not values.shape[1]:
        return np.empty(0, dtype=np.uint64), np.empty(0, dtype=np.int64)
    there = np.isfinite(values)
    bits = np.where(there, values + 0.0, np.nan).view(np.uint64)
    row = np.zeros(len(values), dtype=np.uint64)
    for column in bits.T:  # wraps around, as hashes do
        row = (row ^ (column * _ODD)) * _ODD
        row ^= row >> np.uint64(29)
    window = np.zeros(count, dtype=np.uint64)
    for j in range(STRETCH):
        window = (window ^ row[j : j + count]) * _ODD
        window ^= window >> np.uint64(32)
    seen = there.any(axis=1)
    good = np.convolve(seen, np.ones(STRETCH), mode="valid") > STRETCH - 0.5
    if distinct:
        for gap in range(1, STRETCH):
            equal = row[gap:] == row[:-gap]
            for first in range(STRETCH - gap):
                good &= ~equal[first : first + count]
    at = np.flatnonzero(good)
    return window[at], at


def bits_of(rows: Array) -> float:
    """Information in the changes from row to row: none in a constant or a steady ramp."""
    steps = np.diff(rows, axis=0)
    largest = np.nanmax(np.abs(steps), axis=0, initial=0.0)
    steps = np.round(steps / np.where(largest > 0.0, largest, 1.0), 6)  # rounding is no change
    known = np.where(np.isfinite(steps), steps + 0.0, np.inf)
    counts = np.unique(known, axis=0, return_counts=True)[1].astype(np.float64)
    return float(-(counts * np.log2(counts / counts.sum())).sum())
