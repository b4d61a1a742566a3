"""A sensor's own clock, found in records alone."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from diffsim.data import refresh
from diffsim.data.refresh import age, phase_of, refresh_period

PERIOD = 0.008  # s, hidden


def motion(times, seed):
    """A swing that dies out, and a slow one: what a pendulum does."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(4.0, 9.0, 2), rng.uniform(0.0, 6.0, 2)
    swings = np.cos(rates[:, None] * times + phases[:, None])
    return 0.8 * np.exp(-0.3 * times) * swings[0] + 0.3 * swings[1]


def record(seed, *, period, step=0.01, jitter=1e-4, counts=4096):
    """Times and counted readings of one run, asked every 10 ms."""
    rng = np.random.default_rng(100 + seed)
    times = step * np.arange(500) + jitter * rng.normal(size=500)
    phase = 0.0 if period is None else rng.uniform(0.0, period)
    seen = times if period is None else times - age(times, period, phase)
    unit = 2.0 * np.pi / counts
    return times, unit * np.round(motion(seen, seed) / unit), phase


@pytest.mark.parametrize("period", [PERIOD, 0.0137, 0.0047])
def test_period_and_phase_of_a_hidden_clock_are_found(period):
    records = [record(seed, period=period) for seed in range(4)]
    found = refresh_period((times, readings) for times, readings, _ in records)
    assert found == pytest.approx(period, rel=2e-3)
    for times, readings, phase in records:
        off = (phase_of(times, readings, period) - phase + period / 2) % period - period / 2
        assert abs(off) < 0.15 * period  # 8 against 10 ms leave 1 ms open


def test_misread_samples_and_gaps_do_not_hide_it():
    records = [record(seed, period=PERIOD)[:2] for seed in range(4)]
    for k, (_, readings) in enumerate(records):
        readings[60 + 9 * k] = -3.14159
        readings[200:203] = np.nan
    assert refresh_period(records) == pytest.approx(PERIOD, rel=2e-3)


@pytest.mark.parametrize("jitter", [1e-5, 4e-4])
def test_a_sensor_without_a_clock_of_its_own_gets_none(jitter):
    records = [record(seed, period=None, jitter=jitter)[:2] for seed in range(4)]
    assert refresh_period(records) is None


def test_records_that_rest_or_are_short_say_nothing():
    times = 0.01 * np.arange(500)
    assert refresh_period([(times, np.ones(500)), (times[:20], times[:20])]) is None
    assert refresh_period([]) is None
    assert phase_of(times[:20], times[:20], PERIOD) == 0.0


@pytest.mark.parametrize("derivative", [0, 1])
def test_smooth_motion_is_that_of_local_cubics(derivative):
    values = np.random.default_rng(derivative).standard_normal((3, 4 * refresh.WINDOW))
    wanted = savgol_filter(values, refresh.WINDOW, refresh.DEGREE, deriv=derivative)
    np.testing.assert_allclose(refresh._smooth(values, derivative), wanted, atol=1e-13)
