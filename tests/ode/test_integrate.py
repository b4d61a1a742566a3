"""Equations given by formulas: against closed forms, scipy, orders, and differences."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim import IntegrationError
from diffsim.ode import Ode
from diffsim.ode.integrate import integrated
from tests.gradients import check_directions

OSCILLATOR = Ode(
    rates={"x": "v", "v": "(u - k * x - c * v) / m"},
    readings={"position": "x", "force": "k * x + c * v"},
    inputs=["u"],
    parameters=["m", "k", "c"],
)
P = torch.tensor([1.5, 40.0, 0.8], dtype=torch.float64)


def grid(count: int, until: float) -> torch.Tensor:
    return torch.linspace(0.0, until, count, dtype=torch.float64)


@pytest.mark.reference
def test_damped_oscillator_in_closed_form():
    t = grid(201, 2.0)
    start = torch.tensor([0.3, 0.0], dtype=torch.float64)
    y, x = OSCILLATOR.solve(t, start, torch.zeros(201, 1, dtype=torch.float64), P, num_steps=4)
    rate, omega = 0.8 / 3.0, math.sqrt(40.0 / 1.5 - (0.8 / 3.0) ** 2)
    wanted = (
        0.3 * torch.exp(-rate * t) * (torch.cos(omega * t) + rate / omega * torch.sin(omega * t))
    )
    torch.testing.assert_close(y[:, 0], wanted, rtol=0, atol=1e-9)
    torch.testing.assert_close(y[:, 1], 40.0 * x[:, 0] + 0.8 * x[:, 1], rtol=1e-14, atol=1e-14)


@pytest.mark.reference
def test_against_scipy_with_friction_and_an_input():
    ode = Ode(
        rates={"x": "v", "v": "(u - f * tanh(v / 0.05) - k * x ** 3) / 2"},
        readings={"x": "x", "v": "v"},
        inputs=["u"],
        parameters=["f", "k"],
    )
    t = grid(101, 3.0)
    u = torch.sin(3.0 * t)[:, None]
    y, _ = ode.solve(t, torch.zeros(2).double(), u, torch.tensor([0.2, 5.0]).double(), num_steps=8)

    def rate(now, state):
        force = np.interp(now, t.numpy(), u[:, 0].numpy())
        return [state[1], (force - 0.2 * np.tanh(state[1] / 0.05) - 5.0 * state[0] ** 3) / 2]

    wanted = solve_ivp(
        rate, (0.0, 3.0), [0.0, 0.0], t_eval=t.numpy(), rtol=1e-10, atol=1e-12, max_step=0.01
    )
    np.testing.assert_allclose(y.numpy(), wanted.y.T, atol=2e-7)


@pytest.mark.order
def test_fourth_order():
    ode = Ode(rates={"x": "-x * sin(t)"}, readings={"x": "x"})
    exact = math.exp(math.cos(2.0) - 1.0)
    t = grid(3, 2.0)
    errors = [
        abs(float(ode.solve(t, torch.ones(1).double(), num_steps=n)[0][-1]) - exact)
        for n in (4, 8, 16)
    ]
    slope = np.polyfit(np.log([1 / 4, 1 / 8, 1 / 16]), np.log(errors), 1)[0]
    assert slope == pytest.approx(4.0, abs=0.1)


def test_a_held_input_is_constant_until_the_next_sample():
    t = grid(5, 4.0)
    u = torch.arange(5.0).double()[:, None]
    for held, wanted in ((["u"], [0, 0, 1, 3, 6]), ([], [0, 0.5, 2, 4.5, 8])):
        ode = Ode(rates={"x": "u"}, readings={"x": "x"}, inputs=["u"], held=held)
        y, _ = ode.solve(t, torch.zeros(1).double(), u)
        assert y[:, 0].tolist() == pytest.approx(wanted, abs=1e-14)


def test_limits_are_kept():
    ode = Ode(rates={"h": "1"}, readings={"h": "h"}, limits={"h": (-math.inf, 2.5)})
    y, _ = ode.solve(grid(6, 5.0), torch.zeros(1).double())
    assert y[:, 0].tolist() == pytest.approx([0, 1, 2, 2.5, 2.5, 2.5])


@pytest.mark.grad
@pytest.mark.parametrize("root", ["max(x - 0.5, 0)**p", "sqrt(max(x - 0.5, 0))", "max(x, 0.5)**p"])
def test_a_root_of_what_is_flat_has_no_slope(root):
    """Below 0.5 the chain has a slope of zero behind one that is infinite."""
    ode = Ode(rates={"x": "-x"}, readings={"y": root + " + 0*p"}, parameters=["p"])
    start = torch.tensor([[0.4], [0.9]], dtype=torch.float64, requires_grad=True)
    power = torch.tensor([[0.55]], dtype=torch.float64, requires_grad=True)
    readings, _ = ode.solve(grid(3, 1e-3), start, parameters=power, num_steps=1)
    grad, of_power = torch.autograd.grad(readings.sum(), (start, power))
    assert grad.isfinite().all() and of_power.isfinite().all()
    assert grad[0, 0] == 0.0 and grad[1, 0] > 1.0
    _, tangent = torch.func.jvp(
        lambda x: ode.solve(grid(3, 1e-3), x, parameters=power.detach(), num_steps=1)[0].sum(),
        (start.detach(),),
        (torch.ones_like(start),),
    )
    torch.testing.assert_close(tangent, grad.sum())


EVERY_OPERATION = Ode(
    rates={
        "x": "0.3 * sin(v) * exp(-x ** 2) + 0.1 * atan2(v, 2 + x) - 0.1 * asinh(u)",
        "v": "-x + clip(u, -0.4, 0.4) + where(t > 0.25, a, b) * tanh(x / 0.2) + log(2 + cos(v))",
        "w": "sqrt(1 + hypot(x, v)) - abs(w) ** 1.3 + a ** (1 + x ** 2) - sinh(b * w) + cosh(x)",
    },
    readings={
        "one": "x * v + tan(w / 3) - u",
        "two": "max(x, v) - min(w, a) + atan(x) + asin(x / 9) + acos(v / 9) + sign(x) * b / a",
        "three": "v",
    },
    inputs=["u"],
    parameters=["a", "b"],
)


def given(batch: int, *, shared: bool):
    rng = np.random.default_rng(3)
    t = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.5, 0.62], dtype=torch.float64)
    start = torch.from_numpy(rng.uniform(0.2, 0.8, (batch, 3)))
    u = torch.from_numpy(rng.uniform(-0.8, 0.8, (1 if shared else batch, 6, 1)))
    p = torch.from_numpy(rng.uniform(0.5, 1.0, (batch, 2)))
    return t, [a.requires_grad_() for a in (start, u, p)]


@pytest.mark.grad
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("batch", [1, 3, 9])
def test_gradient(batch, shared):
    t, inputs = given(batch, shared=shared)
    check_directions(
        lambda *a: EVERY_OPERATION.solve(t, *a, num_steps=2),
        inputs,
        seeds=(0, 1),
        rtol=1e-6,
        atol=1e-8,
        check_forward_ad=True,
    )


@pytest.mark.grad
def test_gradient_at_limits_and_with_held_inputs():
    ode = Ode(
        rates={"x": "u - a * x"}, readings={"x": "x"}, inputs=["u"], parameters=["a"],
        held=["u"], limits={"x": (0.0, 0.3)},
    )  # fmt: skip
    t = grid(6, 1.0)
    u = torch.tensor([1.0, 1.0, 0.2, -1.0, -2.0, 0.5]).double()[:, None].requires_grad_()
    start = torch.tensor([0.1]).double().requires_grad_()
    a = torch.tensor([0.7]).double().requires_grad_()
    x = ode.solve(t, start, u, a, num_steps=3)[0][:, 0]
    assert float(x.detach().max()) == 0.3 and float(x.detach().min()) == 0.0
    assert torch.autograd.gradcheck(
        lambda *z: ode.solve(t, *z, num_steps=3), (start, u, a), check_forward_ad=True
    )


@pytest.mark.property
def test_members_of_a_batch_do_not_see_each_other_nor_threads():
    t, (start, u, p) = given(19, shared=False)
    y, x = EVERY_OPERATION.solve(t, start, u, p, num_steps=3)
    two = EVERY_OPERATION.solve(t, start, u, p, num_steps=3, num_threads=2)[0]
    assert torch.equal(y, two)
    for k in (0, 8, 18):
        alone = EVERY_OPERATION.solve(t, start[k], u[k], p[k], num_steps=3)
        assert torch.equal(alone[0], y[k]) and torch.equal(alone[1], x[k])


@pytest.mark.property
def test_members_with_times_of_their_own_are_as_alone():
    t, (start, u, p) = given(11, shared=False)
    times = t * torch.linspace(0.5, 1.5, 11, dtype=torch.float64)[:, None]
    times[3, 4:] = times[3, 3]  # a shorter run stays where it ends
    problem = EVERY_OPERATION.problem(times, 3, 1)
    y, x = integrated(EVERY_OPERATION, problem, start, u, p)
    for k in (0, 3, 10):
        last = 4 if k == 3 else 6
        alone = EVERY_OPERATION.solve(times[k, :last], start[k], u[k, :last], p[k], num_steps=3)
        assert torch.equal(alone[0], y[k, :last]) and torch.equal(alone[1], x[k, :last])
    assert torch.equal(x[3, 4:], x[3, 3:4].expand(2, -1))


@pytest.mark.grad
def test_gradient_with_times_of_their_own():
    t, inputs = given(3, shared=False)
    times = t * torch.tensor([[0.7], [1.0], [1.2]], dtype=torch.float64)
    check_directions(
        lambda *a: EVERY_OPERATION.solve(times, *a, num_steps=2),
        inputs,
        seeds=(0,),
        rtol=1e-6,
        atol=1e-8,
        check_forward_ad=True,
    )
    one, (start, u, p) = EVERY_OPERATION, inputs
    both = [torch.autograd.grad(one.solve(times, start, u, p)[0].sum(), start, create_graph=True)]
    both += [
        torch.autograd.grad(
            sum(one.solve(times[k], start[k], u[k], p[k])[0].sum() for k in range(3)),
            start,
            create_graph=True,
        )
    ]
    second = [torch.autograd.grad(g[0].square().sum(), p)[0] for g in both]
    torch.testing.assert_close(*second)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rates": {"x": "velocity"}}, "rate of x.*'velocity' is not known"),
        ({"readings": {"y": "x +"}}, "reading of y"),
        ({"parameters": ["x"]}, r"names repeat.*\['x'\]"),
        ({"held": ["w"]}, "held"),
        ({"limits": {"x": (1.0, 0.0)}}, "limits of x"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Ode(**({"rates": {"x": "-x"}, "readings": {"y": "x"}} | change))


@pytest.mark.parametrize(("rate", "start"), [("log(x) - 1", 0.5), ("-x**2.5 - 1", 0.1)])
def test_a_formula_without_a_value_is_an_error_with_its_time(rate, start):
    ode = Ode(rates={"x": rate}, readings={"y": "x"})
    times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    with pytest.raises(IntegrationError, match=r"x is no number from 0\.\d+ s on") as lost:
        ode.solve(times, torch.tensor([start], dtype=torch.float64))
    assert lost.value.item == 0 and 0.0 < lost.value.time < 2.0
    found, _ = ode.solve(times, torch.tensor([start], dtype=torch.float64), finite=False)
    first = int(torch.nonzero(~found[:, 0].isfinite())[0])
    assert float(times[first]) == lost.value.time


def test_the_member_of_a_batch_that_is_lost_is_said():
    ode = Ode(rates={"x": "log(x) - 1"}, readings={"y": "x"})
    times = torch.linspace(0.0, 2.0, 41, dtype=torch.float64)
    with pytest.raises(IntegrationError, match="x of item 1") as lost:
        ode.solve(times, torch.tensor([[4.0], [0.5]], dtype=torch.float64))
    assert lost.value.item == 1
    own = times * torch.tensor([[1.0], [1.5]], dtype=torch.float64)
    with pytest.raises(IntegrationError, match="x of item 1") as later:
        ode.solve(own, torch.tensor([[4.0], [0.5]], dtype=torch.float64))
    assert later.value.time in own[1].tolist()
    assert abs(later.value.time - lost.value.time) < 0.1  # x'(t) is the same, as is where it ends


def test_times_carry_no_gradient_and_say_so():
    """It was silently zero, where differences give -0.368."""
    ode = Ode(rates={"x": "-x"}, readings={"y": "x"})
    times = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)

    def last(scale):
        return ode.solve(times * scale, one)[0][-1, 0]

    with pytest.raises(ValueError, match="times must not require grad"):
        last(torch.ones((), dtype=torch.float64, requires_grad=True))
    with pytest.raises(ValueError, match="times must not require grad"):
        torch.func.jvp(last, (one[0],), (one[0],))
    with pytest.raises(ValueError, match="times must not require grad"):
        torch.func.grad(last)(one[0])
