from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from diffsim.data.signal import step_of
from diffsim.data.study import Channel, Run
from diffsim.diagnose.checks.noise import (
    COLORED,
    REPEATED,
    STATED,
    ArWhitener,
    fit_ar,
    fit_color,
    noise_floor,
    repeat_deviations,
    without_spikes,
)

A = np.array([0.9, -0.3])  # stationary, oscillating


def make_run(measured, name="r", group="g"):
    return Run(name, 0.01 * np.arange(len(measured)), measured, {}, group)


def covariance(a, n, sd):
    """From the impulse response of x_t = a1 x_{t-1} + ... + e_t, normalized to sd."""
    response = lfilter([1.0], [1.0, *-a], np.eye(1, 2000)[0])
    rho = np.array([response[: 2000 - k] @ response[k:] for k in range(n)])
    idx = np.abs(np.arange(n)[:, None] - np.arange(n)[None, :])
    return sd**2 * rho[idx] / rho[0]


@pytest.mark.reference
def test_whitened_covariance_is_the_identity():
    run = make_run(np.zeros((30, 2)))
    w = ArWhitener(np.array([0.5, 2.0]), [A, np.array([0.7])]).matrix(run).toarray()
    for c, (a, sd) in enumerate([(A, 0.5), (np.array([0.7]), 2.0)]):
        own = w[:, c::2][w[:, c::2].any(axis=1)]
        np.testing.assert_allclose(own @ covariance(a, 30, sd) @ own.T, np.eye(30), atol=1e-10)


@pytest.mark.reference
def test_gaps_start_afresh():
    measured = np.zeros((30, 1))
    measured[[7, 8, 20, 22], 0] = np.nan  # leaves a stretch of one sample too
    w = ArWhitener(np.array([2.0]), [A]).matrix(make_run(measured)).toarray()
    assert w.shape == (26, 30)
    whole = covariance(A, 30, 2.0)
    for start, stop in ((0, 7), (9, 20), (21, 22), (23, 30)):
        rows = w[np.abs(w[:, start:stop]).sum(1) > 0]
        np.testing.assert_allclose(rows @ whole @ rows.T, np.eye(stop - start), atol=1e-10)
    assert not w[:, [7, 8, 20, 22]].any()


def colored(seed, n, a=A):
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    return lfilter([1.0], [1.0, *-a], rng.normal(size=n + 200))[200:]


def test_coefficients_of_synthetic_noise():
    found = fit_ar([colored(s, 4000) for s in range(3)])
    assert len(found) >= 2
    # sd of a Yule-Walker estimate: about sqrt((1 - a2^2) / 12000) = 0.009
    np.testing.assert_allclose(found[:2], A, atol=0.04)
    np.testing.assert_allclose(found[2:], 0.0, atol=0.04)
    assert len(fit_ar([np.random.default_rng(0).normal(size=2000)])) == 0


def test_whitened_noise_has_unit_power_and_no_memory():
    channel = Channel("x_m", "m", "position")
    runs = [make_run(0.03 * colored(s, 2000)[:, None], f"r{s}") for s in range(4)]
    noise = noise_floor(runs, [channel], {r.name: r.measured for r in runs})
    fresh = make_run(0.03 * colored(99, 5000)[:, None])
    white = noise.whitener.matrix(fresh) @ fresh.measured.ravel()
    assert noise.source == ("repeats",)
    np.testing.assert_allclose(np.mean(white**2), 1.0, atol=0.1)  # 5 sd of 5000 + 6000 samples
    assert abs(np.mean(white[1:] * white[:-1])) < 0.07


def test_deviations_keep_the_sd_of_one_run():
    rng = np.random.default_rng(0)
    common = rng.normal(size=(5000, 1)) * 10
    runs = [make_run(common + 0.2 * rng.normal(size=(5000, 1)), f"r{i}") for i in range(3)]
    stack = np.concatenate(repeat_deviations(runs, {r.name: r.measured for r in runs}))
    np.testing.assert_allclose(stack.std(), 0.2, rtol=0.03)


@pytest.mark.parametrize(("scatter", "is_repeatable"), [(1.0, True), (1.25, True), (1.7, False)])
def test_scatter_ratio_flags_at_1_4(scatter, is_repeatable):
    rng = np.random.default_rng(3)
    channel = Channel("x_m", "m", "position", sd=0.1)
    runs = [make_run(0.1 * scatter * rng.normal(size=(3000, 1)), f"r{i}") for i in range(2)]
    noise = noise_floor(runs, [channel], {r.name: r.measured for r in runs})
    np.testing.assert_allclose(noise.scatter_ratio, scatter, rtol=0.06)
    assert noise.is_repeatable is is_repeatable
    assert noise.source == (("repeats",) if is_repeatable else ("stated sd",))


def test_without_repeats_and_sd_second_differences_serve():
    rng = np.random.default_rng(4)
    slow = np.sin(np.linspace(0, 3, 4000))[:, None]
    run = make_run(slow + 0.05 * rng.normal(size=(4000, 1)))
    noise = noise_floor([run], [Channel("x_m", "m", "position")], {"r": run.measured})
    assert noise.source == ("second differences",)
    np.testing.assert_allclose(noise.sd, 0.05, rtol=0.06)
    assert np.isnan(noise.scatter_ratio).all()


@pytest.mark.parametrize(
    ("memory", "loud", "explained", "source"),
    [
        (0.6, 1.0, True, COLORED),
        (0.6, 1.0, False, STATED),  # what the plain model leaves may be a cause
        (0.0, 1.0, True, STATED),
        (0.6, 1.5, True, STATED),  # more than the noise: something acts
    ],
)
def test_without_repeats_noise_has_the_color_of_what_the_best_set_leaves(
    memory, loud, explained, source
):
    """A thrust stand's amplifier remembers a sample: that is no drift of the force."""
    a, sd = np.array([memory]), 0.1
    usual = np.sqrt(1.0 - memory**2)
    records = [sd * loud * usual * colored(s, 40, a)[:, None] for s in range(6)]
    runs = [replace(make_run(y, f"r{s}"), group=f"r{s}") for s, y in enumerate(records)]
    channel = Channel("thrust_N", "N", "force", sd=sd)
    left = {r.name: r.measured for r in runs}
    noise = noise_floor(runs, [channel], left, explained=explained)
    assert noise.source == (source,)
    np.testing.assert_array_equal(noise.sd, sd)
    found = noise.whitener.coefficients[0]
    if source == STATED:
        assert len(found) == 0
    else:  # 240 samples tell a memory of 0.6 to 0.05
        assert len(found) == 1 and abs(found[0] - memory) < 0.15


def test_the_color_of_noise_is_told_between_gaps():
    a = np.array([0.6])
    series = [0.8 * colored(s, 40, a) for s in range(6)]
    series[0][[2, 37]] = np.nan  # two samples stand alone at both ends
    assert len(fit_color(series, 1.0)) == 1
    assert len(fit_ar([*series, np.array([0.3, 0.1])])) == 1


def test_a_stated_sd_that_is_far_too_large_has_no_color():
    """What is left is a simulation that is wrong, in white noise of a tenth of that sd."""
    rng, time = np.random.default_rng(5), 0.02 * np.arange(150)
    series = [0.2 * np.sin(2.0 * time + k) + 0.1 * rng.normal(size=len(time)) for k in range(4)]
    assert len(fit_color(series, 1.0)) == 0
    colored = [lfilter([0.8], [1.0, -0.6], rng.normal(size=len(time))) for _ in range(4)]
    assert len(fit_color(colored, 1.0)) == 1


@pytest.mark.parametrize("memory", [0.5, 0.8, 0.9])
def test_the_color_of_noise_of_the_stated_size_is_found_in_any_draw(memory):
    """Its mean square is that of few independent samples: of 0.9, three runs hold 130, and a third
    of them had "another sd", and a false cause for it. What is half as large again has no color."""
    shape = [np.sqrt(1.0 - memory**2)], [1.0, -memory]

    def count(size):
        found = 0
        for seed in range(30):
            rng = np.random.default_rng(seed)
            runs = [size * lfilter(*shape, rng.normal(size=700))[300:] for _ in range(3)]
            found += len(fit_color(runs, 1.0)) > 0
        return found

    assert count(1.0) >= 28
    assert count(1.5) == count(0.5) == 0


def test_a_memory_as_long_as_the_recording_is_no_color():
    """A drift over one short film, of the stated size, is told from noise by nothing."""
    drift = np.sqrt(2.0) * np.sin(np.linspace(0.0, 2.0 * np.pi, 28))
    assert len(fit_ar([drift])) > 0
    assert len(fit_color([drift], 1.0)) == 0


def test_readings_in_steps_have_the_noise_of_rounding():
    """Repeats that are equal to the last digit say nothing of an encoder's steps."""
    time = 0.01 * np.arange(200)
    smooth = np.sin(3.0 * time)[:, None]
    steps = 0.1 + 0.05 * np.round(smooth / 0.05)
    channels = [Channel("angle_rad", "rad", "angle", sd=1e-3)]
    runs = [make_run(steps, "a"), make_run(steps, "b")]
    noise = noise_floor(runs, channels, {r.name: r.measured - smooth for r in runs})
    assert noise.source == ("rounding",)
    np.testing.assert_allclose(noise.sd, 0.05 / np.sqrt(12.0), rtol=1e-9)
    assert step_of(smooth[:, 0]) is None and step_of(np.full(50, 2.0)) is None
    digits = np.round(smooth + 0.01 * np.random.default_rng(0).normal(size=smooth.shape), 4)
    fine = [make_run(digits, "a")]
    assert noise_floor(fine, channels, {"a": digits - smooth}).source == ("stated sd",)


def test_no_noise_at_all_is_refused():
    run = make_run(np.zeros((100, 1)))
    with pytest.raises(ValueError, match=r"x_m has no noise .* state its sd"):
        noise_floor([run], [Channel("x_m", "m", "position")], {"r": run.measured})


def test_spikes_are_marked_and_steps_are_not():
    rng = np.random.default_rng(5)
    left = 0.1 * rng.normal(size=(500, 1))
    left[250:] += 5.0  # a step lasts
    left[[50, 333]] += 4.0
    (run,), count = without_spikes([make_run(left)], [left])
    assert count == 2
    assert set(np.flatnonzero(np.isnan(run.measured[:, 0]))) == {50, 333}


def test_misread_samples_of_a_sensor_that_rests_are_spikes():
    """An encoder at rest shows one count: there each move was a spike, or a misreading none."""
    still, moving = np.zeros((500, 1)), np.zeros((500, 1))
    moving[300:400] = 1e-2 * np.random.default_rng(5).normal(size=(100, 1))
    moving[:300] += 1e-6 * np.random.default_rng(6).normal(size=(300, 1))
    for left in (still, moving):
        left[[50, 440]] -= 3.0
    lefts = [still, moving]
    runs = [make_run(left) for left in lefts]
    assert without_spikes(runs, lefts)[1] == 0
    cleaned, count = without_spikes(runs, lefts, np.array([1e-2]))
    assert count == 4
    assert all(np.isnan(run.measured[[50, 440], 0]).all() for run in cleaned)


@pytest.mark.filterwarnings("error")
def test_a_channel_that_was_never_measured_has_no_spikes():
    left = 0.1 * np.random.default_rng(5).normal(size=(500, 2))
    left[50, 0] += 4.0
    left[:, 1] = np.nan
    (run,), count = without_spikes([make_run(left)], [left])
    assert count == 1
    assert np.isnan(run.measured[50, 0]) and np.isnan(run.measured[:, 1]).all()


def test_a_run_with_more_spikes_than_others_is_cleaned_with_them():
    """One in a hundred on average: four in a run of sixty samples is chance."""
    rng = np.random.default_rng(6)
    lefts = [0.1 * rng.normal(size=(60, 1)) for _ in range(6)]
    lefts[2][[5, 20, 33, 48]] += 4.0
    runs, count = without_spikes([make_run(left) for left in lefts], lefts)
    assert count == 4 and np.isnan(runs[2].measured).sum() == 4
    # of a heavy-tailed sensor all runs have many
    every = [left + np.where(np.arange(60)[:, None] % 15 == 7, 4.0, 0.0) for left in lefts]
    assert without_spikes([make_run(left) for left in every], every)[1] == 0


@pytest.mark.parametrize(("differs", "source"), [(True, STATED), (False, "repeats")])
def test_what_a_recorded_column_does_is_no_noise_of_repeats(differs, source):
    """Wind that a mast recorded blew otherwise in the second run; the model does not use it."""
    rng, time = np.random.default_rng(8), 0.02 * np.arange(300)
    runs, left = [], {}
    for k in range(2):
        blown = np.sin(0.7 * time + 2.0 * k)
        left[f"r{k}"] = (0.5 * blown + rng.normal(size=300))[:, None]
        seen = blown if differs else np.sin(0.7 * time)
        run = make_run(left[f"r{k}"], f"r{k}")
        runs.append(replace(run, columns={"wind": seen + 0.01 * rng.normal(size=300)}))
    noise = noise_floor(runs, [Channel("x", "m", "position", sd=0.9)], left)
    assert noise.source == (source,)
    assert np.isnan(noise.scatter_ratio[0]) == differs


def test_what_follows_from_the_motion_excuses_no_scatter_of_repeats():
    """Two starts of one drive that differ, the way it went and its rippling current beside."""
    rng, time = np.random.default_rng(9), 0.02 * np.arange(300)
    runs, left = [], {}
    for k in range(2):
        apart = (2.0 * k - 1.0) * (1.0 - np.exp(-time))  # unlike starts at one speed
        left[f"r{k}"] = (apart + 0.1 * rng.normal(size=300))[:, None]
        seen = {"way": 0.02 * np.cumsum(apart), "current": np.sin(40.0 * time + k)}
        runs.append(replace(make_run(left[f"r{k}"], f"r{k}"), columns=seen))
    noise = noise_floor(runs, [Channel("w", "rad/s", "angular_velocity", sd=0.1)], left)
    assert noise.scatter_ratio[0] > 5.0 and not noise.is_repeatable


def poses(rng, loud=1.0, num_channels=6):
    """Nineteen poses of a rod, each read twice: one sample a run; the first channel may be loud."""
    runs = [
        make_run(rng.normal(size=(1, num_channels)), f"pose{k}_{again}", f"pose{k}")
        for k in range(19)
        for again in "ab"
    ]
    for run in runs:
        run.measured[:, 0] *= loud
    channels = [Channel(f"x{c}_m", "m", "position", sd=1.0) for c in range(num_channels)]
    return noise_floor(runs, channels, {run.name: run.measured for run in runs})


@pytest.mark.reference
def test_chance_alone_is_no_scatter_of_few_repeats():
    """A ratio of 1.4 in any of six channels, nineteen degrees of freedom each: one in 23 draws."""
    rng = np.random.default_rng(0)
    drawn = [poses(rng) for _ in range(150)]
    assert np.mean([np.max(floor.scatter_ratio) > 1.4 for floor in drawn]) > 0.01
    assert sum(not floor.is_repeatable for floor in drawn) <= 2
    np.testing.assert_array_equal(drawn[0].scatter_freedom, 19.0)
    assert sum(not poses(rng, loud=2.5).is_repeatable for _ in range(9)) >= 8


def test_scatter_that_raw_repeats_do_not_have_is_none():
    """A drift by the order of runs, as a model has it: its repeats differ, the recorded do not."""
    rng, channel = np.random.default_rng(1), Channel("x_m", "m", "position", sd=0.1)
    runs = [make_run(0.1 * rng.normal(size=(300, 1)), f"r{i}") for i in range(2)]
    left = {run.name: run.measured + 0.5 * i for i, run in enumerate(runs)}
    noise = noise_floor(runs, [channel], left)
    assert noise.is_repeatable and noise.source == ("repeats",)
    np.testing.assert_allclose(noise.sd, 0.1, rtol=0.1)


def test_one_pair_of_repeats_tells_the_color_of_noise_but_not_its_size():
    """Sixty samples that remember ten have few independent ones: the stated sd is better."""
    a, channel = np.array([0.9]), Channel("x_m", "m", "position", sd=0.1)
    usual = np.sqrt(1.0 - 0.9**2)
    records = [0.1 * usual * colored(s, 60, a)[:, None] for s in range(2)]
    runs = [make_run(y, f"r{i}") for i, y in enumerate(records)]
    noise = noise_floor(runs, [channel], {r.name: r.measured for r in runs})
    assert noise.source == (REPEATED,) and noise.sd == 0.1
    assert noise.whitener.coefficients[0][0] > 0.6
    # n / (1 + 2 sum rho_k^2) of an autoregressive process of first order, of one difference
    (rho,) = noise.whitener.coefficients[0]
    expected = 60.0 * (1.0 - rho**2) / (1.0 + rho**2)
    np.testing.assert_allclose(noise.scatter_freedom, expected, rtol=1e-9)
