"""Is an unknown cause real? Repeats say so without any model of the noise.

With two repeats, mean and half-difference of the residuals have the same distribution if there is
nothing but noise; whatever is repeatable is in the mean only. Swapping them (with random signs) in
blocks of time gives the distribution of any statistic under noise alone. Blocks far above the noise
are first made smaller, mean and half-difference alike, so that two or three of them cannot decide
whatever the others say.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.data.study import Run
from diffsim.identify import Problem

Array = NDArray[np.float64]
BLOCK_S = 0.3
MIN_BLOCKS = 6  # with fewer, one draw in 2^5 or more swaps nothing, and no cause could be confirmed
DRAWS = 200
LOUDEST = 3.0  # rms of a block, in noise sd: louder ones count as if they were as loud as that


def swap_probability(
    problem: Problem, residual: Array, responses: Array, *, seed: int
) -> float | None:
    """Share of swapped draws whose statistic reaches that of the mean residual.

    The statistic is what the unknown's responses explain of the whitened residual, its amplitude
    taken large: b' (H'H + 1)^-1 b with b = H'r.

    Args:
        problem: Fitted problem that left the residual.
        residual: Whitened residual of the fit, (num_valid,).
        responses: Whitened responses of the cause in question, (num_valid, m).
        seed: Seed of the draws.

    Returns:
        (hits + 1) / (draws + 1), or None where repeats are missing or too short for a test.
    """
    pairs = _pairs(problem.runs)
    labels = [_blocks(problem.runs[a]) for a, _ in pairs]
    if sum(int(label.max()) + 1 for label in labels) < MIN_BLOCKS:
        return None
    grids = _on_grid(problem, residual[:, None])
    moved = _on_grid(problem, responses)
    mean = [0.5 * (grids[a] + grids[b])[..., 0] for a, b in pairs]
    half = [0.5 * (grids[a] - grids[b])[..., 0] for a, b in pairs]
    shares = [_shares(m, d, label) for m, d, label in zip(mean, half, labels, strict=True)]
    mean = [s * m for s, m in zip(shares, mean, strict=True)]
    half = [s * d for s, d in zip(shares, half, strict=True)]
    h = np.concatenate([moved[a].reshape(-1, moved[a].shape[-1]) for a, _ in pairs])
    h = h * np.sqrt(h.size / h.shape[1]) / linalg.norm(h)  # one noise sd per sample
    factor = linalg.cho_factor(h.T @ h + np.eye(h.shape[1]))

    def statistic(records: list[Array]) -> float:
        b = h.T @ np.concatenate([r.ravel() for r in records])
        return float(b @ linalg.cho_solve(factor, b))

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


def _shares(mean: Array, half: Array, label: NDArray[np.int64]) -> Array:
    """Factor of each sample, (num_samples, 1), that no block is above ``LOUDEST``.

    The same for mean and half-difference: under noise alone they stay exchangeable.
    """
    square = (mean**2 + half**2).mean(1)
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


def _on_grid(problem: Problem, rows: Array) -> list[Array]:
    """(num_samples, num_channels, m) by run: a whitened row stands at its newest sample."""
    out, start = [], 0
    for run in problem.runs:
        matrix = problem.whitener.matrix(run)
        newest = np.maximum.reduceat(matrix.indices, matrix.indptr[:-1])
        grid = np.zeros((run.measured.size, rows.shape[1]))
        grid[newest] = rows[start : start + matrix.shape[0]]
        out.append(grid.reshape(*run.measured.shape, -1))
        start += matrix.shape[0]
    return out


def _blocks(run: Run) -> NDArray[np.int64]:
    return ((run.time_s - run.time_s[0]) / BLOCK_S).astype(np.int64)
