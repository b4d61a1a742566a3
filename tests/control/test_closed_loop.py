"""Networks of what is sensed: moments of observations, bounded commands, seeds."""

import math

import pytest
import torch

from diffsim.control import Knots, MLPController, Normalizer, Sinusoid


@pytest.fixture
def rows() -> torch.Tensor:
    """Observations whose level drifts, so that batches differ by more than they scatter."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(300, 2, generator=generator, dtype=torch.float64)
    level = torch.linspace(-3.0, 5.0, 300, dtype=torch.float64)[:, None]
    return torch.tensor([0.5, 20.0], dtype=torch.float64) * (noise + level)


def test_moments_of_batches_are_those_of_all_rows(rows: torch.Tensor):
    normalizer = Normalizer(2)
    for batch in rows.split([10, 200, 90]):
        normalizer.update(batch)
    torch.testing.assert_close(normalizer.mean, rows.mean(0), rtol=1e-12, atol=0)
    variance = rows.var(0, unbiased=False)
    torch.testing.assert_close(normalizer.variance, variance, rtol=1e-12, atol=0)
    assert float(normalizer.count) == 300.0
    normalized = normalizer(rows)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(2).double(), rtol=0, atol=1e-12)
    ones = torch.ones(2).double()
    # the variance has 1e-8 more below the root
    torch.testing.assert_close(normalized.std(0, unbiased=False), ones, rtol=1e-7, atol=0)


def test_what_is_far_off_is_cut_and_moments_change_in_update_alone(rows: torch.Tensor):
    normalizer = Normalizer(2, clip=1.5)
    normalizer.update(rows)
    before = normalizer.mean.clone(), normalizer.variance.clone()
    assert float(normalizer(1e3 * rows).abs().max()) == 1.5
    torch.testing.assert_close((normalizer.mean, normalizer.variance), before, rtol=0, atol=0)


def test_commands_are_bounded_and_those_of_the_seed():
    seen = torch.linspace(-5.0, 5.0, 12, dtype=torch.float64).reshape(4, 3)
    loud = MLPController(3, 2, seed=1, output_gain=5.0, normalize=False)
    command = loud(seen)
    assert command.shape == (4, 2) and 0.5 < float(command.detach().abs().max()) < 1.0
    again = MLPController(3, 2, seed=1, output_gain=5.0, normalize=False)
    other = MLPController(3, 2, seed=2, output_gain=5.0, normalize=False)
    assert torch.equal(again(seen), command) and not torch.equal(other(seen), command)


def test_gains_of_observations_are_factors_on_them():
    gains = torch.tensor([2.0, 0.0, -1.0], dtype=torch.float64)
    plain = MLPController(3, 1, normalize=False, output_gain=1.0)
    scaled = MLPController(3, 1, normalize=False, output_gain=1.0, input_gains=gains)
    seen = torch.tensor([[0.3, 0.7, -0.2]], dtype=torch.float64)
    torch.testing.assert_close(scaled(seen), plain(gains * seen), rtol=1e-12, atol=0)


def test_an_observation_that_is_no_number_is_refused_and_changes_nothing():
    """It made every later command NaN."""
    normalizer = Normalizer(2)
    normalizer.update(torch.tensor([[1.0, 2.0], [3.0, 5.0]], dtype=torch.float64))
    before = {name: value.clone() for name, value in normalizer.state_dict().items()}
    with pytest.raises(ValueError, match="observations must be finite"):
        normalizer.update(torch.tensor([[math.nan, 0.0]], dtype=torch.float64))
    with pytest.raises(ValueError, match=r"room for their squares in float64, got up to 1e\+200"):
        normalizer.update(torch.full((2, 2), 1e200, dtype=torch.float64))
    normalizer.update(torch.zeros(0, 2, dtype=torch.float64))
    for name, value in normalizer.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_normalizer_of_nothing_or_of_a_list_is_refused():
    with pytest.raises(ValueError, match="size must be a whole number >= 1"):
        Normalizer(0)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("amplitudes", lambda p: Sinusoid(2, 0.1, amplitudes=p)),
        ("phases", lambda p: Sinusoid(2, 0.1, phases=p)),
        ("frequency", lambda p: Sinusoid(2, 0.1, frequency=2.0 * p[0])),
        ("start", lambda p: Knots(1, 0.1, num_knots=2, duration=1.0, start=p[:, None])),
        ("input_gains", lambda p: MLPController(2, 1, input_gains=p)),
    ],
)
def test_a_first_guess_carries_no_gradient_and_says_so(name, make):
    """They were copied without a word."""
    given = torch.tensor([0.5, 0.4], dtype=torch.float64)
    make(given)
    with pytest.raises(ValueError, match=f"{name} must not require grad"):
        make(given.requires_grad_())
