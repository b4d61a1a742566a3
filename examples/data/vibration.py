"""Analysis of a free vibration: frequency, damping, sag, creep, repeatability.

Nothing here knows of a simulator. Two independent routes to frequency and damping (peaks, and a
fitted decaying sinusoid) so that each can be held against the other.

Damping ratio zeta: an oscillation shrinks by exp(-2 pi zeta / sqrt(1 - zeta^2)) per cycle.
Frequencies are those of the damped oscillation, as seen in the record, unless a name says
``undamped``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, optimize

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Decay:
    """A fitted x(s) = offset + drift d(s) + exp(-sigma s) (a cos ws + b sin ws), s = t - t[0]."""

    frequency_Hz: float  # damped frequency w / (2 pi) [Hz]
    damping_ratio: float  # sigma / sqrt(sigma^2 + w^2)
    amplitude: float  # amplitude of the oscillation at s = 0 [unit of x]
    phase: float  # atan2(-b, a): x ~ amplitude cos(ws + phase) [rad]
    offset: float  # the level at the end of the record towards which the oscillation settles
    drift: float  # change of that level over the record (creep); 0 if not fitted
    rms: float  # root mean square of what the fit leaves, unit of x
    # frequency_std_Hz, damping_ratio_std: one standard deviation, taking what is left as white
    # noise; an underestimate where the model itself is wrong
    frequency_std_Hz: float
    damping_ratio_std: float
    num_samples: int  # number of samples fitted


def fit_decay(
    time_s: Array, x: Array, *, frequency_Hz: float | None = None, drift: str = "log"
) -> Decay:
    """Fit one decaying sinusoid on a level that may creep.

    Variable projection: only (sigma, w) are searched; level, drift and the two amplitudes follow
    by linear least squares.

    Args:
        time_s: Times of the samples, (T,) [s].
        x: (T,) one coordinate, without gaps.
        frequency_Hz: Start value of the frequency [Hz]; by default the largest spectral peak.
        drift: ``"none"``, ``"linear"``, or ``"log"``: level ~ log(1 + s / 0.1 s), the slow
            settling of a rubber.

    Returns:
        ``Decay``.

    Raises:
        ValueError: fewer than 12 samples, gaps, or less than one cycle.
    """
    time_s, x = _series(time_s, x, min_samples=12)
    s = time_s - time_s[0]
    start = frequency_Hz if frequency_Hz is not None else dominant_frequency(time_s, x)
    if start * s[-1] < 1.0:
        raise ValueError(
            f"the record of {s[-1]:.3g} s holds {start * s[-1]:.2f} cycles of {start:.3g} Hz; "
            "a decay needs at least one"
        )
    shapes = {
        "none": np.empty((len(s), 0)),
        "linear": (s / s[-1])[:, None],
        "log": np.log1p(s / 0.1)[:, None] / np.log1p(s[-1] / 0.1),
    }
    if drift not in shapes:
        raise ValueError(f"drift must be one of {list(shapes)}, got {drift!r}")
    scale = max(float(np.std(x)), 1e-300)

    def basis(p: Array) -> Array:
        envelope = np.exp(-p[0] * s)
        wave = [envelope * np.cos(p[1] * s), envelope * np.sin(p[1] * s), np.ones_like(s)]
        return np.column_stack([*wave, shapes[drift]])

    def residual(p: Array) -> Array:
        phi = basis(p)
        return (phi @ np.linalg.lstsq(phi, x, rcond=None)[0] - x) / scale

    w0 = 2.0 * np.pi * start
    best = None
    for zeta in (0.01, 0.05, 0.2):  # three starts: the cost has side minima in w
        solution = optimize.least_squares(
            residual,
            [zeta * w0, w0],
            x_scale=[0.05 * w0, 0.05 * w0],
            bounds=([-0.2 * w0, 0.3 * w0], [3.0 * w0, 3.0 * w0]),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        best = solution if best is None or solution.cost < best.cost else best
    assert best is not None
    sigma, w = (float(value) for value in best.x)
    phi = basis(best.x)
    coeff = np.linalg.lstsq(phi, x, rcond=None)[0]
    left = x - phi @ coeff
    std = _standard_errors(best.x, coeff, s, basis, left)
    total = float(np.hypot(sigma, w))
    return Decay(
        frequency_Hz=w / (2 * np.pi),
        damping_ratio=sigma / total,
        amplitude=float(np.hypot(coeff[0], coeff[1])),
        phase=float(np.arctan2(-coeff[1], coeff[0])),
        offset=float(coeff[2] + coeff[3:].sum()),
        drift=float(coeff[3:].sum()),
        rms=float(np.sqrt(np.mean(left**2))),
        frequency_std_Hz=float(std[1] / (2 * np.pi)),
        # d zeta = (w^2 d sigma - sigma w dw) / total^3
        damping_ratio_std=float(np.hypot(w * w * std[0], sigma * w * std[1]) / total**3),
        num_samples=len(s),
    )


def _standard_errors(
    p: Array, coeff: NDArray[Any], s: Array, basis: Callable[[Array], Array], left: Array
) -> Array:
    """sqrt(diag(sigma^2 (J'J)^-1)) of all unknowns, nonlinear ones first; J by differences."""
    columns = []
    for i in range(len(p)):
        step = np.zeros_like(p)
        step[i] = 1e-6 * max(abs(p[i]), 1e-3)
        columns.append((basis(p + step) - basis(p - step)) @ coeff / (2 * step[i]))
    jacobian = np.column_stack([*columns, basis(p)])
    freedom = max(len(s) - jacobian.shape[1], 1)
    scale = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    return np.sqrt(np.diag(covariance) * (left @ left) / freedom)


def decay_by_window(
    time_s: Array, x: Array, *, cycles: float = 3.0, frequency_Hz: float | None = None
) -> list[tuple[float, Decay]]:
    """Frequency and damping against amplitude: one fit per window of ``cycles`` cycles.

    Returns:
        (start of the window [s], Decay) for consecutive windows that overlap by half.
    """
    time_s, x = _series(time_s, x, min_samples=12)
    start = frequency_Hz if frequency_Hz is not None else dominant_frequency(time_s, x)
    length = cycles / start
    fits = []
    for begin in np.arange(time_s[0], time_s[-1] - length + 1e-9, length / 2):
        inside = (time_s >= begin - 1e-9) & (time_s <= begin + length + 1e-9)
        if inside.sum() >= 12:
            fit = fit_decay(time_s[inside], x[inside], frequency_Hz=start, drift="linear")
            fits.append((float(begin), fit))
    return fits


@dataclass(frozen=True)
class Swings:
    """Turning points of an oscillation, located between samples by a cubic spline."""

    time_s: Array  # (N,) times of the turning points [s]
    value: Array  # value of x at each turning point, (N,) [unit of x]
    height: Array  # (N-1,) |difference| of neighbors: free of the level the oscillation settles to
    frequency_Hz: float  # frequency from the mean time between turning points [Hz]
    # damping ratio from the slope of log(height) over turning points (logarithmic decrement) [-]
    damping_ratio: float


def swings(time_s: Array, x: Array, *, smallest: float = 0.02) -> Swings:
    """Logarithmic decrement from neighboring turning points.

    Args:
        time_s: Times of the samples, (T,) [s].
        x: (T,) one coordinate, without gaps.
        smallest: Stop where a swing falls below this share of the first one (noise and creep).

    Raises:
        ValueError: fewer than three turning points.
    """
    time_s, x = _series(time_s, x, min_samples=8)
    spline = interpolate.CubicSpline(time_s, x)
    turns = spline.derivative().roots(extrapolate=False)
    turns = turns[(turns > time_s[0]) & (turns < time_s[-1])]
    value = np.asarray(spline(turns))
    height = np.abs(np.diff(value))
    if len(height):
        small = np.flatnonzero(height < smallest * height.max())
        last = int(small[0]) if len(small) else len(height)
        turns, value, height = turns[: last + 1], value[: last + 1], height[:last]
    if len(height) < 2:
        raise ValueError(
            f"{len(turns)} turning points in {time_s[-1] - time_s[0]:.3g} s; a decrement needs "
            "at least three (is the record too short, or overdamped?)"
        )
    slope, _ = np.polyfit(np.arange(len(height)), np.log(height), 1, w=height)
    # per half cycle: -slope = pi zeta / sqrt(1 - zeta^2)
    rate = -slope / np.pi
    half = np.polyfit(np.arange(len(turns)), turns, 1)[0]
    return Swings(turns, value, height, float(0.5 / half), float(rate / np.sqrt(1 + rate**2)))


def dominant_frequency(time_s: Array, x: Array) -> float:
    """Frequency of the largest spectral peak above one cycle per record [Hz]."""
    time_s, x = _series(time_s, x, min_samples=8)
    frequency, amplitude = amplitude_spectrum(time_s, x)
    allowed = frequency >= 1.0 / (time_s[-1] - time_s[0])
    return float(frequency[allowed][np.argmax(amplitude[allowed])])


def amplitude_spectrum(time_s: Array, x: Array, *, pad: int = 4) -> tuple[Array, Array]:
    """One-sided amplitude spectrum of a transient, linear trend and window removed.

    A half Hann window falls from 1 at the start to 0 at the end: a decay starts at full height,
    and its end has been reached already.

    Returns:
        frequency [Hz] and amplitude, unit of x: a steady sinusoid of amplitude A gives about A.
    """
    from scipy import signal as sps  # half a second that few calls need

    time_s, x = _series(time_s, x, min_samples=8)
    step = float(np.median(np.diff(time_s)))
    grid = time_s[0] + step * np.arange(round((time_s[-1] - time_s[0]) / step) + 1)
    even = np.interp(grid, time_s, x)
    window = np.hanning(2 * len(even))[len(even) :]
    even = sps.detrend(even, type="linear") * window
    frequency, power = sps.periodogram(
        even, fs=1.0 / step, nfft=pad * len(even), detrend=False, scaling="spectrum"
    )
    # periodogram scales by the squared sum of its own (box) window; ours sums to window.sum()
    return frequency, np.sqrt(2.0 * power) * len(even) / window.sum()


@dataclass(frozen=True)
class Level:
    """Level at which a record settles."""

    value: float  # mean over the last ``span_s`` seconds
    std: float  # scatter there, drift removed
    # change of the level per tenfold time since release, by a fit in log time over the last two
    # thirds of the record; a rubber creeps by a few per cent
    creep_per_decade: float
    span_s: float  # length of the stretch that was averaged [s]


def settled_level(time_s: Array, x: Array, *, span_s: float = 1.0, release_s: float = 0.0) -> Level:
    """Mean of the last ``span_s`` seconds and the creep that leads there."""
    time_s, x = _series(time_s, x, min_samples=8)
    if time_s[-1] - time_s[0] < span_s:
        raise ValueError(
            f"the record of {time_s[-1] - time_s[0]:.3g} s is shorter than span_s = {span_s:g} s"
        )
    end = time_s > time_s[-1] - span_s
    trend = np.polyfit(time_s[end], x[end], 1)
    late = time_s > release_s + (time_s[-1] - release_s) / 3
    creep = np.polyfit(np.log10(time_s[late] - release_s), x[late], 1)[0]
    return Level(
        value=float(x[end].mean()),
        std=float(np.std(x[end] - np.polyval(trend, time_s[end]))),
        creep_per_decade=float(creep),
        span_s=span_s,
    )


@dataclass(frozen=True)
class RepeatFloor:
    """Difference of two recordings of the same case: the best that any simulation can promise."""

    rms: Array  # (num_coordinates,) root mean square of the difference, aligned at release
    # (num_coordinates,) root mean square after the extra shift ``lag_s`` that makes the whole
    # difference least
    rms_best: Array
    lag_s: float  # that shift: positive if the second recording runs late
    peak: Array  # (num_coordinates,) largest difference, aligned at release
    difference: Array  # (N, num_coordinates) first minus second, aligned at release
    time_s: Array  # times since the release, (N,) [s]

    @property
    def total_rms(self) -> float:
        """Root mean square length of the difference vector."""
        return float(np.sqrt(np.sum(self.rms**2)))


def repeat_floor(
    first: tuple[Array, Array],
    second: tuple[Array, Array],
    *,
    until_s: float,
    max_lag_s: float = 0.02,
) -> RepeatFloor:
    """Difference of two recordings whose times count from their own release.

    Args:
        first, second: (time_s (T,), x (T, num_coordinates)) with 0 = release.
        until_s: Compare on [0, until_s] or up to the end of the shorter one.
        max_lag_s: Largest extra shift that is tried, to either side [s].
    """
    splines = [interpolate.CubicSpline(t, x) for t, x in (first, second)]
    end = min(until_s, first[0][-1], second[0][-1]) - max_lag_s
    if end <= 0:
        raise ValueError(f"no common time after release: until_s = {until_s:g} s")
    grid = np.arange(0.0, end, float(np.median(np.diff(first[0]))))

    def difference(lag: float) -> Array:
        return np.asarray(splines[0](grid) - splines[1](grid + lag))

    solution = optimize.minimize_scalar(
        lambda lag: float(np.mean(difference(lag) ** 2)),
        bounds=(-max_lag_s, max_lag_s),
        method="bounded",
    )
    at_release, best = difference(0.0), difference(float(solution.x))
    return RepeatFloor(
        rms=np.sqrt(np.mean(at_release**2, axis=0)),
        rms_best=np.sqrt(np.mean(best**2, axis=0)),
        lag_s=float(solution.x),
        peak=np.abs(at_release).max(axis=0),
        difference=at_release,
        time_s=grid,
    )


def first_crossing(time_s: Array, x: Array, threshold: float) -> tuple[int, float]:
    """First frame with x >= threshold, and the time of the crossing between frames.

    Raises:
        ValueError: never crossed, or beyond it from the first frame on.
    """
    beyond = np.flatnonzero(np.asarray(x) >= threshold)
    if len(beyond) == 0 or beyond[0] == 0:
        when = "already at the first frame" if len(beyond) else "never"
        raise ValueError(f"the signal reaches {threshold:g} {when}; no release can be found")
    frame = int(beyond[0])
    share = (threshold - x[frame - 1]) / (x[frame] - x[frame - 1])
    return frame, float(time_s[frame - 1] + share * (time_s[frame] - time_s[frame - 1]))


def _series(time_s: Array, x: Array, *, min_samples: int) -> tuple[Array, Array]:
    time_s, x = np.asarray(time_s, dtype=np.float64), np.asarray(x, dtype=np.float64)
    if time_s.ndim != 1 or x.shape != time_s.shape:
        raise ValueError(
            f"time_s and x must be one-dimensional and of equal length, got {time_s.shape} and "
            f"{x.shape}"
        )
    if len(x) < min_samples:
        raise ValueError(f"{len(x)} samples; at least {min_samples} are needed")
    if not (np.isfinite(x).all() and np.isfinite(time_s).all()):
        gaps = int((~np.isfinite(x)).sum())
        raise ValueError(f"x has {gaps} gaps; fill or cut them before a frequency analysis")
    return time_s, x
