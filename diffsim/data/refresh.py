"""Sensors with a clock of their own: what is read was measured at the sensor's last tick.

A register that a servo refreshes every 8 ms, asked every 10 ms, is 0 to 8 ms old. Its readings of
a steady motion go in uneven steps, which repeat with the beat of the two clocks. Against a smooth
motion they lag by velocity times age; a sawtooth of one period and one phase per record explains
that where there is such a clock.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import starmap

import numpy as np
from scipy.ndimage import median_filter

from diffsim.core.arrays import Array
from diffsim.core.progress import say_stage

WINDOW, DEGREE = 11, 3  # samples and degree of the smooth motion
SHORTEST, LONGEST = 0.3, 2.5  # periods that are looked for, in usual steps between samples
FINE = 4.0  # beats that are tried per one over a record's duration
TINY = 1e-300  # keeps ratios of nothing finite
MAX_PERIOD_RECORDS = 4  # records in which the period is looked for: those that move most
CANDIDATES = 3  # beats whose sawteeth are tried
PHASES = 24  # that are tried of a record
PART = 800  # samples of a record that are looked at first
HINT = 0.5  # of what is asked for, from which on all samples are looked at
EXPLAINED = 0.5  # share of the squared lags from which on a clock is one
MISREAD = 3.0  # usual greatest steps: what lies further from its neighbors was misread
FULL = (0.7, 1.3)  # how much of its sawtooth must be there


@dataclass(frozen=True)
class _Lags:
    """How readings differ from a smooth motion."""

    times: Array  # times of the samples, (num_samples,) [s]
    velocity: Array  # of the smooth motion [reading/s]
    off: Array  # readings less the smooth motion

    @classmethod
    def of(cls, times: Array, readings: Array) -> _Lags | None:
        """Of a record, or None where it is too short; gaps are bridged by straight lines."""
        good = np.isfinite(readings)
        if good.sum() < 4 * WINDOW:
            return None
        whole = np.interp(times, times[good], readings[good])
        usual = float(np.quantile(np.abs(np.diff(whole)), 0.95))
        good &= np.abs(whole - median_filter(whole, 5, mode="constant")) <= MISREAD * usual
        if good.sum() < 4 * WINDOW:
            return None
        whole = np.interp(times, times[good], whole[good])
        step = float(np.median(np.diff(times)))
        velocity = _smooth(whole, 1) / step
        off = whole - _smooth(whole)
        # steps of the computer's own clock that are longer or shorter move the arm, too
        uneven = times - _smooth(times)
        weight = good & (np.abs(off) < np.abs(velocity) * 3.0 * step)
        return cls(times, np.where(weight, velocity, 0.0), off - velocity * uneven)

    @property
    def moves(self) -> float:
        """Sum of the squared velocities."""
        return float((self.velocity**2).sum())

    def fit(self, period: float) -> tuple[float, float, float]:
        """Best phase [s], squares that its sawtooth explains, and how much of it is there."""
        phases = period * np.arange(PHASES) / PHASES
        old = age(self.times, period, 0.0) - phases[:, None]
        lag = -self.velocity * np.where(old < 0.0, old + period, old)
        teeth = lag - _smooth(lag)
        along = teeth @ np.where(self.velocity != 0.0, self.off, 0.0)
        squares = np.maximum((teeth**2).sum(-1), TINY)
        k = int(np.argmax(np.maximum(along, 0.0) ** 2 / squares))
        return float(phases[k]), float(along[k] ** 2 / squares[k]), float(along[k] / squares[k])


def _smooth(values: Array, derivative: int = 0) -> Array:
    """Local cubics through evenly spaced values, (..., num_samples), or their slopes per sample."""
    from scipy.ndimage import correlate1d  # dear to load

    within = _smoother(derivative)
    half = WINDOW // 2
    out = np.asarray(correlate1d(values, within[half], axis=-1))
    out[..., :half] = values[..., :WINDOW] @ within[:half].T
    out[..., -half:] = values[..., -WINDOW:] @ within[-half:].T
    return out


@cache
def _smoother(derivative: int) -> Array:
    """What ``WINDOW`` values make of each of them: the middle row holds anywhere, those before and
    after it at the ends of a record. A filter made for each call fits the ends anew each time."""
    from numpy.polynomial.polynomial import polyder, polyvander

    at = np.arange(WINDOW) - WINDOW // 2.0
    shown = polyder(np.eye(DEGREE + 1), derivative)
    return np.asarray(
        polyvander(at, DEGREE - derivative) @ shown @ np.linalg.pinv(polyvander(at, DEGREE))
    )


def age(times: Array, period: float, phase: float | Array) -> Array:
    """How old readings are, (..., num_samples) [s].

    Args:
        times: When they were read [s].
        period: Of the sensor's clock [s].
        phase: A tick of it [s], () or (..., 1).
    """
    return np.asarray(np.mod(times - phase, period))


def phase_of(times: Array, readings: Array, period: float) -> float:
    """A tick of the sensor's clock in one record [s]; 0 where it does not move.

    Args:
        times: When samples were read, (num_samples,) [s].
        readings: What was read, NaN where nothing was.
        period: Of the sensor's clock [s].
    """
    lags = _Lags.of(times, readings)
    return 0.0 if lags is None else lags.fit(period)[0]


def refresh_period(records: Iterable[tuple[Array, Array]]) -> float | None:
    """Period of a sensor's own clock [s], from records alone; None where there is none.

    Of long records a part is looked at first: where that shows no clock, the whole does not.

    Args:
        records: Times (num_samples,) [s] and readings (num_samples,) of each record.
    """
    say_stage("clocks of sensors")
    whole = list(records)
    if any(len(times) > PART for times, _ in whole):
        found = _best_period([_most_moving(times, readings) for times, readings in whole])
        if found is None or found[1] < HINT * EXPLAINED:
            return None
    found = _best_period(whole)
    return None if found is None or found[1] < EXPLAINED else found[0]


def _most_moving(times: Array, readings: Array) -> tuple[Array, Array]:
    """The part of ``PART`` samples in which readings change most, or all."""
    if len(times) <= PART:
        return times, readings
    changes = np.nan_to_num(np.abs(np.diff(readings, prepend=readings[:1])))
    total = np.concatenate([[0.0], np.cumsum(changes)])
    start = int(np.argmax(total[PART:] - total[:-PART]))
    return times[start : start + PART], readings[start : start + PART]


def _best_period(records: Iterable[tuple[Array, Array]]) -> tuple[float, float] | None:
    """Period of the clock that explains most [s], and the share of the squares that it explains."""
    found = sorted(
        (lags for lags in starmap(_Lags.of, records) if lags is not None and lags.moves > 0.0),
        key=lambda lags: -lags.moves,
    )[:MAX_PERIOD_RECORDS]
    if not found:
        return None
    step = float(np.mean(np.diff(found[0].times)))
    # readings at even times show the beat alone, which several periods would make
    beats, power = _spectrum(found, step)
    fine, inner = float(beats[1]), power[1:-1]
    peaks = 1 + np.flatnonzero((inner >= power[:-2]) & (inner >= power[2:]))
    strongest = beats[peaks[np.argsort(-power[peaks])][:CANDIDATES]]
    rates = {
        abs(n / step + side * beat) for beat in strongest for n in range(4) for side in (-1, 1)
    }
    tried = [1.0 / r for r in rates if 1.0 / LONGEST < r * step < 1.0 / SHORTEST]
    if not tried:
        return None
    first, period = max((_explain_rows(found, period), period) for period in tried)
    if first < HINT * EXPLAINED:
        return period, first
    rate = 1.0 / period
    ways = [1.0 / (rate + k * fine / 4.0) for k in range(-3, 4)]
    # the coarse period decides whether there is a clock: refining only makes it exact
    return max(ways, key=lambda period: _explain_rows(found, period)), first


def _spectrum(found: list[_Lags], step: float) -> tuple[Array, Array]:
    """Frequencies up to half a rate of samples [Hz], and the power of all records there.

    Samples are put on the next place of an even grid, two places a sample: linear in their number.
    """
    from scipy.fft import next_fast_len, rfft  # dear to load

    place = step / 2.0
    longest = max(float(np.ptp(lags.times)) for lags in found)
    count = next_fast_len(round(FINE * longest / place), real=True)
    beats = np.arange(count // 4 + 1) / (count * place)
    power = np.zeros(len(beats))
    for lags in found:
        at = np.round((lags.times - lags.times[0]) / place).astype(np.int64) % count
        grid = np.bincount(at, lags.velocity * lags.off, count)
        power += np.abs(rfft(grid)[: len(beats)]) ** 2 / lags.moves
    return beats, power


def _explain_rows(found: list[_Lags], period: float) -> float:
    """Share of the squares that a clock of a period explains; 0 where its sawtooth is not whole."""
    total = sum(float((lags.off[lags.velocity != 0.0] ** 2).sum()) for lags in found)
    fits = [lags.fit(period) for lags in found]
    is_full = FULL[0] < float(np.median([size for _, _, size in fits])) < FULL[1]
    return is_full * sum(gain for _, gain, _ in fits) / max(total, TINY)
