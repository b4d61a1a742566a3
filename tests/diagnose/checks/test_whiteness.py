"""The whiteness test against noise of known color."""

import types

import numpy as np
import pytest

from diffsim.data.study import Channel, Run
from diffsim.diagnose.checks.noise import ljung_box
from diffsim.identify import WhiteNoise

CHANNELS = (Channel("a", "m", "position", sd=2.0), Channel("b", "m", "position", sd=0.5))


def fit_of(records):
    """Runs whose residual is their record, in the order that the whitener gives."""
    runs = [Run(f"r{i}", 0.1 * np.arange(len(y)), y, {}, f"g{i}") for i, y in enumerate(records)]
    whitener = WhiteNoise(CHANNELS)
    residual = [whitener.matrix(r) @ np.nan_to_num(r.measured).ravel() for r in runs]
    problem = types.SimpleNamespace(runs=runs, whitener=whitener)
    return types.SimpleNamespace(problem=problem, residual=np.concatenate(residual))


def test_white_noise_gives_uniform_probabilities_and_colored_noise_none():
    from scipy import stats
    from scipy.signal import lfilter

    rng = np.random.default_rng(0)
    found = np.array(
        [
            ljung_box(fit_of([rng.normal(size=(200, 2)) * [2.0, 0.5] for _ in range(2)]))
            for _ in range(150)
        ]
    )
    assert stats.kstest(found.ravel(), "uniform").pvalue > 0.01
    mixed = rng.normal(size=(400, 2)) * [2.0, 0.5]
    mixed[:, 1] = lfilter([1.0], [1.0, -0.5], mixed[:, 1])
    p = ljung_box(fit_of([mixed]))
    assert p[1] < 1e-6 < p[0]


def test_statistic_by_hand_and_missing_samples():
    from scipy import stats

    y = np.column_stack([np.tile([1.0, -1.0], 10), np.full(20, np.nan)])
    # alternating: r_k = (-1)^k (n - k) / n, so that Q = (n + 2) / n sum (n - k), k = 1 .. n / 5
    expected = stats.chi2.sf(22 / 20 * (19 + 18 + 17 + 16), 4)
    p = ljung_box(fit_of([y]))
    assert p[0] == pytest.approx(expected) and np.isnan(p[1])
