"""Compiled loops over times against torch's own operations."""

import numpy as np
import pytest
import torch

from diffsim.causes._ops_signals import _approach, _follow, _read_lines, find_intervals
from diffsim.causes.signals import Grid, slowed, with_play

RNG = np.random.default_rng(5)


def tensor(values):
    return torch.as_tensor(values, dtype=torch.float64)


U = tensor(np.cumsum(RNG.normal(size=(3, 1, 80)), -1))
TIMES = Grid(tensor(np.cumsum(RNG.uniform(0.01, 0.1, 80))), torch.arange(80), np.arange(80.0))
SIZES = tensor([0.0, 0.3, 1.7, 40.0])


def loops(seed):
    """Ops that go from one time to the next, with drawn arguments that differentiate."""
    rng = np.random.default_rng(seed)
    u = tensor(np.cumsum(rng.normal(size=(4, 20)), -1))
    room, share = tensor(rng.uniform(0.2, 1.5, (4, 19))), tensor(rng.uniform(0.0, 1.0, (4, 1)))
    start, most = tensor(rng.normal(size=4)), tensor(rng.uniform(5.0, 300.0, 4))
    steps, fastest = tensor(rng.uniform(0.05, 0.2, 19)), tensor(rng.uniform(1.0, 20.0, 4))
    places = {
        f"reached, held {held}": (_approach, (u, steps, most, fastest, held))
        for held in (False, True)
    }
    times = tensor(np.cumsum(rng.uniform(0.05, 0.2, 20)))
    ways = tensor(rng.uniform(float(times[0]) - 0.5, float(times[-1]) + 0.5, (4, 20)))
    return places | {
        "read": (_read_lines, (u, times, ways, True)),
        "read, one signal": (_read_lines, (u[:1].clone(), times, ways, True)),
        "read, one way": (_read_lines, (u, times, ways[:1].clone(), False)),
        "play": (_follow, (u, room, start, 0)),
        "slowed": (_follow, (u, room, start, 1)),
        "decays": (_follow, (u, share, start, 2)),
    }


@pytest.mark.parametrize("name", loops(0))
def test_values_and_slopes_are_those_of_torchs_own_operations(name):
    """Both modes, away from the kinks of numbers that were drawn; then slopes of slopes."""
    op, args = loops(1)[name]
    given = dict(zip(op.arguments, args, strict=True))
    moving = [n for n in op.arguments if isinstance(given[n], torch.Tensor) and op.inputs[n].smooth]
    at = tuple(given[n].requires_grad_() for n in moving)

    def compiled(*values):
        return op(**given | dict(zip(moving, values, strict=True)))

    def in_torch(*values):
        return op.in_torch(given | dict(zip(moving, values, strict=True)))[0]

    torch.testing.assert_close(compiled(*at), in_torch(*at), rtol=1e-13, atol=1e-13)
    weight = tensor(RNG.normal(size=(4, 20)))
    slopes = [torch.autograd.grad((f(*at) * weight).sum(), at) for f in (compiled, in_torch)]
    torch.testing.assert_close(*slopes, rtol=1e-10, atol=1e-12)
    along = tuple(tensor(RNG.normal(size=value.shape)) for value in at)
    moved = torch.func.jvp(compiled, at, along)[1]
    expected = sum((s * d).sum() for s, d in zip(slopes[1], along, strict=True))
    torch.testing.assert_close((moved * weight).sum(), expected, rtol=1e-10, atol=1e-12)
    step = 1e-7
    ends = [compiled(*(v + s * d for v, d in zip(at, along, strict=True))) for s in (step, -step)]
    torch.testing.assert_close((ends[0] - ends[1]) / (2 * step), moved, rtol=1e-5, atol=1e-5)
    bent = [
        torch.autograd.grad(
            sum((g * d).sum() for g, d in zip(made, along, strict=True)), at, allow_unused=True
        )
        for made in (
            torch.autograd.grad((f(*at).sin() * weight).sum(), at, create_graph=True)
            for f in (compiled, in_torch)
        )
    ]
    torch.testing.assert_close(*bent, rtol=1e-9, atol=1e-9)


def test_what_rests_on_its_target_moves_with_it():
    """At rest it has no distance to go: its slope there is that of both sides."""
    u, steps = torch.ones(1, 20, dtype=torch.float64), torch.full((19,), 0.1, dtype=torch.float64)
    limits = tensor([3.0]), tensor([50.0])
    d_u = torch.zeros_like(u)
    d_u[0, 8:] = 1e-6  # small: it is there within a part, held or not
    moved = torch.func.jvp(lambda v: _approach(v, steps, *limits, True), (u,), (d_u,))[1]
    ends = [_approach(u + s * d_u, steps, *limits, True) for s in (1.0, -1.0)]
    torch.testing.assert_close(0.5 * (ends[0] - ends[1]), moved, rtol=1e-6, atol=1e-12)


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


@pytest.mark.parametrize("both_sides", [False, True])
def test_lines_are_read_as_numpy_reads_them_and_have_the_slopes_of_both_sides(both_sides):
    times, u = TIMES.times, U[:, 0]
    inside = tensor(RNG.permutation(np.linspace(float(times[0]), float(times[-1]), 300)))
    read = _read_lines(u, times, inside[None], both_sides)
    expected = [np.interp(inside, times, row) for row in u]
    torch.testing.assert_close(read, tensor(np.array(expected)), rtol=1e-13, atol=1e-13)

    at = times[None, 1:-1].clone().requires_grad_()  # at times themselves
    slopes = torch.autograd.grad(_read_lines(u[:1], times, at, both_sides).sum(), at)[0]
    sides = u[0].diff() / times.diff()
    mean = 0.5 * (sides[:-1] + sides[1:])
    torch.testing.assert_close(slopes[0], mean if both_sides else sides[:-1])
