"""Jumps of commands that nothing commanded: a marker that is lost for a sample, a value misread.

A channel's outliers are taken out by the diagnosis, which knows what the model expects there. An
outlier in a motion that drives a model is an acceleration to it:
the diagnosis simulates a measured command with and without its jumps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from diffsim.core.arrays import Array, IntArray
from diffsim.core.numbers import SD_OVER_MAD
from diffsim.data.signal import GAP, rest_and_jump

WIDTH = 5  # samples whose median is compared with: what lasts longer than two is no outlier
JUMP_SD = 6.0  # robust sd of what others are off by, and usual changes from sample to sample
LEAST = 0.02  # of the command's range
ALONE = 6.0  # times the changes on either side of a lasting jump
MAX_JUMP_SHARE = 0.03  # of the samples: so many the diagnosis leaves out; more are how it is


class Jumps(NamedTuple):
    """Samples at which a command jumps."""

    back: list[int]  # indices of samples that lie off both sides
    # indices of samples before which it jumps and stays, where it moves smoothly else
    lasting: list[int]
    size: float  # largest jump [unit of the command]


def jumps_of(values: Array, *, is_measured: bool, times: Array | None = None) -> Jumps:
    """Jumps of a command or channel in a run.

    Args:
        values: Its samples; those that are not finite are left out.
        is_measured: Whether lasting jumps are looked for: what is commanded may jump and stay.
        times: Times of the samples [s]: over a gap of lost ones it may have moved far. None: even.
    """
    valid = np.flatnonzero(np.isfinite(values))
    seen = values[valid]
    if len(seen) < 2 * WIDTH or rest_and_jump([seen]):
        return Jumps([], [], 0.0)
    change, least = np.abs(np.diff(seen)), LEAST * float(np.ptp(seen))
    away = np.abs(seen - median_filter(seen, size=WIDTH, mode="nearest"))
    usual = max(SD_OVER_MAD * float(np.median(away)), float(np.median(change)))
    if not usual > 0.0:  # it rests but for what was commanded
        return Jumps([], [], 0.0)
    back = np.flatnonzero(away > max(JUMP_SD * usual, least))
    lasting = np.empty(0, dtype=np.int64)
    if is_measured:
        lasting = _lasting(change, max(JUMP_SD * float(np.median(change)), least))
        if times is not None:
            step = np.diff(np.asarray(times)[valid])
            lasting = lasting[step[lasting - 1] < GAP * np.median(step)]
        near = np.abs(lasting[:, None] - back[None, :]).min(axis=1, initial=len(seen)) > 1
        lasting = lasting[near]
    if len(back) + len(lasting) > MAX_JUMP_SHARE * len(seen):
        return Jumps([], [], 0.0)
    sizes = [*away[back], *change[lasting - 1]]
    return Jumps(valid[back].tolist(), valid[lasting].tolist(), float(max(sizes, default=0.0)))


def without_jumps(values: Array, times: Array, jumps: Jumps) -> Array:
    """A command as it would be without its jumps.

    Samples off both sides lie on the straight line between their neighbors. What follows a jump
    that stays is moved back by it; how far the command moved meanwhile is the mean of the changes
    before and after.

    Args:
        values: Samples of the command, (num_samples,).
        times: Their times, (num_samples,) [s].
    """
    mended = np.array(values, dtype=np.float64)
    kept = np.isfinite(mended)
    off = np.zeros(len(mended), dtype=bool)
    off[jumps.back] = True
    mended[off] = np.interp(times[off], times[kept & ~off], mended[kept & ~off])
    for k in jumps.lasting:
        change = np.diff(mended[max(k - 2, 0) : k + 2])
        usual = np.delete(change, min(k, 2) - 1)
        usual = usual[np.isfinite(usual)]
        moved = float(usual.mean()) if len(usual) else 0.0
        mended[k:] -= mended[k] - mended[k - 1] - moved
    return mended


def _lasting(change: Array, least: float) -> IntArray:
    """Indices of samples after changes that stand alone among two on either side."""
    padded = np.pad(change, 2, mode="reflect")
    around = [padded[k : k + len(change)] for k in (0, 1, 3, 4)]
    is_alone = change > ALONE * np.max(around, axis=0)
    return np.flatnonzero(is_alone & (change > least)) + 1
