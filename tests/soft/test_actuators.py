"""Lag, rate limit and delay against their differential equation and finite differences."""

import math

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import leaf, noise, soft_body, two_muscles

DT = 0.02


def column(*values):
    """A sequence (num_steps, 1) for one actuator."""
    return torch.tensor(values, dtype=torch.float64)[:, None]


def step_response(dynamics, steps, dt=DT):
    """From rest at 0 towards 1."""
    return dynamics.sequence(torch.ones(steps, 1, dtype=torch.float64), dt, column(0.0)[0])[:, 0]


@pytest.mark.reference
@pytest.mark.parametrize("dt", [1e-3, DT, 0.5])
def test_lag_is_exponential_at_any_step(dt):
    t = dt * torch.arange(1, 9, dtype=torch.float64)
    expected = 1.0 - torch.exp(-t / 0.05)
    torch.testing.assert_close(step_response(soft.FirstOrderLag(0.05), 8, dt), expected)


@pytest.mark.reference
def test_rate_limit_is_a_ramp_that_stops_at_the_command():
    response = step_response(soft.RateLimit(20.0), 4)  # 0.4 a step
    torch.testing.assert_close(response, torch.tensor([0.4, 0.8, 1.0, 1.0]).double())
    back = soft.RateLimit(20.0).sequence(column(-1.0, -1.0, -1.0), DT, column(0.0)[0])[:, 0]
    torch.testing.assert_close(back, torch.tensor([-0.4, -0.8, -1.0]).double())


@pytest.mark.reference
def test_lag_with_rate_limit_solves_its_equation():
    """Against 20,000 explicit Euler steps of the differential equation: error of order 1e-5."""
    lag, rate, steps = 0.03, 12.0, 10
    commands = 1.5 * noise(steps, 1, seed=3)
    dynamics = soft.ActuatorDynamics(time_constant=lag, max_rate=rate)
    found = dynamics.sequence(commands, DT, column(0.0)[0])[:, 0]
    a, fine, expected, saturated = 0.0, 2000, [], 0
    for c in commands[:, 0].tolist():
        for _ in range(fine):
            wanted = (c - a) / lag
            saturated += abs(wanted) > rate
            a += DT / fine * max(-rate, min(rate, wanted))
        expected.append(a)
    assert 0.2 < saturated / (fine * steps) < 0.8  # both regimes were visited
    assert (found - torch.tensor(expected)).abs().max() < 1e-3 * DT / lag


@pytest.mark.reference
def test_delay_shifts_the_response():
    plain = soft.ActuatorDynamics(time_constant=0.05, max_rate=8.0)
    late = soft.ActuatorDynamics(time_constant=0.05, max_rate=8.0, delay_steps=3)
    commands = noise(10, 2, seed=1)
    start = torch.zeros(2, dtype=torch.float64)
    shifted = torch.cat([start.expand(3, 2), commands[:-3]])
    torch.testing.assert_close(
        late.sequence(commands, DT, start), plain.sequence(shifted, DT, start), rtol=0, atol=0
    )


@pytest.mark.property
def test_splitting_a_step_changes_nothing():
    """The exact solution over dt is that over dt/4, four times."""
    dynamics = soft.ActuatorDynamics(time_constant=0.04, max_rate=5.0)
    commands = noise(6, 3, seed=2)
    coarse = dynamics.sequence(commands, DT)
    fine = dynamics.sequence(commands.repeat_interleave(4, dim=0), DT / 4)[3::4]
    torch.testing.assert_close(coarse, fine)


@pytest.mark.property
def test_limits_of_the_combination():
    commands = noise(8, 2, seed=4)
    both = soft.ActuatorDynamics(time_constant=0.05, max_rate=1e6).sequence(commands, DT)
    torch.testing.assert_close(both, soft.FirstOrderLag(0.05).sequence(commands, DT))
    both = soft.ActuatorDynamics(time_constant=1e-9, max_rate=9.0).sequence(commands, DT)
    torch.testing.assert_close(both, soft.RateLimit(9.0).sequence(commands, DT), atol=1e-7, rtol=0)
    none = soft.ActuatorDynamics().sequence(commands, DT)
    torch.testing.assert_close(none, commands, rtol=0, atol=1e-15)


def test_step_by_step_is_the_sequence():
    dynamics = soft.ActuatorDynamics(
        time_constant=torch.tensor([0.02, 0.05]).double(), max_rate=10.0, delay_steps=2
    )
    commands = noise(7, 3, 2, seed=5)  # a batch of three
    state = dynamics.initial_state(commands[0])
    values = []
    for command in commands:
        value, state = dynamics(command, state, DT)
        values.append(value)
    whole = dynamics.sequence(commands, DT)
    torch.testing.assert_close(torch.stack(values), whole, rtol=0, atol=0)
    torch.testing.assert_close(dynamics.sequence(commands[:, 1], DT), whole[:, 1])
    assert (whole[0] == commands[0]).all()  # starts at rest at the first command


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["lag", "rate", "both", "delayed"])
def test_gradients(kind):
    given = {
        "lag": {"time_constant": leaf([0.03, 0.06])},
        "rate": {"max_rate": leaf([14.0, 20.0])},
        "both": {"time_constant": leaf(0.03), "max_rate": leaf([14.0, 20.0])},
        "delayed": {"time_constant": leaf(0.03), "max_rate": leaf(14.0), "delay_steps": 2},
    }[kind]
    delay = given.pop("delay_steps", 0)
    names = list(given)

    def response(commands, initial, *values):
        parameters = dict(zip(names, values, strict=True))
        dynamics = soft.ActuatorDynamics(**parameters, delay_steps=delay)
        return dynamics.sequence(commands, DT, initial)

    args = (leaf(noise(8, 2, seed=6)), leaf([0.1, -0.2]), *given.values())
    out = response(*args)
    grads = torch.autograd.grad(out, args, torch.linspace(1, 2, out.numel()).double().view_as(out))
    assert all(g.abs().max() > 0 for g in grads)
    assert torch.autograd.gradcheck(response, args)


@pytest.mark.grad
def test_gradient_is_continuous_across_the_rate_limit_of_a_lag():
    """Left and right of |e| = r T, and of |e| = r (T + dt) where the whole step is at the limit."""
    lag, rate = 0.05, 4.0
    dynamics = soft.ActuatorDynamics(time_constant=lag, max_rate=rate)

    def slope(error):
        command = leaf([error])
        value, _ = dynamics(command, dynamics.initial_state(torch.zeros(1).double()), DT)
        return torch.autograd.grad(value.sum(), command)[0].item()

    for border in (rate * lag, rate * (lag + DT)):
        at = [slope(border + side) for side in (-1e-9, 0.0, 1e-9)]
        assert max(at) - min(at) < 1e-6
    assert slope(0.1 * rate * lag) == pytest.approx(1 - math.exp(-DT / lag))
    assert slope(2 * rate * (lag + DT)) == 0.0
    assert slope(1e6) == 0.0  # where an exponential left to itself would overflow


@pytest.mark.grad
def test_kink_of_the_pure_rate_limit():
    """At the limit exactly the gradient is that of the command, as documented."""
    rate = leaf(0.5)
    command = leaf([0.25, 0.25, -0.25])
    state = soft.ActuatorState(leaf([0.0, -0.1, 0.1]), torch.zeros(0, 3, dtype=torch.float64))
    value, _ = soft.RateLimit(rate)(command, state, 0.5)
    d_command, d_value, d_rate = torch.autograd.grad(value.sum(), (command, state.value, rate))
    assert d_command.tolist() == [1.0, 0.0, 0.0]
    assert d_value.tolist() == [0.0, 1.0, 1.0]
    assert d_rate.item() == 0.5 - 0.5


@pytest.mark.grad
def test_time_constant_is_found_through_a_rollout():
    """d(tip)/dT through actuator and body, against a central difference."""
    m = mesh.hex_box((2, 1, 1), (2.0, 1.0, 1.0))
    body = soft_body(m, fixed=torch.tensor([0, 1, 2, 3]), muscles=two_muscles()[:1])
    commands = torch.full((5, 1), 0.7, dtype=torch.float64)

    def tip(time_constant):
        lag = soft.FirstOrderLag(time_constant)
        activation = lag.sequence(commands, body.dt, torch.ones(1, dtype=torch.float64))
        motion = soft.rollout(body, body.rest_state(), 5, activation=lambda k, s: activation[k])
        return motion.final.x[-1, 0]

    time_constant = leaf(0.2)
    (slope,) = torch.autograd.grad(tip(time_constant), time_constant)
    h = 1e-4
    difference = (tip(leaf(0.2 + h)) - tip(leaf(0.2 - h))) / (2 * h)
    assert slope.item() == pytest.approx(difference.item(), rel=1e-5)
    assert slope.abs() > 1e-3


def test_parameters_are_trained_and_saved():
    dynamics = soft.ActuatorDynamics(
        time_constant=torch.nn.Parameter(torch.tensor(0.1, dtype=torch.float64)), max_rate=3.0
    )
    assert [n for n, _ in dynamics.named_parameters()] == ["time_constant"]
    assert set(dynamics.state_dict()) == {"time_constant", "max_rate"}
    assert "max_rate=3" in repr(dynamics)
    with torch.no_grad():
        dynamics.time_constant.fill_(-0.1)  # an optimizer went too far
    with pytest.raises(ValueError, match=r"time_constant must lie in .*got -0\.1; unit is s"):
        dynamics.sequence(torch.zeros(2, 1, dtype=torch.float64), DT)


def test_bad_inputs():
    dynamics = soft.ActuatorDynamics(time_constant=[0.1, 0.2], delay_steps=1)
    state = dynamics.initial_state(torch.zeros(2, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"state must be an ActuatorState, got Tensor; use initial"):
        dynamics(state.value, state.value, DT)
    with pytest.raises(ValueError, match=r"state.pending must have shape \(1, 2\), got \(0, 2\)"):
        dynamics(state.value, soft.ActuatorDynamics().initial_state(state.value), DT)
    with pytest.raises(ValueError, match=r"time_constant must have shape \(3\), got \(2"):
        dynamics.sequence(torch.zeros(4, 3, dtype=torch.float64), DT)
    with pytest.raises(ValueError, match="commands must hold at least one step"):
        dynamics.sequence(torch.zeros(0, 2, dtype=torch.float64), DT)
