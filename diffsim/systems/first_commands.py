"""Whether the first commands of recordings stood before them, or came with them.

A start that rests without commands, and not with the first ones, says that these came with the
record: what is late hears them later. Unless the record moves at once: then the drives were let go
with commands that had long been heard, and no delay shows before these change. It may well show
after that, so that each is asked with later commands that come late.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from diffsim.core.arrays import Array
from diffsim.identify.ranges import SURE_SD

SAMPLES = 20  # from the first one, by which a record moves at once or late
LATE = (1.0, 2.0, 3.0)  # [samples] that are tried; half of one, a gain that is off can look like
FEWEST_READINGS = 4  # of a channel: two are spent on its gain and start
CLEAR = SURE_SD**2  # of chi2, by which the record moves at once


def squares_left(records: Iterable[tuple[Array, Array]], sd: Array) -> Array:
    """What gains and starts that nobody knows yet leave of records, in noise units, without a delay
    and late in each of the ways, (1 + 2 len(LATE),).

    Args:
        records: Of each run that begins at rest, channels as predicted without a delay, late by
            ``LATE`` where the first command stood before the record, and late after zero, (1 + 2
            len(LATE), num_samples, num_channels); and as measured, (num_samples, num_channels);
            NaN: not measured.
        sd: Noise of the channels, (num_channels,); NaN: of a channel that tells nothing here.
    """
    left = np.zeros(1 + 2 * len(LATE))
    for predicted, measured in records:
        for channel in np.flatnonzero(np.isfinite(sd)):
            seen = measured[:SAMPLES, channel] / sd[channel]
            there = np.flatnonzero(np.isfinite(seen))
            every = predicted[:, there, channel] / sd[channel]
            if len(there) < FEWEST_READINGS or not np.isfinite(every).all():
                continue
            for k, moved in enumerate(every):
                # gains and starts may be off by what nobody knows yet
                ways = np.column_stack([moved, np.ones(len(there))])
                found = np.linalg.lstsq(ways, seen[there], rcond=None)[0]
                left[k] += float(np.sum((seen[there] - ways @ found) ** 2))
    return left


def is_heard_at_once(records: Iterable[tuple[Array, Array]], sd: Array) -> bool:
    """Whether records clearly move as they would if a first command is heard at once.

    Args:
        records, sd: As of ``squares_left``.
    """
    left = squares_left(records, sd)
    stood = 1 + len(LATE)
    return bool(left[:stood].min() + CLEAR < left[stood:].min())


def is_late_behind_first(records: Iterable[tuple[Array, Array]], sd: Array) -> bool:
    """Whether records clearly move with a first command at once, and late with later ones: what
    moves at once in all may be late by less than a sample, which tells nothing of before.

    Args:
        records, sd: As of ``squares_left``.
    """
    left = squares_left(records, sd)
    stood = slice(1, 1 + len(LATE))
    return bool(left[stood].min() + CLEAR < np.delete(left, stood).min())
