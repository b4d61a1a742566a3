"""Gradients of flights against finite differences, beside those by every tensor of ``fly``, with
all effects and feedback, in ``tests/derivatives``."""

from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
import torch

from diffsim.copter.dynamics import _ops_flight
from diffsim.copter.dynamics.flight import Feedback, fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.effects import FlightEffects, MotorLag
from tests.copter.flight_cases import all_effects, crooked_copter, tensor, tumbling
from tests.gradients import check_directions
from tests.helpers import with_derivatives

pytestmark = pytest.mark.grad
STEPS, ROTORS, BATCH = 3, 5, 2


def case(seed=3):
    """Commands and feedback that keep every thrust inside its bounds."""
    rng = np.random.default_rng(seed)
    return {
        "commands": tensor(rng.uniform(2.5, 4.0, (BATCH, STEPS, ROTORS))),
        "gain": tensor(0.1 * rng.standard_normal((ROTORS, 12))),
        "reference": tensor(0.3 * rng.standard_normal((STEPS, 12))),
    }


def outputs(flight):
    s = flight.state
    parts = [s.position, s.quaternion, s.velocity, s.body_rates, s.thrusts, s.charge[..., None]]
    return torch.cat(parts, dim=-1)[:, 1:]


def run(vehicle=None, start=None, effects=None, closed=True, substeps=2, clamp=True, **changes):
    values = case() | changes
    loop = Feedback(gain=values["gain"], reference=values["reference"]) if closed else None
    flight = fly(
        crooked_copter(ROTORS) if vehicle is None else vehicle,
        tumbling(BATCH, ROTORS) if start is None else start,
        values["commands"],
        dt=0.03,
        feedback=loop,
        effects=all_effects(ROTORS, STEPS) if effects is None else effects,
        substeps=substeps,
        clamp=clamp,
    )
    return outputs(flight)


def check(function, value):
    """The gradient is neither zero nor wrong."""
    leaf = value.detach().clone().requires_grad_()
    out = function(leaf)
    weights = torch.linspace(1, 2, out.numel(), dtype=out.dtype).view_as(out)
    (grad,) = torch.autograd.grad(out, leaf, weights)
    assert grad.abs().max() > 1e-9
    check_directions(function, [leaf], seeds=(0, 1), atol=1e-7, rtol=1e-6, check_forward_ad=True)


def test_case_is_inside_the_bounds():
    thrusts = run()[..., 13 : 13 + ROTORS]
    assert thrusts.min() > 0.1
    assert bool((thrusts < crooked_copter(ROTORS).max_thrusts - 0.1).all())


def test_the_largest_thrusts_are_felt_where_commands_are_above_them():
    vehicle = crooked_copter(ROTORS)
    low = vehicle.max_thrusts - 4.0
    check(lambda v: run(vehicle=vehicle.replace(max_thrusts=v)), low)


def test_spins_share_the_gradient_of_the_torque_ratios():
    """Only their product enters; spins other than +-1 are relaxations that a vehicle refuses."""
    vehicle = crooked_copter(ROTORS)
    spins, ratios = (t.clone().requires_grad_() for t in (vehicle.spins, vehicle.torque_ratios))
    flown = run(vehicle=vehicle.replace(spins=spins, torque_ratios=ratios))
    of_spins, of_ratios = torch.autograd.grad(flown.sum(), [spins, ratios])
    assert of_spins.abs().min() > 1e-6
    torch.testing.assert_close(of_spins * spins, of_ratios * ratios)


def test_inertia_and_directions():
    """Perturbed within what a vehicle accepts: symmetric, of length one."""
    vehicle = crooked_copter(ROTORS)

    def of_inertia(value):
        return run(vehicle=vehicle.replace(inertia=0.5 * (value + value.T)))

    def of_directions(value):
        unit = torch.nn.functional.normalize(value, dim=-1)
        return run(vehicle=vehicle.replace(directions=unit))

    check(of_inertia, vehicle.inertia)
    check(of_directions, vehicle.directions)


@pytest.mark.parametrize("shape", [(3,), (STEPS, 3), (BATCH, STEPS, 3)])
def test_wind(shape):
    effects = all_effects(ROTORS, STEPS)
    wind = tensor(np.random.default_rng(5).normal(0, 2, shape))
    check(lambda v: run(effects=replace(effects, wind=v)), wind)


@pytest.mark.parametrize("effect", [name for name, _ in all_effects().present()])
def test_one_effect_alone(effect):
    """Open loop, and no effect leans on another one."""
    effects = FlightEffects(**{effect: getattr(all_effects(ROTORS, STEPS), effect)})
    check(lambda v: run(effects=effects, closed=False, commands=v), case()["commands"])


def test_batch_of_vehicles_has_its_own_gradients():
    """More vehicles than lanes, and a last register that is not full."""
    batch = 11
    base = crooked_copter(ROTORS)
    rng = np.random.default_rng(7)
    masses = tensor(rng.uniform(1.0, 2.0, batch)).requires_grad_()
    commands = tensor(rng.uniform(2.5, 4.0, (1, STEPS, ROTORS))).requires_grad_()
    start = tumbling(batch, ROTORS)
    weights = tensor(rng.standard_normal((batch, STEPS, 19)))

    def loss(which):
        fleet = [base.replace(mass=masses[i]) for i in which]
        values = {f.name: getattr(start, f.name)[which] for f in fields(start)}
        flown = run(vehicle=fleet, start=FlightState(**values), commands=commands)
        return (flown * weights[which]).sum()

    together = torch.autograd.grad(loss(list(range(batch))), [masses, commands])
    alone = [torch.autograd.grad(loss([i]), [masses, commands]) for i in range(batch)]
    # sums of shared gradients in another order: rounding only
    torch.testing.assert_close(together[0], sum(a[0] for a in alone), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(together[1], sum(a[1] for a in alone), rtol=1e-11, atol=1e-11)


def test_batched_effects_have_their_own_gradients():
    """Leading batch axes of an effect, apart from those of the vehicles."""
    effects = all_effects(ROTORS, STEPS)
    rng = np.random.default_rng(11)
    factor = tensor(rng.uniform(0.8, 1.2, (BATCH, 1)))
    lag = effects.motor_lag.time_constants * factor

    def flown(value):
        return run(effects=replace(effects, motor_lag=MotorLag(time_constants=value)))

    check(flown, lag)
    for i in range(BATCH):
        torch.testing.assert_close(flown(lag)[i], flown(lag[i])[i], rtol=0, atol=1e-13)


def test_clamp_is_one_sided():
    """Outside a bound the command has no gradient; on it, that of the inside."""
    vehicle = crooked_copter(ROTORS)
    commands = case()["commands"][:1].clone()
    commands[0, 0, 0] = -1.0
    commands[0, 1, 1] = 100.0
    commands[0, 2, 2] = 0.0
    commands[0, 2, 3] = vehicle.max_thrusts[3]
    commands.requires_grad_()
    flown = run(vehicle=vehicle, commands=commands, effects=FlightEffects(), closed=False)
    (grad,) = torch.autograd.grad(flown.sum(), commands)
    assert grad[0, 0, 0] == 0.0
    assert grad[0, 1, 1] == 0.0
    assert grad[0, 2, 2] != 0.0
    assert grad[0, 2, 3] != 0.0


def beyond():
    """Commands below zero and above the largest thrust."""
    commands = case()["commands"].clone()
    commands[0, 0, 0], commands[0, 1, 1], commands[1, 0, 2] = -1.0, 30.0, 0.0
    return commands


def test_commands_without_a_clamp_have_gradients_everywhere():
    effects = replace(all_effects(ROTORS, STEPS), thrust_curve=None, battery=None)

    def flown(commands):
        return run(effects=effects, commands=commands, clamp=False)

    check(flown, beyond())
    leaf = crooked_copter(ROTORS).max_thrusts.requires_grad_()
    vehicle = crooked_copter(ROTORS).replace(max_thrusts=leaf)
    moved = run(vehicle=vehicle, effects=effects, commands=beyond(), clamp=False)
    (limits,) = torch.autograd.grad(moved.sum(), leaf)
    assert bool((limits == 0.0).all())


@pytest.mark.parametrize("closed", [True, False])
def test_the_end_alone_has_the_derivatives_of_the_path(closed):
    """Bit for bit in both modes; nine vehicles fill a register and begin another."""
    generator = torch.Generator().manual_seed(4)
    start = tumbling(9, ROTORS)
    leaves = [case()["commands"][:1], case()["gain"], crooked_copter(ROTORS).mass]
    directions = [torch.randn(v.shape, generator=generator, dtype=torch.float64) for v in leaves]

    def end(keep, commands, gain, mass):
        loop = Feedback(gain=gain, reference=case()["reference"]) if closed else None
        vehicle = crooked_copter(ROTORS).replace(mass=mass)
        effects = all_effects(ROTORS, STEPS)
        rest = {"dt": 0.03, "effects": effects, "substeps": 2, "keep": keep}
        state = fly(vehicle, start, commands, feedback=loop, **rest).state
        parts = [state.position, state.quaternion, state.velocity, state.thrusts]
        return torch.cat(parts, dim=-1)[:, -1]

    both = {}
    for keep in ("path", "end"):
        moving = [v.clone().requires_grad_() for v in leaves]
        out = end(keep, *moving)
        used = moving if closed else [moving[0], moving[2]]
        weights = torch.linspace(1, 2, out.numel(), dtype=out.dtype).view_as(out)
        grads = torch.autograd.grad(out, used, weights)
        call = partial(end, keep)
        _, rate = torch.func.jvp(call, tuple(leaves), tuple(directions))
        mapped = torch.func.vmap(call, in_dims=(None, None, 0))(
            leaves[0], leaves[1], leaves[2] * torch.tensor([1.0, 1.1], dtype=torch.float64)
        )
        both[keep] = [out.detach(), *grads, rate, mapped]
    for path, alone in zip(*both.values(), strict=True):
        assert torch.equal(path, alone) and bool((path != 0.0).any())


def test_op_contract():
    n = ROTORS
    width = sum(size for _, size in _ops_flight.fields(n))
    rng = np.random.default_rng(9)
    start = torch.zeros(1, 1, 14 + n, dtype=torch.float64)
    start[..., 3] = 1.0
    tensors = [
        start.requires_grad_(),
        tensor(rng.uniform(1, 2, (2, 3, n))).requires_grad_(),
        tensor(0.1 * rng.standard_normal((1, 1, 12 * n))).requires_grad_(),
        tensor(rng.standard_normal((1, 3, 12))).requires_grad_(),
        torch.zeros(1, 1, 3, dtype=torch.float64),
        tensor(rng.uniform(0.5, 1.0, (1, 1, width))).requires_grad_(),
    ]
    args = (*tensors, 2, 3, False, 0.01, 9.81, 1, "body_drag", 1)
    end_alone = (*tensors, 2, 3, True, 0.01, 9.81, 1, "body_drag", 1)
    checks = with_derivatives(_ops_flight.flight, *args)
    for op, given in (*checks, (_ops_flight.flight.op, end_alone)):
        torch.library.opcheck(op, given)
    layer = torch.compile(_ops_flight.flight.op, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(layer(*args), _ops_flight.flight(*args))


@pytest.mark.story  # compiles
def test_whole_flight_compiles():
    commands = case()["commands"].requires_grad_()
    vehicle, effects, start = crooked_copter(ROTORS), all_effects(ROTORS, STEPS), tumbling(BATCH)
    loop = Feedback(gain=case()["gain"], reference=case()["reference"])

    def flown(commands):
        return fly(vehicle, start, commands, dt=0.03, feedback=loop, effects=effects).state.position

    whole = torch.compile(flown, fullgraph=True, backend="aot_eager")
    plain, compiled = flown(commands), whole(commands)
    torch.testing.assert_close(compiled, plain)
    (grad,), (expected,) = (torch.autograd.grad(f.sum(), commands) for f in (compiled, plain))
    torch.testing.assert_close(grad, expected)
