"""Noise of signals whose noise is known."""

import numpy as np
import pytest

from diffsim.data.signal import noise_std


def test_noise_is_not_fooled_by_drift_or_slow_swing():
    t = np.arange(2000) / 100.0
    x = 1e-3 * np.log1p(t / 0.1) / np.log1p(t[-1] / 0.1) + 1e-5 * np.cos(2 * np.pi * t)
    x += np.random.default_rng(0).normal(0.0, 3e-6, len(t))
    assert noise_std(x) == pytest.approx(3e-6, rel=0.05)  # 2000 samples: 2 %
