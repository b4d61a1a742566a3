"""Are commands within what the servo can follow, and differentiable?"""

import numpy as np
import pytest
import torch

from labs.loop.command import Command, Limits, followed, interpolation, sinusoid
from labs.loop.trajectory import speed

LIMITS = Limits(contraction_m=0.012, rate_m_s=0.1)


def wish(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.02 * torch.rand(60, generator=generator, dtype=torch.float64) - 0.004


@pytest.mark.parametrize("seed", range(4))
def test_followed_keeps_bounds_and_rate_around_the_period(seed):
    Command(followed(wish(seed), LIMITS).numpy()).check(LIMITS)


def test_what_can_be_followed_is_not_changed():
    c = sinusoid(period_s=1.0, cycles=1, amplitude_m=0.006, limits=LIMITS).contraction_m
    np.testing.assert_allclose(followed(torch.from_numpy(c), LIMITS).numpy(), c, atol=1e-15)


def test_gradient_of_followed_is_that_of_differences():
    x = wish().requires_grad_()
    weights = torch.linspace(-1.0, 1.0, 60, dtype=torch.float64)
    (slope,) = torch.autograd.grad(weights @ followed(x, LIMITS), x)
    h = 1e-8
    differences = []
    with torch.no_grad():
        for k in range(60):
            step = h * torch.eye(60, dtype=torch.float64)[k]
            ends = [weights @ followed(x + s * step, LIMITS) for s in (1.0, -1.0)]
            differences.append((ends[0] - ends[1]) / (2.0 * h))
    torch.testing.assert_close(slope, torch.stack(differences), atol=1e-6, rtol=0.0)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ([0.0, 0.001, 0.02], "must lie in"),
        ([0.0, 0.005, 0.01], "m/s, got"),
        ([0.0, 0.0016, 0.0032], "m/s, got"),  # only the jump back to the start is too fast
    ],
)
def test_check_refuses(values, says):
    with pytest.raises(ValueError, match=says):
        Command(np.array(values)).check(LIMITS)


def test_interpolation_is_exact_at_knots_and_periodic():
    rows = interpolation(4, 12)
    np.testing.assert_allclose(rows.sum(1), 1.0)
    np.testing.assert_allclose(rows[::3], np.eye(4))
    np.testing.assert_allclose(rows[10], [1 / 3, 0.0, 0.0, 2 / 3])


def test_command_repeats():
    c = Command(np.arange(6.0))
    np.testing.assert_array_equal(c.during(0.25), np.arange(15) % 6)


def test_speed_ignores_the_first_period_the_phase_and_gaps():
    t = np.arange(240) / 60.0
    x = -0.004 * t + 0.002 * np.sin(2 * np.pi * t)
    x[:60] += 1.0  # the first period does not count
    x[100] = np.nan
    assert speed(t, x, 1.0) == pytest.approx(0.004, rel=0.02)
    with pytest.raises(ValueError, match="two periods"):
        speed(t[:90], x[:90], 1.0)
