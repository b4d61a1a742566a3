"""Noise, decoys, arguments, and that a hidden effect is the only difference to a null case."""

import numpy as np
import pytest

from diffsim.data import check_study, load_study, save_study
from labs.virtual import DECOYS, LABS, NetworkLab
from labs.virtual.common import NOISE_COLOR, delayed
from tests.labs.short_copter import ShortCopterLab


@pytest.fixture(scope="module")
def lab():
    return NetworkLab()


@pytest.mark.parametrize("system", list(LABS))
def test_a_study_passes_the_gates_and_survives_the_disc(system, tmp_path):
    lab = ShortCopterLab if system == "copter" else LABS[system]
    study = lab()(3)
    assert check_study(study) == []
    save_study(study, tmp_path / "s")
    again = load_study(tmp_path / "s")
    for a, b in zip(study.runs, again.runs, strict=True):
        np.testing.assert_array_equal(a.measured, b.measured)
    assert again.metadata["virtual"] is True
    assert "truth" not in again.metadata


def differences(a, b, sd):
    return np.array(
        [
            np.nanmax(np.abs(p.measured - q.measured) / sd)
            for p, q in zip(a.runs, b.runs, strict=True)
        ]
    )


@pytest.mark.parametrize("name", list(NetworkLab.effects))
def test_every_effect_of_the_network_shows_and_is_off_at_zero(lab, name):
    sd = np.array([c.sd for c in lab.channels])
    null = lab(1)
    assert differences(lab(1, name, 0.0), null, sd).max() == 0.0
    assert differences(lab(1, name), null, sd).max() > 3.0


def test_seeds_repeat_and_differ(lab):
    sd = np.array([c.sd for c in lab.channels])
    assert differences(lab(1), lab(1), sd).max() == 0.0
    assert differences(lab(1), lab(2), sd).min() > 1.0


def test_the_noise_is_as_stated(lab):
    noise = lab._noise(np.random.default_rng(0), 100_000, ())
    sd = np.array([c.sd for c in lab.channels])
    np.testing.assert_allclose(noise.std(axis=0), sd, rtol=0.02)
    color = [np.corrcoef(x[1:], x[:-1])[0, 1] for x in noise.T]
    np.testing.assert_allclose(color, NOISE_COLOR, atol=0.015)  # 1 / sqrt(1e5) = 0.003


def test_decoys_of_the_noise(lab):
    def noise(decoy):
        return lab._noise(np.random.default_rng(0), 50_000, (decoy,)) / [c.sd for c in lab.channels]

    assert np.corrcoef(noise("colored_noise")[1:, 0], noise("colored_noise")[:-1, 0])[
        0, 1
    ] == pytest.approx(0.7, abs=0.02)
    assert np.mean(np.abs(noise("spikes")) > 4.9) == pytest.approx(0.01, rel=0.2)
    assert np.isnan(noise("gaps")).mean() == pytest.approx(0.05, rel=0.1)
    heavy = noise("heavy_tails")
    assert np.mean(np.abs(heavy) > 4.0) > 30 * 6.3e-5  # of a normal variable


def test_decoys_of_the_plan(lab):
    assert len(lab.case(1, decoys=["lost_repeat"]).study.runs) == len(lab(1).runs) - 1
    assert [r.order for r in lab.case(1, decoys=["lost_repeat"]).study.runs] == list(range(6))
    far = lab.case(1, decoys=["far_prior"]).truth["base"]
    for name, base in lab.base.items():
        assert abs(np.log(far[name] / base.value)) == pytest.approx(3 * base.relative_sd)
    quiet, loud = lab.case(1).study.runs, lab.case(1, decoys=["scatter"]).study.runs
    repeat = [i for i, r in enumerate(quiet) if r.group == "staircase"]
    gap = [np.abs(np.subtract(*(runs[i].measured[:, 3] for i in repeat))) for runs in (quiet, loud)]
    assert gap[1].mean() > 4 * gap[0].mean()


def test_all_decoys_run(lab):
    for name in DECOYS:
        lab.case(2, decoys=[name])


def test_unknown_names_and_sizes_are_refused(lab):
    with pytest.raises(ValueError, match="did you mean 'leak'"):
        lab(1, "leek")
    with pytest.raises(ValueError, match="decoys must be one of"):
        lab.case(1, decoys=["spike"])
    with pytest.raises(ValueError, match="meter_gain has 3 components, got 2"):
        lab(1, "meter_gain", (0.1, 0.2))
    assert lab.case(1, {"meter_gain": 0.1}).truth["effects"]["meter_gain"] == (0.1, 0.0, 0.0)


def test_lag_against_the_closed_form():
    t = np.arange(0, 1.0, 1e-3)
    ramp = np.clip(t - 0.1, 0.0, None)
    tau = 0.05
    s = np.clip(t - 0.13, 0.0, None)
    expected = s - tau * (1.0 - np.exp(-s / tau))
    np.testing.assert_allclose(delayed(t, ramp, 0.03, tau, 1e-3), expected, atol=1e-12)
