"""The steps of a simulator between the samples of a run, and its commands over them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array, IntArray

EVEN = 1e-6  # of a gap: below it the samples are as far from one another
MAX_STEPS = 20_000_000  # of one run


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps over a run; one more begins at the last sample, so that all samples are read alike."""

    sample_s: Array  # times of the samples, (num_samples,) [s]
    starts: Array  # where steps begin, (num_steps,) [s]
    lengths: Array  # how long they are, (num_steps,) [s]
    samples: IntArray  # steps that begin at the samples, (num_samples,)
    is_even: bool  # whether all steps are as long

    @staticmethod
    def count(time_s: Array, longest: float) -> int:
        """Number of steps of a run, none longer than ``longest`` [s]."""
        return int(_counts(np.diff(time_s), longest).sum()) + 1

    @classmethod
    def of(cls, time_s: Array, longest: float) -> Steps:
        """Steps that end at each sample.

        Args:
            time_s: Times of the samples, (num_samples,) [s].
            longest: Longest step [s].

        Raises:
            ValueError: the run is too long for so short a step.
        """
        gaps = np.diff(time_s)
        counts = _counts(gaps, longest)
        if (number := int(counts.sum())) > MAX_STEPS:
            raise ValueError(
                f"the run takes {number:,} steps of {longest:g} s; at most {MAX_STEPS:,}: give the "
                "MJCF a longer timestep, or cut the run"
            )
        samples = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        is_even = bool(len(gaps) and np.abs(gaps - gaps.mean()).max() <= EVEN * gaps.mean())
        is_even = is_even and counts.min() == counts.max()
        last = gaps[-1] / counts[-1] if len(gaps) else longest
        lengths = np.append(np.repeat(gaps / counts, counts), last)
        if is_even:
            lengths[:] = (time_s[-1] - time_s[0]) / number
        within = np.arange(number) - np.repeat(samples[:-1], counts)
        starts = np.append(np.repeat(time_s[:-1], counts) + within * lengths[:-1], time_s[-1])
        return cls(np.asarray(time_s), starts, lengths, samples, is_even)

    def controls(
        self, values: Array, held: bool, delays: Mapping[int, float], before: Mapping[int, float]
    ) -> Array:
        """Commands over the steps, (num_steps, num_controls).

        Args:
            values: Commands at the samples, (num_samples, num_controls).
            held: They are held from sample to sample; else straight lines join the samples.
            delays: Time by which a control is heard late, by its index [s].
            before: Values of such controls before the run, where these were not their first ones.
        """
        index = np.searchsorted(self.samples, np.arange(len(self.starts)), side="right") - 1
        out = values[index]
        if not held:
            following = values[np.minimum(index + 1, len(values) - 1)]
            gap = np.append(np.diff(self.samples), 1)[index]
            out = out + ((np.arange(len(index)) - self.samples[index] + 0.5) / gap)[:, None] * (
                following - out
            )
        for i, late in delays.items():
            out[:, i] = self._late(values[:, i], held, late, before.get(i, values[0, i]))
        return out

    def at_samples(
        self, values: Array, held: bool, delays: Mapping[int, float], before: Mapping[int, float]
    ) -> Array:
        """Commands at the samples themselves, (num_samples, num_controls); as ``controls``."""
        out = values.copy()
        for i, late in delays.items():
            then = self.sample_s - late
            if held:
                at = np.searchsorted(self.sample_s, then + 1e-12, side="right") - 1
                out[:, i] = values[np.maximum(at, 0), i]
            else:
                out[:, i] = np.interp(then, self.sample_s, values[:, i])
            if i in before:
                out[then < self.sample_s[0] - 1e-12, i] = before[i]
        return out

    def _late(self, values: Array, held: bool, late: float, first: float) -> Array:
        """Mean of a command over each step, heard late: it grows with the delay without a jump.

        Args:
            values: Command at the samples, (num_samples,).
            first: Its value before them.
        """
        then = self.starts - late
        if not held:
            # the part of a step before the first sample, of which nothing changes
            early = np.clip((self.sample_s[0] - then) / self.lengths, 0.0, 1.0)
            middle = then + 0.5 * (1.0 + early) * self.lengths
            return early * first + (1.0 - early) * np.interp(middle, self.sample_s, values)
        area = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(self.sample_s))])
        ends = []
        for edge in (then, then + self.lengths):
            before = np.minimum(edge - self.sample_s[0], 0.0) * first
            after = np.maximum(edge - self.sample_s[-1], 0.0) * values[-1]
            ends.append(np.interp(edge, self.sample_s, area) + before + after)
        return np.asarray((ends[1] - ends[0]) / self.lengths)


def _counts(gaps: Array, longest: float) -> IntArray:
    return np.maximum(np.ceil(gaps / longest - 1e-6), 1.0).astype(np.int64)
