"""Free-vibration analysis on synthetic signals whose answers are known."""

import numpy as np
import pytest

from examples.data import vibration

RATE = 100.0


def ring(f=7.75, zeta=0.055, duration=2.0, amplitude=5e-3, level=-6e-3, creep=0.0, noise=0.0):
    """Decaying sinusoid of damped frequency f on a level that creeps by ``creep`` in log time."""
    t = np.arange(round(duration * RATE)) / RATE
    w = 2 * np.pi * f
    sigma = zeta * w / np.sqrt(1 - zeta**2)
    slow = creep * np.log1p(t / 0.1) / np.log1p(t[-1] / 0.1)
    x = level + slow + amplitude * np.exp(-sigma * t) * np.cos(w * t + 0.4)
    return t, x + np.random.default_rng(0).normal(0.0, noise, len(t))


# noise as measured (3 um) and ten times worse; a short record of four cycles
@pytest.mark.parametrize(
    ("f", "zeta", "duration", "noise"),
    [(7.75, 0.055, 2.0, 0.0), (7.75, 0.055, 2.0, 3e-6), (7.75, 0.055, 0.52, 3e-6),
     (4.33, 0.052, 2.0, 3e-5), (7.75, 0.24, 1.0, 3e-6), (20.0, 0.005, 3.0, 3e-6)],
)  # fmt: skip
def test_fit_finds_frequency_to_a_thousandth_and_damping_to_a_hundredth(f, zeta, duration, noise):
    fit = vibration.fit_decay(*ring(f, zeta, duration, noise=noise))
    assert fit.frequency_Hz == pytest.approx(f, rel=1e-3)
    assert fit.damping_ratio == pytest.approx(zeta, rel=1e-2)
    assert fit.amplitude == pytest.approx(5e-3, rel=1e-2)
    assert fit.phase == pytest.approx(0.4, abs=0.02)


def test_creep_does_not_leak_into_the_damping():
    t, x = ring(creep=-0.6e-3, noise=3e-6)
    fit = vibration.fit_decay(t, x)
    assert fit.damping_ratio == pytest.approx(0.055, rel=1e-2)
    assert fit.drift == pytest.approx(-0.6e-3, rel=0.02)
    assert fit.offset == pytest.approx(-6.6e-3, rel=2e-3)
    blind = vibration.fit_decay(t, x, drift="none")
    assert blind.rms > 10 * fit.rms  # the creep is seen as misfit when it is not allowed for


def test_the_stated_uncertainty_covers_the_error():
    errors = []
    for seed in range(40):
        t, x = ring()
        x = x + np.random.default_rng(seed).normal(0.0, 2e-5, len(t))
        fit = vibration.fit_decay(t, x)
        errors.append(
            [
                (fit.frequency_Hz - 7.75) / fit.frequency_std_Hz,
                (fit.damping_ratio - 0.055) / fit.damping_ratio_std,
            ]
        )
    # 40 draws of a standard normal have an rms of 1 +- 0.11
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(errors), axis=0)), 1.0, atol=0.4)


@pytest.mark.parametrize("zeta", [0.01, 0.055, 0.15])
def test_decrement_agrees_with_the_truth(zeta):
    turns = vibration.swings(*ring(zeta=zeta, noise=1e-6))
    # a spline through 13 samples per cycle places the turns well enough for these
    assert turns.frequency_Hz == pytest.approx(7.75, rel=5e-3)
    assert turns.damping_ratio == pytest.approx(zeta, rel=1e-2)


def test_damping_that_depends_on_amplitude_is_seen_window_by_window():
    # constant friction: the envelope falls linearly, so the damping ratio rises as 1/amplitude
    t = np.arange(200) / RATE
    x = 1e-2 * (1 - t / 2.4) * np.cos(2 * np.pi * 5.0 * t)
    fits = vibration.decay_by_window(t, x, cycles=3)
    for begin, fit in fits:
        middle = begin + 0.3
        expected = (1 / 2.4) / (1 - middle / 2.4) / (2 * np.pi * 5.0)
        assert fit.damping_ratio == pytest.approx(expected, rel=0.1)
    assert fits[-1][1].damping_ratio > 2 * fits[0][1].damping_ratio


def test_spectrum_gives_amplitude_and_place():
    t = np.arange(1000) / RATE
    frequency, amplitude = vibration.amplitude_spectrum(t, 2e-3 * np.sin(2 * np.pi * 12.5 * t))
    peak = int(np.argmax(amplitude))
    assert frequency[peak] == pytest.approx(12.5, abs=0.05)
    assert amplitude[peak] == pytest.approx(2e-3, rel=0.02)  # scalloping of a half window


def test_level_and_creep():
    t = np.arange(1, 500) / RATE
    x = -6e-3 - 0.25e-3 * np.log10(t)
    level = vibration.settled_level(t, x)
    assert level.creep_per_decade == pytest.approx(-0.25e-3, rel=1e-6)
    assert level.value == pytest.approx(-6e-3 - 0.25e-3 * np.log10(4.5), rel=1e-3)
    with pytest.raises(ValueError, match=r"shorter than span_s"):
        vibration.settled_level(t[:50], x[:50])


def test_repeat_floor_finds_the_lag_and_the_scatter():
    t = np.arange(300) / RATE

    def case(lag, seed):
        s = t - lag
        x = np.exp(-2 * s) * np.cos(48 * s) * 5e-3
        scatter = np.random.default_rng(seed).normal(0.0, 2e-5, (300, 3))
        return t, np.column_stack([0 * x, 0 * x, x]) + scatter

    floor = vibration.repeat_floor(case(0.0, 1), case(0.004, 2), until_s=2.0)
    assert floor.lag_s == pytest.approx(0.004, abs=1e-4)
    # scatter of a difference; the spline between samples shrinks the second one's a little
    np.testing.assert_allclose(floor.rms_best, 2e-5 * np.sqrt(2), rtol=0.2)
    assert floor.rms[2] > 5 * floor.rms_best[2]
    np.testing.assert_allclose(floor.rms[:2], 2e-5 * np.sqrt(2), rtol=0.15)


def test_messages():
    t, x = ring()
    with pytest.raises(ValueError, match=r"x has 1 gaps"):
        vibration.fit_decay(t, np.where(t == t[5], np.nan, x))
    with pytest.raises(ValueError, match=r"holds 0.77 cycles"):
        vibration.fit_decay(t[:14], x[:14], frequency_Hz=5.9)
    with pytest.raises(ValueError, match=r"drift must be one of"):
        vibration.fit_decay(t, x, drift="cubic")
    with pytest.raises(ValueError, match=r"turning points .* at least three"):
        vibration.swings(t, np.exp(-t))
    with pytest.raises(ValueError, match=r"reaches 1 never"):
        vibration.first_crossing(t, x, 1.0)
    with pytest.raises(ValueError, match=r"one-dimensional and of equal length"):
        vibration.fit_decay(t[1:], x)


def test_less_than_a_cycle_is_refused_with_how_many_there_are():
    t = np.linspace(0.0, 0.25, 40)
    with pytest.raises(ValueError, match=r"record of 0\.25 s holds 0\.50 cycles of 2 Hz"):
        vibration.fit_decay(t, np.cos(4.0 * np.pi * t), frequency_Hz=2.0)
