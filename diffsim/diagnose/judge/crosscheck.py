"""Is what a fit leaves real? Repeats say so without any model of it, or of the noise.

With two repeats, mean and half-difference of the residuals have the same distribution if there is
nothing but noise; whatever is repeatable is in the mean only. Swapping them (with random signs) in
blocks of time gives the distribution of any statistic under noise alone: here of the energy of the
mean in the band, of all bands that are each twice as wide as the one before, where it stands out
most. No generic force is asked: one of too few knots explains nothing of what is fast.
Blocks far above the noise are first made smaller, mean and half-difference alike, so that two or
three of them cannot decide whatever the others say.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.data.study import Run
from diffsim.diagnose.checks.gates import REPEATED, GateResult
from diffsim.identify import Fit, Problem
from diffsim.identify.bandwidth import band_nats, octaves_of

BLOCK_S = 0.3
DRAWS = 200
LOUDEST = 3.0  # rms of a block, in noise sd: louder ones count as if they were as loud as that
SWAP_LIMIT = 0.02  # of noise alone: about three of 200 swapped draws may reach the statistic


def repeated_gate(fit: Fit, seed: int) -> tuple[GateResult, ...]:
    """Whether what a fit leaves is in the mean of repeats; none where repeats cannot tell.

    Args:
        fit: Fit whose residual is asked about.
        seed: Seed of the draws.
    """
    p = swap_probability(fit.problem, fit.residual, seed=seed)
    if p is None:
        return ()
    note = "chance that repeats as alike as these share nothing but noise"
    return (GateResult(REPEATED, p <= SWAP_LIMIT, p, SWAP_LIMIT, note),)


def swap_probability(problem: Problem, residual: Array, *, seed: int) -> float | None:
    """Share of swapped draws whose statistic reaches that of the mean residual.

    Args:
        residual: Whitened residual of the fit, (num_valid,).

    Returns:
        (hits + 1) / (draws + 1), or None where repeats are missing or too short for a test.
    """
    pairs = _pairs(problem.runs)
    labels = [_blocks(problem.runs[a]) for a, _ in pairs]
    if 0.5 ** sum(int(label.max()) + 1 for label in labels) > SWAP_LIMIT:
        return None  # so many draws swap nothing: no cause could be confirmed
    rows = zip(problem.runs, problem.by_run(residual), strict=True)
    grids = [problem.on_grid(run, own) for run, own in rows]
    # of two repeats, scaled to the noise of one
    mean = [np.sqrt(0.5) * (grids[a] + grids[b]) for a, b in pairs]
    half = [np.sqrt(0.5) * (grids[a] - grids[b]) for a, b in pairs]
    shares = [_shares(m, d, label) for m, d, label in zip(mean, half, labels, strict=True)]
    mean = [s * m for s, m in zip(shares, mean, strict=True)]
    half = [s * d for s, d in zip(shares, half, strict=True)]
    spans = [float(np.ptp(problem.runs[a].time_s)) for a, _ in pairs]
    stretches = [max(spans) / span if span > 0.0 else 1.0 for span in spans]

    def statistic(records: list[Array]) -> float:
        octaves = [octaves_of(r, s) for r, s in zip(records, stretches, strict=True)]
        return float(band_nats(octaves).max())

    rng, observed = np.random.default_rng(seed), statistic(mean)
    hits = 0
    for _ in range(DRAWS):
        drawn = []
        for m, d, label in zip(mean, half, labels, strict=True):
            count = label.max() + 1
            take = rng.integers(2, size=count)[label][:, None]
            sign = rng.choice([-1.0, 1.0], count)[label][:, None]
            drawn.append(sign * np.where(take, m, d))
        hits += statistic(drawn) >= observed
    return (hits + 1) / (DRAWS + 1)


def _shares(mean: Array, half: Array, label: IntArray) -> Array:
    """Factor of each sample, (num_samples, 1), that no block is above ``LOUDEST``.

    The same for mean and half-difference: under noise alone they stay exchangeable.
    """
    square = 0.5 * (mean**2 + half**2).mean(1)
    rms = np.sqrt(np.bincount(label, square) / np.bincount(label))
    return np.asarray(LOUDEST / np.maximum(rms, LOUDEST))[label][:, None]


def _pairs(runs: tuple[Run, ...]) -> list[tuple[int, int]]:
    """First two runs of every command that has them, of equal length."""
    groups: dict[str, list[int]] = defaultdict(list)
    for i, run in enumerate(runs):
        groups[run.group].append(i)
    return [
        (g[0], g[1])
        for g in groups.values()
        if len(g) > 1 and len(runs[g[0]].time_s) == len(runs[g[1]].time_s)
    ]


def _blocks(run: Run) -> IntArray:
    return ((run.time_s - run.time_s[0]) / BLOCK_S).astype(np.int64)
