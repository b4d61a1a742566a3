"""Flights whose vehicle and effects are packed once: the same numbers as ``fly``."""

from dataclasses import replace

import pytest
import torch

from diffsim.copter import FlightEffects, FlightState, fly, prepare_flight
from tests.copter.flight_cases import all_effects, crooked_copter

DT = 0.02


def start(batch: int) -> FlightState:
    generator = torch.Generator().manual_seed(0)
    rows = 0.1 * torch.randn(batch, 9, generator=generator, dtype=torch.float64)
    return FlightState.at_rest(rows[:, :3], rows[:, 3:6])


def test_steps_are_the_flight():
    """The wind of a step is given to it; a start's quaternion is normalized once more."""
    vehicle, effects = crooked_copter(), all_effects(steps=4)
    commands = torch.linspace(2.0, 4.0, 2 * 4 * 5, dtype=torch.float64).reshape(2, 4, 5)
    whole = fly(vehicle, start(2), commands, dt=DT, effects=effects, substeps=2).state
    gusts = effects.wind
    prepared = prepare_flight(vehicle, dt=DT, effects=effects, substeps=2)
    state = start(2)
    for k in range(4):
        state = prepared.step(state, commands[:, k], wind=gusts[k])
        for name, value in vars(state).items():
            expected = getattr(whole, name)[:, k + 1]
            torch.testing.assert_close(value, expected, rtol=1e-14, atol=1e-15)


def test_gradients_reach_vehicle_effects_and_wind():
    vehicle = crooked_copter()
    mass, wind = vehicle.mass.clone().requires_grad_(), torch.ones(2, 3, dtype=torch.float64)
    wind.requires_grad_()
    effects = replace(all_effects(), wind=None)
    thrusts = torch.full((2, 5), 3.0, dtype=torch.float64)
    prepared = prepare_flight(vehicle.replace(mass=mass), dt=DT, effects=effects)
    prepared.step(start(2), thrusts, wind=wind).velocity.square().sum().backward()
    flown = fly(
        vehicle.replace(mass=(again := vehicle.mass.clone().requires_grad_())),
        start(2),
        thrusts[:, None],
        dt=DT,
        effects=replace(effects, wind=(gust := wind.detach().clone().requires_grad_())[:, None]),
    )
    flown.state.velocity[:, -1].square().sum().backward()
    assert float(mass.grad) != 0.0 and bool((wind.grad != 0.0).any())
    assert torch.equal(mass.grad, again.grad)
    assert torch.equal(wind.grad, gust.grad)


def test_refusals():
    vehicle = crooked_copter()
    thrusts = torch.full((1, 5), 3.0, dtype=torch.float64)
    still = prepare_flight(vehicle, dt=DT, effects=FlightEffects())
    with pytest.raises(ValueError, match="wind acts through drag"):
        still.step(start(1), thrusts, wind=torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"thrusts must have shape \(batch, 5\), got \(1, 4\)"):
        still.step(start(1), thrusts[:, :4])
    with pytest.raises(ValueError, match="substeps must be a whole number"):
        prepare_flight(vehicle, dt=DT, substeps=0)
