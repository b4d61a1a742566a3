"""Noise of signals whose noise is known."""

import numpy as np
import pytest

from diffsim.data.signal import lost_rows, noise_std, swept_rows


def test_noise_is_not_fooled_by_drift_or_slow_swing():
    t = np.arange(2000) / 100.0
    x = 1e-3 * np.log1p(t / 0.1) / np.log1p(t[-1] / 0.1) + 1e-5 * np.cos(2 * np.pi * t)
    x += np.random.default_rng(0).normal(0.0, 3e-6, len(t))
    assert noise_std(x) == pytest.approx(3e-6, rel=0.05)  # 2000 samples: 2 %


@pytest.mark.parametrize("scatter", [0.0, 0.07])
def test_lost_rows_are_told_by_how_stamps_scatter(scatter):
    """Gaps of 1.75 steps of a clock that scatters by 7 % were late rows, and a null "unknown"."""
    rng = np.random.default_rng(0)
    whole = np.cumsum(0.01 * (1.0 + scatter * np.clip(rng.normal(size=300), -2.5, 2.5)))
    gone = [40, 100, 101, 220]
    lost = lost_rows(np.delete(whole, gone))
    assert dict(zip(np.flatnonzero(lost), lost[lost > 0], strict=True)) == {39: 1, 98: 2, 216: 1}
    late = 0.01 * np.arange(50.0)
    late[20:] += 0.007
    assert not lost_rows(late).any()


@pytest.mark.parametrize("jitter", [0.1, 0.2, 0.3])
def test_stamps_that_scatter_lose_no_row(jitter):
    """Of 2,000 steps on a grid, stamps 0.2 of a step off, fifty were called lost."""
    rng = np.random.default_rng(1)
    stamps = np.arange(2000.0) + jitter * rng.normal(size=2000)
    assert lost_rows(np.sort(stamps)).sum() <= 2


def test_a_command_that_jumps_over_a_gap_did_not_go_on():
    time = np.delete(0.01 * np.arange(200.0), [40, 100])
    sweep, jump = np.sin(6.0 * time), np.where(time > 0.995, 1.0, 0.0)
    assert swept_rows(time, [sweep]).sum() == 2
    assert np.flatnonzero(swept_rows(time, [sweep, jump])).tolist() == [39]
    assert not swept_rows(time, [np.ones(len(time))]).any()
