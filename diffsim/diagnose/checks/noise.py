"""Noise floor of the recordings, and what whitens it; whether what is left is white; samples that
sensors made, which are left out: spikes, and jumps of measured commands."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse, special
from scipy.ndimage import median_filter

from diffsim.core.arrays import Array, Mask
from diffsim.core.memo import Memo
from diffsim.core.numbers import SD_OVER_MAD
from diffsim.data.command_jumps import jumps_of, without_jumps
from diffsim.data.signal import noise_std, rounding_sd, scatter
from diffsim.data.study import Channel, Command, Run
from diffsim.identify import Fit

MAX_ORDER = 4
UNREPEATABLE = 1.4  # clean data of the prototypes: at most 1.38
SCATTER_CHANCE = 1e-3  # of so large a scatter where the noise is as stated: repeats are few
MIN_DEVIATIONS = 20  # independent deviations, from which on they tell the scatter and its color
SPIKE = 6.0  # robust standard deviations from the neighbors' median
MAX_SPIKES = 0.03  # a larger share is no spikes, but a heavy-tailed sensor
BY_CHANCE = 0.05  # of so many spikes in a run, where the largest share is the true one
STATED = "stated sd"
COLORED = "stated sd, color of what is left"
REPEATED = "stated sd, color of repeats"


class ArWhitener:
    """Whitens autoregressive noise, channel by channel; samples are taken as evenly spaced.

    x_t = sum_k a_k x_{t-k} + e_t: a row is e_t / sd(e). Where a stretch without gaps begins, the
    stationary covariance stands for the missing past, so that |W x|^2 is the exact Gaussian form.

    Args:
        sd: Standard deviation of the noise itself, (num_channels,) [unit of the channel].
        coefficients: Autoregressive coefficients a_1, a_2, ... by channel.
    """

    def __init__(self, sd: Array, coefficients: Sequence[Array]):
        self.sd, self.coefficients = np.asarray(sd, dtype=np.float64), tuple(coefficients)
        self._made: Memo[sparse.csr_array] = Memo()

    def matrix(self, run: Run) -> sparse.csr_array:
        """(num_valid, num_samples * num_channels), sparse; made once per run."""
        return self._made(run, lambda: self._make(run))

    def is_like(self, other: ArWhitener) -> bool:
        """Whether another one whitens alike, to the digits that a file keeps."""
        pairs = zip((self.sd, *self.coefficients), (other.sd, *other.coefficients), strict=True)
        return all(len(a) == len(b) and np.allclose(a, b, rtol=1e-9) for a, b in pairs)

    def _make(self, run: Run) -> sparse.csr_array:
        num_samples, num_channels = run.measured.shape
        rows, cols, values, count = [], [], [], 0
        for c in range(num_channels):
            for start, stop in _stretches(np.isfinite(run.measured[:, c])):
                block = _whitening_block(stop - start, self.coefficients[c]).tocoo()
                rows.append(block.row + count)
                cols.append((block.col + start) * num_channels + c)
                values.append(block.data / self.sd[c])
                count += stop - start
        matrix = sparse.coo_array(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))),
            shape=(count, num_samples * num_channels),
        )
        return matrix.tocsr()


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Noise of the sensors: the smallest misfit that any model can reach.

    Attributes:
        whitener: Transformation that makes residuals white with standard deviation one.
        sd: Standard deviation of the noise, (num_channels,) [unit of the channel].
        source: "repeats", "stated sd" with or without a color, "second differences" or "rounding",
            by channel.
        scatter_ratio: Scatter of repeats over the stated sensor noise, (num_channels,); NaN where
            either is missing: repeatability cannot be judged then.
        scatter_freedom: Independent deviations behind each ratio, (num_channels,).
    """

    whitener: ArWhitener
    sd: Array
    source: tuple[str, ...]
    scatter_ratio: Array
    scatter_freedom: Array

    @property
    def is_repeatable(self) -> bool:
        """False if a channel's repeats scatter more than 1.4 times the sensor noise, and more than
        chance makes of the channel that scatters most (chi-squared, Bonferroni)."""
        ratio, freedom = self.scatter_ratio, self.scatter_freedom
        is_large = ratio > UNREPEATABLE
        chance = special.chdtrc(freedom[is_large], freedom[is_large] * ratio[is_large] ** 2)
        return not bool((chance * np.isfinite(ratio).sum() < SCATTER_CHANCE).any())


def noise_floor(
    runs: Sequence[Run],
    channels: Sequence[Channel],
    left: Mapping[str, Array],
    *,
    explained: bool = False,
) -> NoiseFloor:
    """Noise from repeats, else from the stated sd, else from second differences.

    It is at least what rounding does to the readings, whose repeats may be equal to the last digit.
    Repeats in which something recorded differs, such as a temperature that the model does not use,
    are no repeats where they scatter more than the stated sd: that may be the effect of it.
    Readings of repeats that differ by less than what a model leaves of them do not scatter: a model
    tells apart what is alike, as a drift over the runs' order does. Where repeats hold few
    independent samples a stated sd is the better estimate, and they tell its color alone.

    Args:
        runs: Runs to be fitted.
        channels: Columns of their ``measured``.
        left: Measured minus predicted by run, (num_samples, num_channels) [unit of the channel];
            set-up nuisances of each run must have been fitted, or they would pass as scatter.
        explained: Whether the best set of causes left it: without repeats, its color is the
            noise's where its size is.

    Raises:
        ValueError: a channel without noise at all.
    """
    deviations, is_alike = repeat_deviations(runs, left), not _repeats_differ(runs)
    recorded = repeat_deviations(runs, {run.name: run.measured for run in runs})
    sd, source, ratio, freedoms, coefficients = [], [], [], [], []
    for c, channel in enumerate(channels):
        pair = ([d[:, c] for d in those] for those in (deviations, recorded))
        series = min(pair, key=lambda parts: sum(float(np.nansum(x**2)) for x in parts))
        values = np.concatenate([*series, np.zeros(0)])
        values = values[np.isfinite(values)]
        measured = (
            float(np.sqrt(np.mean(values**2))) if len(values) > MIN_DEVIATIONS else float("nan")
        )
        color = fit_ar(series)
        freedom = _freedom(runs, series, color)
        stated = channel.sd
        more = measured / stated if stated is not None else np.nan
        if not is_alike and more > 1.0 and _is_of_own_size(more**2, freedom):
            measured = more = np.nan
        ratio.append(more)
        freedoms.append(freedom)
        is_scatter = np.isfinite(measured) and not ratio[-1] > UNREPEATABLE
        if is_scatter and (stated is None or freedom > MIN_DEVIATIONS):
            sd.append(measured)
            source.append("repeats")
            coefficients.append(color)
        elif is_scatter and stated is not None and len(color):
            sd.append(stated)
            source.append(REPEATED)
            coefficients.append(color)
        elif stated is not None:
            sd.append(stated)
            rest = [left[r.name][:, c] for r in runs] if explained else []
            coefficients.append(fit_color(rest, stated))
            source.append(COLORED if len(coefficients[-1]) else STATED)
        else:
            sd.append(float(np.median([noise_std(r.measured[:, c]) for r in runs])))
            source.append("second differences")
            coefficients.append(np.zeros(0))
        rounding = rounding_sd(np.concatenate([r.measured[:, c] for r in runs]))
        if rounding > sd[-1]:
            sd[-1], source[-1], coefficients[-1] = rounding, "rounding", np.zeros(0)
        if not sd[-1] > 0.0:
            raise ValueError(
                f"channel {channel.name} has no noise (sd {sd[-1]:g} {channel.unit}); state its sd"
            )
    whitener = ArWhitener(np.array(sd), coefficients)
    return NoiseFloor(whitener, np.array(sd), tuple(source), np.array(ratio), np.array(freedoms))


def _freedom(runs: Sequence[Run], series: Sequence[Array], color: Array) -> float:
    """Independent deviations in series: k runs have k - 1 of each sample."""
    lengths: dict[str, list[int]] = defaultdict(list)
    for run in runs:
        lengths[run.group].append(len(run.time_s))
    groups = [(len(g), min(g)) for g in lengths.values() if len(g) > 1]
    total = sum(k * length for k, length in groups)
    if not total:
        return 0.0
    share = sum((k - 1) * length for k, length in groups) / total
    count = sum(int(np.isfinite(x).sum()) for x in series)
    return share * _num_squares(color, count)


def repeat_deviations(runs: Sequence[Run], left: Mapping[str, Array]) -> list[Array]:
    """Deviations from the mean of each group of repeats, scaled to the sd of a single run.

    Groups whose runs differ in length are cut to the shortest.
    """
    groups: dict[str, list[Array]] = defaultdict(list)
    for run in runs:
        groups[run.group].append(left[run.name])
    out = []
    for members in groups.values():
        k = len(members)
        if k < 2:
            continue
        length = min(len(m) for m in members)
        stack = np.stack([m[:length] for m in members])
        out += list((stack - stack.mean(axis=0)) * np.sqrt(k / (k - 1)))
    return out


def _repeats_differ(runs: Sequence[Run]) -> bool:
    """Whether a condition that was recorded beside the channels differs between repeats, by more
    than its own noise: from the start on, unlike what the motion or a ripple makes."""
    for name in runs[0].columns if runs else ():
        values = {run.name: run.columns[name][:, None] for run in runs}
        parts = repeat_deviations(runs, values)
        deviations = np.concatenate([*parts, np.zeros((0, 1))])
        seen = deviations[np.isfinite(deviations)]
        noise = [scatter(np.diff(run.columns[name], n=2), 2) for run in runs]
        is_off = len(seen) and np.sqrt(np.mean(seen**2)) > UNREPEATABLE * np.nanmedian(noise)
        read = [d[np.isfinite(d)] for d in parts if np.isfinite(d).any()]
        begins = [np.mean(d[: max(len(d) // MIN_DEVIATIONS, 1)]) for d in read]
        if is_off and np.mean(np.square(begins)) > 0.5 * np.mean(seen**2):
            return True
    return False


def fit_ar(series: Sequence[Array], max_order: int = MAX_ORDER) -> Array:
    """Coefficients of an autoregressive model, order by the Bayesian information criterion.

    Yule-Walker on the autocovariance pooled over all series; gaps are left out.
    """
    lags = range(max_order + 1)
    sums, counts = np.zeros(max_order + 1), np.zeros(max_order + 1)
    for x in series:
        for k in lags:
            product = x[k:] * x[: max(len(x) - k, 0)]
            valid = np.isfinite(product)
            sums[k] += product[valid].sum()
            counts[k] += valid.sum()
    if not counts.all() or sums[0] <= 0.0:
        return np.zeros(0)
    covariance = sums / counts[0]  # the biased estimate is positive definite
    best, best_score = np.zeros(0), counts[0] * np.log(covariance[0])
    for p in range(1, max_order + 1):
        a = linalg.solve_toeplitz(covariance[:p], covariance[1 : p + 1])
        variance = covariance[0] - a @ covariance[1 : p + 1]
        score = counts[0] * np.log(variance) + p * np.log(counts[0])
        if variance > 0.0 and score < best_score:
            best, best_score = a, score
    return best


def fit_color(series: Sequence[Array], sd: float) -> Array:
    """Autoregressive coefficients of noise whose sd is stated; none where it is white, or where
    what is left is more or less than that noise: its color is not the sensor's then, but that of
    what acts, or of what nobody stated. None either where the recordings are short against the
    memory of that color: what it remembers is seen too few times to be told from a drift.

    Both by the Bayesian information criterion: the coefficients against white noise of the same
    sd, and an sd of its own against the stated one. How many independent samples have as certain a
    mean as these, for the memory, or as certain a mean square, for the sd, is told by the color
    (Bayley and Hammersley 1946, "The 'effective' number of independent observations in an
    autocorrelated time series").

    Args:
        series: What the best set leaves, by run; NaN where nothing was measured [unit of sd].
    """
    none = np.zeros(0)
    parts = [x[start:stop] / sd for x in series for start, stop in _stretches(np.isfinite(x))]
    a, num_samples = fit_ar(parts), sum(map(len, parts))
    # nothing is left, it is white, or its memory is too long to be seen
    if not len(a) or _num_independent(a, num_samples) < MIN_DEVIATIONS:
        return none
    blocks = {length: _whitening_block(length, a) for length in set(map(len, parts))}
    chi2 = float(sum(np.sum((blocks[len(x)] @ x) ** 2) for x in parts))
    log_dets = {length: np.log(block.diagonal()).sum() for length, block in blocks.items()}
    log_det = float(sum(log_dets[len(x)] for x in parts))
    gained = 0.5 * (sum(float(x @ x) for x in parts) - chi2) + log_det
    price = 0.5 * float(np.log(num_samples))
    has_stated_size = not _is_of_own_size(chi2 / num_samples, _num_squares(a, num_samples))
    return a if gained > len(a) * price and has_stated_size else none


def _is_of_own_size(ratio: float, num_samples: float) -> bool:
    """Whether the Bayesian information criterion asks for another sd than the stated one.

    Args:
        ratio: Mean square over the stated variance.
        num_samples: Number of independent squares.
    """
    gained = 0.5 * num_samples * (ratio - 1.0 - np.log(ratio))
    return bool(gained > 0.5 * np.log(num_samples))


def _num_independent(a: Array, num_samples: int) -> float:
    """Independent samples whose mean is as certain as that of autoregressive ones: their spectrum
    at zero frequency tells."""
    innovation = 1.0 - a @ _autocorrelation(a, len(a) + 1)[1 : len(a) + 1]
    return float(num_samples * (1.0 - a.sum()) ** 2 / innovation)


def _num_squares(a: Array, num_samples: int) -> float:
    """Independent samples whose mean square is as certain as that of autoregressive ones: one in
    1 + 2 sum rho_k^2."""
    # samples over which a color is followed
    rho = _autocorrelation(a, 1000) if len(a) else np.ones(1)
    return float(num_samples / (2.0 * np.sum(rho**2) - 1.0))


def without_misread(run: Run, commands: Sequence[Command]) -> tuple[Run, int]:
    """A run without the jumps of its measured commands.

    What is commanded may jump, so that other commands stay.

    Args:
        run: Run as it was recorded.
        commands: What is known of commands.

    Returns:
        The run, the same object where nothing jumps, and the number of jumps.
    """
    mended, count = dict(run.command), 0
    for name in (c.name for c in commands if c.is_measured and c.name in run.command):
        values = run.command[name]
        jumps = jumps_of(values, is_measured=True, times=run.time_s)
        if num := len(jumps.back) + len(jumps.lasting):
            mended[name] = without_jumps(values, run.time_s, jumps)
            count += num
    return (replace(run, command=mended), count) if count else (run, 0)


def choose_commands(
    run: Run, commands: Sequence[Command], left: Callable[[Run], Array], sd: Array
) -> tuple[Run, int]:
    """A run with its measured commands as recorded, or without jumps: as the model is nearer.

    Without them where both are as near, such as for a model that does not use the command: a
    motion cannot jump, and what a record shows of a jump is seen in the channels.

    Args:
        run: Run as it was recorded.
        commands: What is known of commands.
        left: Measured minus predicted in a run, (num_samples, num_channels) [unit of the channel].
        sd: Standard deviation of the noise, (num_channels,) [unit of the channel].

    Returns:
        The run, and the number of jumps that were taken out.
    """
    mended, count = without_misread(run, commands)
    if not count:
        return run, 0
    as_recorded, without = (float(np.nansum((left(r) / sd) ** 2)) for r in (run, mended))
    return (run, 0) if as_recorded < without else (mended, count)


def without_spikes(
    runs: Sequence[Run], lefts: Sequence[Array], usual: Array | None = None
) -> tuple[tuple[Run, ...], int]:
    """Runs with isolated spikes marked as missing, and how many there were in all.

    A spike is a sample of the residual far from the median of itself and its four neighbors; what
    lasts longer than two samples is not one. Their share is judged over all runs; a run that has
    more than chance makes of the largest share is simulated wrongly there, and keeps all.

    Args:
        runs: All runs of a study.
        lefts: Measured minus predicted, (num_samples, num_channels) for each.
        usual: Noise that is stated, (num_channels,) [unit of the channel]: a sensor that stands
            still for a while, between two counts, has none of its own there. None: not stated.
    """
    spikes = [_find_spikes(left, usual) for left in lefts]
    if sum(int(s.sum()) for s in spikes) > MAX_SPIKES * sum(s.size for s in spikes):
        return tuple(runs), 0
    spikes = [s & (special.pdtrc(s.sum() - 1, MAX_SPIKES * s.size) > BY_CHANCE) for s in spikes]
    count = sum(int(s.sum()) for s in spikes)
    each = zip(runs, spikes, strict=True)
    cleaned = [
        replace(r, measured=np.where(s, np.nan, r.measured)) if s.any() else r for r, s in each
    ]
    return tuple(cleaned), count


def _find_spikes(left: Array, usual: Array | None) -> Mask:
    away = np.abs(left - median_filter(left, size=(5, 1), mode="nearest"))
    # a channel that was never measured, or never five samples in a row, has no scale
    scale = np.zeros(away.shape[1])
    seen = np.isfinite(away).any(axis=0)
    scale[seen] = SD_OVER_MAD * np.nanmedian(away[:, seen], axis=0)
    if usual is not None:
        scale = np.maximum(scale, usual)
    return np.asarray(away > SPIKE * np.where(scale > 0.0, scale, np.inf))


def _stretches(valid: Mask) -> list[tuple[int, int]]:
    """[start, stop) of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _whitening_block(length: int, a: Array) -> sparse.sparray:
    """(length, length) whitening of a stretch of noise with standard deviation one."""
    p = min(len(a), length)
    if len(a) == 0:
        return sparse.eye_array(length)
    rho = _autocorrelation(a, max(p, 1))
    innovation = np.sqrt(1.0 - a @ _autocorrelation(a, len(a) + 1)[1 : len(a) + 1])
    start = linalg.inv(linalg.cholesky(linalg.toeplitz(rho[:p]), lower=True))
    top = sparse.hstack([sparse.csr_array(start), sparse.csr_array((p, length - p))])
    if length <= len(a):
        return top
    diagonals = [np.full(length - p, c / innovation) for c in [*(-a[::-1]), 1.0]]
    rest = sparse.diags_array(diagonals, offsets=range(p + 1), shape=(length - p, length))
    return sparse.vstack([top, rest])


def _autocorrelation(a: Array, count: int) -> Array:
    """rho_0 .. rho_{count-1} of x_t = sum a_k x_{t-k} + e_t, from the Yule-Walker equations."""
    p = len(a)
    system, right = np.eye(p), a.copy()
    for k in range(1, p + 1):  # rho_k - sum_j a_j rho_|k-j| = 0, rho_0 = 1
        for j in range(1, p + 1):
            if k != j:
                system[k - 1, abs(k - j) - 1] -= a[j - 1]
    rho = [1.0, *np.linalg.solve(system, right)]
    while len(rho) < count:
        rho.append(float(a @ np.array(rho[-1 : -p - 1 : -1])))
    return np.array(rho[:count])


def ljung_box(fit: Fit) -> Array:
    """(num_channels,) probability that white residuals are at least as correlated as these.

    Q = n (n + 2) sum_k r_k^2 / (n - k) ~ chi2(10), summed over runs (Ljung and Box 1978, "On a
    measure of lack of fit in time series models"). Residuals are whitened by the noise floor;
    missing samples join what lies on both sides. Lags are ten, or a fifth of a run's samples where
    that is fewer.

    Returns:
        NaN where a channel has too few samples.
    """
    problem, start = fit.problem, 0
    num_channels = problem.runs[0].measured.shape[1]
    statistic, freedom = np.zeros(num_channels), np.zeros(num_channels)
    for run in problem.runs:
        matrix = problem.whitener.matrix(run)
        left = fit.residual[start : start + matrix.shape[0]]
        start += matrix.shape[0]
        # a row belongs to its newest sample: the largest column it uses
        newest = np.maximum.reduceat(matrix.indices, matrix.indptr[:-1])
        for c in range(num_channels):
            own = left[newest % num_channels == c]
            count = min(10, len(own) // 5)
            if count:
                statistic[c] += _statistic(own, count)
                freedom[c] += count
    return np.where(freedom > 0, special.chdtrc(np.maximum(freedom, 1), statistic), np.nan)


def _statistic(x: Array, lags: int) -> float:
    n, power = len(x), float(x @ x)
    r = np.array([x[k:] @ x[: n - k] / power for k in range(1, lags + 1)])
    return float(n * (n + 2) * (r**2 / (n - np.arange(1, lags + 1))).sum())
