"""Compiled loops over times against torch's own operations."""

import numpy as np
import pytest
import torch

from diffsim.causes._ops_signals import _accelerate, approach, find_intervals
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


@pytest.mark.grad
@pytest.mark.parametrize("held", [False, True])
def test_what_accelerates_is_what_torch_makes_of_it(held):
    """Values, both modes and second derivatives, with limits of acceleration and of speed."""
    steps, rows = tensor([0.1] * 6), U[:, 0, :7].clone()
    numbers = [rows, tensor([5.0, 40.0, 30.0]), tensor([9.0, 1e6, 2.0])]
    moving = tuple(number.requires_grad_() for number in numbers)
    weights = tensor(RNG.normal(size=rows.shape))

    def compiled(targets, most, fastest):
        return approach(targets, steps, most, fastest, held=held)

    def in_torch(targets, most, fastest):
        named = {"targets": targets, "most": most, "fastest": fastest}
        return _accelerate(named | {"steps": steps, "held": held})

    def slopes(function):
        loss = (function(*moving) * weights).sum()
        first = torch.autograd.grad(loss, moving, create_graph=True)
        return [*first, *torch.autograd.grad(sum(g.square().sum() for g in first), moving)]

    torch.testing.assert_close(compiled(*moving), in_torch(*moving), rtol=1e-12, atol=1e-12)
    found, expected = slopes(compiled), slopes(in_torch)
    assert all(float(slope.detach().abs().max()) > 0.1 for slope in expected[:3])
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    ways = tuple(tensor(RNG.normal(size=number.shape)) for number in numbers)
    along = torch.func.jvp(compiled, tuple(n.detach() for n in numbers), ways)[1]
    total = sum((g * way).sum() for g, way in zip(expected, ways, strict=False))
    torch.testing.assert_close((along * weights).sum(), total, rtol=1e-9, atol=1e-9)


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
