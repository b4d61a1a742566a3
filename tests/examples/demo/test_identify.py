"""The fit on an oscillator whose parameters are known."""

import numpy as np
import pytest
import torch

from examples.demo.identify import Unknown, fit

T = torch.arange(0, 2, 0.01, dtype=torch.float64)


def oscillator(p):
    """Tip of a one-mode beam: stiffness and stiffness-proportional damping."""
    w = torch.sqrt(p["youngs_modulus"] / 300e3) * 48.7
    sigma = 0.5 * p["rayleigh_beta"] * w**2
    return -1785.0 / p["youngs_modulus"] * (1 - torch.exp(-sigma * T) * torch.cos(w * T))


UNKNOWNS = {
    "youngs_modulus": Unknown(start=280e3, low=50e3, high=2e6, unit="Pa"),
    "rayleigh_beta": Unknown(start=5e-4, low=1e-6, high=1e-1, unit="s"),
}
TRUTH = {"youngs_modulus": 301e3, "rayleigh_beta": 2.2e-3}


def measured(noise, seed=0):
    truth = oscillator({k: torch.tensor(v, dtype=torch.float64) for k, v in TRUTH.items()})
    scatter = np.random.default_rng(seed).normal(0.0, noise, len(T))
    return truth + torch.from_numpy(scatter)


def test_finds_the_truth_and_tells_how_well():
    seen = []
    target = measured(2e-5)
    found = fit(lambda p: oscillator(p) - target, UNKNOWNS, on_step=seen.append)
    for name, truth in TRUTH.items():
        assert found.value[name] == pytest.approx(truth, rel=5e-3)
        assert abs(found.value[name] - truth) < 4 * found.std[name]
        assert found.std[name] < 0.01 * truth
    assert found.history[-1]["rms"] < found.history[0]["rms"]
    assert min(h["rms"] for h in found.history) == pytest.approx(2e-5, rel=0.1)
    assert seen == found.history and found.num_evaluations == len(seen) <= 30
    assert found.correlation.shape == (2, 2) and found.undetermined == ()


def test_says_when_the_data_do_not_determine_a_parameter():
    undamped = {"youngs_modulus": 301e3, "rayleigh_beta": 0.0}
    target = oscillator({k: torch.tensor(v, dtype=torch.float64) for k, v in undamped.items()})
    target = target + torch.from_numpy(np.random.default_rng(0).normal(0.0, 2e-5, len(T)))
    lossy = {**UNKNOWNS, "rayleigh_beta": Unknown(start=5e-4, low=1e-4, high=1e-1, unit="s")}
    found = fit(lambda p: oscillator(p) - target, lossy)
    assert found.undetermined == ("rayleigh_beta",)
    assert found.value["youngs_modulus"] == pytest.approx(301e3, rel=5e-3)


def test_impossible_bounds_are_refused():
    with pytest.raises(ValueError, match=r"0 < low <= start <= high, got 0, 1, 2"):
        Unknown(start=1.0, low=0.0, high=2.0, unit="s")


def test_the_number_of_simulations_is_kept():
    target = measured(2e-5)
    found = fit(lambda p: oscillator(p) - target, UNKNOWNS, max_evaluations=3)
    assert found.num_evaluations == len(found.history) == 3


def test_several_trials_count_alike():
    target = measured(2e-5)
    one = fit(lambda p: oscillator(p) - target, UNKNOWNS)
    two = fit([lambda p: oscillator(p) - target] * 2, UNKNOWNS)
    for name, value in one.value.items():
        assert two.value[name] == pytest.approx(value, rel=1e-9)
        # the same residuals twice: twice the samples, so 1 / sqrt(2) of the deviation
        assert two.std[name] == pytest.approx(one.std[name] / 2**0.5, rel=0.01)
