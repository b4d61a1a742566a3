"""What makes the noise of a run white."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy import sparse

from diffsim.core.arrays import Array
from diffsim.core.checked import checked, checked_methods
from diffsim.core.memo import Memo
from diffsim.data.study import Channel, Run

#: coordinates from which zeros of slopes are left out: starts of runs and of their pieces act there
#: only; of fewer, one product is quicker than to look for zeros
MIN_SPARSE = 64
SPARSE_ROWS = 512  # rows looked at at once


def gram_of(slopes: Array) -> Array:
    """Gram matrix A'A of slopes, (num_rows, n), a part of the rows at a time: of many coordinates
    most act in a few parts only."""
    n = slopes.shape[1]
    if n < MIN_SPARSE:
        return np.asarray(slopes.T @ slopes)
    gram = np.zeros((n, n))
    for start in range(0, len(slopes), SPARSE_ROWS):
        rows = slopes[start : start + SPARSE_ROWS]
        used = np.flatnonzero(rows.any(0))
        rows = rows[:, used]
        gram[np.ix_(used, used)] += rows.T @ rows
    return gram


class Whitener(Protocol):
    """Makes the noise of a run white with standard deviation one."""

    def matrix(self, run: Run) -> sparse.csr_array:
        """(num_valid, num_samples * num_channels); missing samples have no row."""
        ...


class WhiteNoise:
    """Independent noise of known standard deviation in every channel.

    Args:
        channels: Channels with a known noise ``sd`` each.
    """

    @checked
    def __init__(self, channels: Sequence[Channel]):
        missing = [c.name for c in channels if c.sd is None]
        if missing:
            raise ValueError(
                f"channels {missing} have no sd; state it, or estimate it from repeats with "
                "diffsim.diagnose.checks.noise.noise_floor"
            )
        self.sd = np.array([c.sd for c in channels], dtype=np.float64)
        self._made: Memo[sparse.csr_array] = Memo()

    @checked(kinds_only=True)
    def matrix(self, run: Run) -> sparse.csr_array:
        """Rows of the measured samples of ``diag(1 / sd)``; made once per run."""
        return self._made(run, lambda: self._matrix(run))

    def _matrix(self, run: Run) -> sparse.csr_array:
        valid = np.isfinite(run.measured).ravel()
        weight = np.tile(1.0 / self.sd, len(run.time_s))
        return sparse.csr_array(sparse.diags_array(weight).tocsr()[np.flatnonzero(valid)])


@checked_methods
class WhitenedRuns:
    """Recorded runs and their noise: rows of whitened samples, run by run."""

    runs: tuple[Run, ...]
    whitener: Whitener

    @property
    def num_valid(self) -> list[int]:
        """Measured samples of each run, all channels together."""
        return [int(np.isfinite(run.measured).sum()) for run in self.runs]

    def by_run(self, rows: Array) -> list[Array]:
        """Whitened rows of all runs, (num_valid, ...), by run."""
        counts = self.num_valid
        return np.split(rows, np.cumsum(counts)[:-1])

    def on_grid(self, run: Run, rows: Array) -> Array:
        """(num_samples, num_channels) of whitened rows of a run, (num_valid,): each stands at its
        newest sample, the largest column that it uses; 0 where nothing was measured."""
        matrix = self.whitener.matrix(run)
        grid = np.zeros(run.measured.size)
        grid[np.maximum.reduceat(matrix.indices, matrix.indptr[:-1])] = rows
        return grid.reshape(run.measured.shape)

    def whiten(self, run: Run, record: Array) -> Array:
        """(num_valid, ...) of a flattened record (num_samples * num_channels, ...)."""
        matrix = self.whitener.matrix(run)
        if record.ndim < 2 or record.shape[1] < MIN_SPARSE:
            return np.asarray(matrix @ record)
        out, used = np.zeros((matrix.shape[0], record.shape[1])), record.any(0)
        out[:, used] = matrix @ record[:, used]
        return out

    def whiten_all(self, rows: Array) -> Array:
        """Rows of the samples of all runs, (N, ...), whitened: (num_valid, ...)."""
        parts = np.split(rows, np.cumsum([run.measured.size for run in self.runs])[:-1])
        pairs = zip(self.runs, parts, strict=True)
        return np.concatenate([self.whiten(run, part) for run, part in pairs])

    def residual_of(self, record: Array) -> Array:
        """Measured less predicted samples of all runs, whitened; 0 where nothing was measured.

        Args:
            record: One prediction or several, (N,) or (N, K) [unit of the channel].

        Returns:
            (num_valid,) or (num_valid, K).
        """
        measured = np.concatenate([np.nan_to_num(run.measured).ravel() for run in self.runs])
        return self.whiten_all((measured - record.T).T)
