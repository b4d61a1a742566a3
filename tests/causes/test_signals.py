"""Signals on their way: against closed forms and scipy."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy import interpolate, signal

from diffsim.causes import interpolation, signals
from diffsim.causes import signals as maps
from diffsim.causes.commands import CommandGroup, command_cause
from diffsim.causes.scene import Instruments
from diffsim.causes.signals import MAPS


def column(values):
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)[:, None]


def on_columns(change, u, dt, size):
    """A map of signals every ``dt``, in columns."""
    return change(u.mT, signals.Grid.even(u.shape[-2], dt), size[..., None]).mT


class Wire:
    """A scene that is nothing but a command on its way."""

    def __init__(self, u):
        self.u = u

    play_start = None

    def with_command(self, names, change):
        return Wire(change(self.u.mT, signals.Grid.even(len(self.u), 0.1)).mT)


def sent(u, cause, size):
    """A command after a cause."""
    group = CommandGroup((), {"reach": float(u.abs().max())})
    effect = command_cause(cause, group)
    return effect.apply(Wire(u), torch.tensor([size], dtype=torch.float64), None).u


def said(cause, unit, shown=None):
    """A cause of commands in a unit."""
    return command_cause(cause, CommandGroup((), {"reach": 1.6}, unit=unit, shown=shown))


@pytest.mark.order
def test_sampling_is_of_fourth_order():
    times = torch.linspace(0.0, 1.0, 137, dtype=torch.float64)
    steps = [1 / 20, 1 / 40, 1 / 80]
    errors = []
    for dt in steps:
        grid = np.arange(0, 1 + dt / 2, dt)
        found = interpolation.sample(column(1 - np.cos(7 * grid)), dt, times)[:, 0]
        errors.append(float((found - (1 - torch.cos(7 * times))).abs().max()))
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] > 3.8


def test_sampling_differentiates_times_and_holds_the_ends():
    dt, values = (
        0.1,
        torch.randn(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
    )
    times = torch.tensor([0.03, 0.27, 0.55], dtype=torch.float64, requires_grad=True)
    values.requires_grad_()
    assert torch.autograd.gradcheck(lambda v, t: interpolation.sample(v, dt, t), (values, times))
    outside = interpolation.sample(values, dt, torch.tensor([-1.0, 5.0], dtype=torch.float64))
    torch.testing.assert_close(outside, values[[0, -1]])
    with pytest.raises(ValueError, match="five steps"):
        interpolation.sample(values[:4], dt, times)


def test_lag_is_that_of_a_linear_system():
    rng = np.random.default_rng(0)
    dt, u = 0.02, np.cumsum(rng.standard_normal(60))
    for tau in (0.003, 0.05, 1.0):
        system = signal.StateSpace([[-1 / tau]], [[1 / tau]], [[1.0]], [[0.0]])
        _, want, _ = signal.lsim(system, u, dt * np.arange(60), X0=[u[0]])
        got = on_columns(maps.lagged, column(u), dt, torch.tensor(tau, dtype=torch.float64))[:, 0]
        np.testing.assert_allclose(got, want, atol=1e-9)  # lsim's matrix exponential


def test_small_lag_and_delay_have_minus_the_slope():
    dt = 0.01
    t = dt * torch.arange(50, dtype=torch.float64)
    u, slope = torch.sin(3 * t)[:, None], 3 * torch.cos(3 * t)
    for change in (maps.lagged, maps.smoothly_delayed):
        _, got = torch.autograd.functional.jvp(
            lambda size, change=change: on_columns(change, u, dt, size),
            torch.zeros((), dtype=torch.float64),
            torch.ones((), dtype=torch.float64),
        )
        # straight lines: the slope over a step is off by dt u'' / 2
        torch.testing.assert_close(got[1:-1, 0], -slope[1:-1], atol=0.5 * dt * 9 + 1e-6, rtol=0)


def test_delay_shifts_samples():
    u = column([0, 1, 4, 9, 16, 25])
    got = on_columns(maps.smoothly_delayed, u, 0.1, torch.tensor(0.2, dtype=torch.float64))
    torch.testing.assert_close(got, column([0, 0, 0, 1, 4, 9]))


def test_delay_between_samples_is_a_monotone_cubic():
    rng = np.random.default_rng(0)
    u, dt = np.round(rng.standard_normal(30), 1), 0.1
    delay = 0.034
    got = on_columns(maps.smoothly_delayed, column(u), dt, torch.tensor(delay, dtype=torch.float64))
    t = dt * np.arange(30)
    want = interpolate.PchipInterpolator(t, u)(t - delay)
    np.testing.assert_allclose(got[2:-1, 0], want[2:-1], atol=1e-12)  # its ends are not held


def test_dead_band_backlash_and_saturation_by_hand():
    u = column([0, 1, 3, 2, 1, -2])
    half = torch.tensor(0.5, dtype=torch.float64)
    torch.testing.assert_close(sent(u, "dead_band", 0.5), column([0, 0.5, 2.5, 1.5, 0.5, -1.5]))
    torch.testing.assert_close(
        on_columns(maps.with_play, u, 0.1, half), column([0, 0.5, 2.5, 2.5, 1.5, -1.5])
    )
    got = sent(u, "saturation", 1 / 3)
    torch.testing.assert_close(got, column([0, 1, 2, 2, 1, -2]))


def held_means(u, dt, response, fine=4000):
    """Mean over each step of a response to a held command, by brute force."""
    t = (np.arange(len(u) * fine) + 0.5) * dt / fine
    return response(np.repeat(u, fine), t).reshape(len(u), fine).mean(1)


def test_held_lag_and_delay_are_means_over_steps():
    rng = np.random.default_rng(0)
    u, dt, tau = rng.standard_normal(8), 0.01, 0.013

    def late(fine, t):
        return u[np.clip(np.floor((t - 0.024) / dt).astype(int), 0, 7)]

    held = partial(maps.held_delayed, signed=False)
    got = on_columns(held, column(u), dt, torch.tensor(0.024, dtype=torch.float64))[:, 0]
    np.testing.assert_allclose(got, held_means(u, dt, late), atol=1e-12)

    def lagging(fine, t):
        h = t[1] - t[0]
        share = -np.expm1(-h / tau)
        y, out = u[0], []
        for target in fine:
            out.append(y + (target - y) * 0.5 * share)
            y += (target - y) * share
        return np.array(out)

    got = on_columns(maps.held_lagged, column(u), dt, torch.tensor(tau, dtype=torch.float64))[:, 0]
    np.testing.assert_allclose(got, held_means(u, dt, lagging), atol=1e-6)  # midpoints
    none = on_columns(maps.held_lagged, column(u), dt, torch.zeros((), dtype=torch.float64))[:, 0]
    np.testing.assert_allclose(none, u)


def test_a_held_command_that_can_only_be_late_has_the_slope_of_late():
    u, dt, zero = column([0.0, 0.0, 1.0, 1.0]), 0.1, torch.zeros((), dtype=torch.float64)
    slopes = {}
    for signed in (True, False):
        change = partial(maps.held_delayed, signed=signed)
        _, slopes[signed] = torch.autograd.functional.jvp(
            lambda size, change=change: on_columns(change, u, dt, size), zero, zero + 1.0
        )
    torch.testing.assert_close(slopes[False], column([0.0, 0.0, -10.0, 0.0]))
    torch.testing.assert_close(slopes[True], column([0.0, -5.0, -5.0, 0.0]))


def test_slack_and_rate_limit_by_hand():
    u = column([0, 1, 3, 3, -1])
    torch.testing.assert_close(sent(u, "slack", 0.5), column([0, 0.5, 2.5, 2.5, -1]))
    torch.testing.assert_close(sent(u, "rate_limit", 0.1), column([0, 1, 2, 3, 2]))
    torch.testing.assert_close(sent(u, "rate_limit", 0.0), u, rtol=0, atol=0)


def test_limits_are_said_in_the_unit_of_the_command():
    limit = said("rate_limit", "rad", "deg")
    assert limit.words(0.5) == "a speed limit near 115 deg/s" and limit.words(0.0) == "none"
    assert (limit.shown_unit, limit.shown_power) == ("deg/s", -1)
    profile = said("acceleration_limit", "rad", "deg")  # "0.14 to 0.26 s^2/command" nobody reads
    assert (profile.shown_unit, profile.shown_power) == ("deg/s^2", -1)
    assert said("rate_limit", "N").words(0.5) == "a rate limit near 2 N/s"
    assert said("slack", "m", "mm").words(0.0074) == "7.4 mm of slack"
    assert said("lag", "N").words is None


def test_what_comes_before_a_delay_of_zero_keeps_its_slope():
    u = torch.linspace(0.0, 1.0, 9, dtype=torch.float64).sin().requires_grad_()
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    out = maps.held_delayed(u, maps.Grid.even(9, 0.1), zero)
    by_signal, by_delay = torch.autograd.grad(out.sum(), (u, zero))
    np.testing.assert_allclose(by_signal, 1.0)  # it was 2: the delayed signal counted, too
    step = torch.tensor(1e-6, dtype=torch.float64)
    with torch.no_grad():
        ends = [maps.held_delayed(u, maps.Grid.even(9, 0.1), s).sum() for s in (step, -step)]
    assert float(by_delay) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("differentiated", [False, True])
def test_decayed_is_one_recursion_for_numbers_and_for_gradients(differentiated):
    rng = np.random.default_rng(4)
    term = torch.from_numpy(rng.standard_normal((2, 3, 9))).requires_grad_(differentiated)
    factor = torch.tensor([[0.4], [0.9]], dtype=torch.float64)
    got = maps.decayed(factor, term).detach().numpy()
    for row, terms, a in zip(got, term.detach().numpy(), (0.4, 0.9), strict=True):
        state = np.zeros(3)
        for k in range(9):
            state = a * state + terms[:, k]
            np.testing.assert_allclose(row[:, k], state, atol=1e-14)


@pytest.mark.parametrize("name", [n for n in MAPS if n != "in_steps"])
@pytest.mark.parametrize("between", ["held", "straight", "smooth"])
def test_of_a_single_sample_nothing_came_before(name, between):
    u = torch.tensor([[1.3]], dtype=torch.float64)
    sizes = torch.tensor([[0.0], [0.2]], dtype=torch.float64)
    got = MAPS[name][between](u, signals.Grid.even(1, 0.1), sizes)
    torch.testing.assert_close(got, u.expand(2, 1, 1), rtol=0, atol=0)


def test_rows_are_changed_each_by_its_own_size_and_the_others_stay():
    grid = signals.Grid.even(4, 0.1)
    y = torch.arange(12.0, dtype=torch.float64).reshape(3, 4)
    sizes = torch.tensor([[1.0, 100.0], [2.0, 200.0]], dtype=torch.float64)  # of two points
    got = signals.change_rows(y, (2, 0), lambda u, grid: u + sizes[..., None], grid)
    added = torch.tensor([[100.0, 0.0, 1.0], [200.0, 0.0, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(got, y + added[..., None], rtol=0, atol=0)
    whole = signals.change_rows(y, (), lambda u, grid: -u, grid)
    torch.testing.assert_close(whole, -y, rtol=0, atol=0)


def test_points_are_counted_where_a_reading_uses_a_later_channel():
    def leak(shown, grid):
        return shown + torch.ones(5, 1, 1, dtype=torch.float64) * shown[..., 2:3, :]

    assert Instruments().with_reading((), leak).num_points(3) == 5
    assert Instruments().num_points(3) == 0
