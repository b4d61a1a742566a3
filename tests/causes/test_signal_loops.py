"""Compiled loops over times against torch's own operations."""

import numpy as np
import pytest
import torch

from diffsim.causes._ops_signals import find_intervals
from diffsim.causes.signals import Grid, slowed, with_play

RNG = np.random.default_rng(5)


def tensor(values):
    return torch.as_tensor(values, dtype=torch.float64)


U = tensor(np.cumsum(RNG.normal(size=(3, 1, 80)), -1))
TIMES = Grid(tensor(np.cumsum(RNG.uniform(0.01, 0.1, 80))), torch.arange(80), np.arange(80.0))
SIZES = tensor([0.0, 0.3, 1.7, 40.0])


@pytest.mark.parametrize(
    "change", [slowed, with_play, lambda u, t, s: with_play(u, t, s, tensor([-1.0, 0, 0.2, 1]))]
)
def test_values_are_those_of_the_loop_that_knows_derivatives(change):
    u = U.clone().requires_grad_()
    walked = change(u, TIMES, SIZES)
    assert walked.shape == (3, 4, 80)
    assert torch.equal(change(U, TIMES, SIZES), walked.detach())


@pytest.mark.parametrize("change", [slowed, with_play])
def test_a_value_that_is_no_number_stays_visible(change):
    u = U[0, 0].clone()
    u[30] = float("nan")
    out = change(u, TIMES, tensor(0.3))
    assert out[:30].isfinite().all() and out[30:].isnan().all()


@pytest.mark.parametrize("of_equal", ["left", "right"])
@pytest.mark.parametrize("places", ["late", "early", "shuffled", "outside", "times"])
def test_intervals_are_those_of_a_binary_search(of_equal, places):
    times = TIMES.times
    wanted = {
        "late": times - SIZES[:, None],
        "early": times + tensor(0.013),
        "shuffled": tensor(RNG.permutation(np.linspace(-1.0, 9.0, 500))),
        "outside": tensor([-5.0, 99.0, -1.0, 50.0, 0.0]),
        "times": times[torch.tensor([5, 5, 6, 4, 79, 0, 78, 40])],
    }[places]
    found = torch.searchsorted(times, wanted, right=of_equal == "right")
    expected = (found - 1).clamp(0, len(times) - 2)
    assert torch.equal(find_intervals(times, wanted, of_equal=of_equal), expected)
