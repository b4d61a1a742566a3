"""Sensors: what they read without noise and how it spreads; the PID baseline flies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.copter import GRAVITY
from diffsim.copter.dynamics.flight import fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.dynamics.pid import PidController, PidGains, fly_pid
from diffsim.copter.dynamics.sensors import SensorNoise, finite_acceleration, read_sensors
from diffsim.copter.vehicle.effects import BodyDrag, FlightEffects, MotorLag
from tests.copter.flight_cases import tensor
from tests.copter.vehicle.test_vehicle import plus_quadcopter

SILENT = SensorNoise(
    gyro=0.0, gyro_bias=0.0, accelerometer=0.0, accelerometer_bias=0.0, position=0.0
)


TARGET = tensor([1.0, -2.0, -3.0])


def resting(batch, time):
    return FlightState.at_rest(
        torch.zeros(batch, time, 3).double(), tensor([0.0, 0.3, 0.0]).expand(batch, time, 3)
    )


def test_accelerometer_reads_thrust_over_mass():
    """Whatever the attitude: gravity is not felt."""
    start = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0.4, -0.3, 1.0]]))
    commands = tensor([3.0] * 4).expand(1, 5, 4)
    flight = fly(plus_quadcopter(), start, commands, dt=0.01)
    acceleration = finite_acceleration(flight.state.velocity, 0.01)
    readings = read_sensors(flight.state, acceleration, seed=0, noise=SILENT)
    expected = tensor([0.0, 0.0, -12.0 / 1.2]).expand(1, 6, 3)
    torch.testing.assert_close(readings.accelerometer, expected)
    torch.testing.assert_close(readings.position, flight.state.position)


def test_noise_has_the_stated_spread():
    state = resting(200, 100)
    noise = SensorNoise(gyro=0.01, gyro_bias=0.05, position=0.3)
    gyro = read_sensors(state, torch.zeros(200, 100, 3).double(), seed=1, noise=noise).gyro
    assert float((gyro - gyro.mean(1, keepdim=True)).std()) == pytest.approx(0.01, rel=0.03)
    assert float(gyro.mean(1).std()) == pytest.approx(0.05, rel=0.1)  # 600 biases
    position = read_sensors(state, torch.zeros(200, 100, 3).double(), seed=1, noise=noise).position
    assert float(position.std()) == pytest.approx(0.3, rel=0.02)


def test_seed_decides():
    state, still = resting(2, 3), torch.zeros(2, 3, 3).double()
    one, same, other = (read_sensors(state, still, seed=s).gyro for s in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    accelerometer = read_sensors(state, still, seed=0, noise=SILENT).accelerometer
    expected = GRAVITY * tensor([np.sin(0.3), 0.0, -np.cos(0.3)])
    torch.testing.assert_close(accelerometer[0, 0], expected)


def arrival(effects=None, vehicle=None, yaw=None, gains=None):
    """From four starts to (1, -2, -3) within 6 s; the last state."""
    rng = np.random.default_rng(0)
    start = FlightState.at_rest(
        tensor(rng.uniform(-1, 1, (4, 3))), tensor(rng.uniform(-0.3, 0.3, (4, 3)))
    )
    believed = plus_quadcopter()
    targets = TARGET.expand(1, 600, 3)
    return fly_pid(
        believed if vehicle is None else vehicle,
        start,
        targets,
        controller=PidController(believed, gains),
        dt=0.01,
        yaw=yaw,
        effects=effects,
    )


def test_pid_arrives_and_stays():
    flight = arrival(yaw=torch.full((1, 600), 0.7, dtype=torch.float64))
    assert flight.state.position.shape == (4, 601, 3)
    last = flight.state.position[:, -1] - TARGET
    assert float(last.norm(dim=-1).max()) < 0.02
    assert float(flight.state.velocity[:, -1].norm(dim=-1).max()) < 0.02
    assert float((flight.state.rpy[:, -1, 2] - 0.7).abs().max()) < 1e-3


def test_integral_holds_against_wind_lag_and_a_heavier_vehicle():
    drag = BodyDrag(linear=tensor([0.3] * 3), quadratic=tensor([0.0] * 3))
    effects = FlightEffects(
        motor_lag=MotorLag(time_constants=tensor([0.03] * 4)),
        body_drag=drag,
        wind=tensor([2.0, 1.0, 0.0]),
    )
    heavier = plus_quadcopter().replace(mass=tensor(1.35))
    off = [
        (arrival(effects, heavier, gains=gains).state.position[:, -1] - TARGET).norm(dim=-1)
        for gains in (PidGains(), PidGains(integral=0.0))
    ]
    assert float(off[0].max()) < 0.15
    # without: the missing lift, (0.15 / 1.2) g, against position times velocity gain
    assert float(off[1].min()) > 0.15 / 1.2 * GRAVITY / (1.5 * 3.0)


@pytest.mark.grad
def test_pid_flight_is_differentiable():
    vehicle = plus_quadcopter()
    start = FlightState.at_rest(tensor([[0.1, 0.2, 0.0]]), tensor([[0.05, -0.1, 0.2]]))

    def end(mass, target):
        flown = fly_pid(
            vehicle.replace(mass=mass),
            start,
            target.expand(1, 3, 3),
            controller=PidController(vehicle),
            dt=0.02,
        )
        return flown.state.position[:, -1]

    inputs = (tensor(1.2).requires_grad_(), tensor([0.3, -0.2, -0.5]).requires_grad_())
    assert torch.autograd.gradcheck(end, inputs, atol=1e-8)


def test_bad_input():
    vehicle = plus_quadcopter()
    flat = vehicle.replace(spins=tensor([1.0] * 4))
    line = tensor([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [-0.2, 0, 0]])
    with pytest.raises(ValueError, match="lift, roll, pitch and yaw apart"):
        PidController(flat.replace(positions=line))
    with pytest.raises(ValueError, match="max_tilt"):
        PidGains(max_tilt=2.0)
    with pytest.raises(ValueError, match="wind must be steady"):
        drag = BodyDrag(linear=tensor([0.1] * 3), quadratic=tensor([0.0] * 3))
        effects = FlightEffects(body_drag=drag, wind=torch.zeros(5, 3).double())
        fly_pid(
            vehicle,
            FlightState.at_rest(torch.zeros(1, 3).double()),
            torch.zeros(1, 5, 3).double(),
            controller=PidController(vehicle),
            dt=0.01,
            effects=effects,
        )
    with pytest.raises(ValueError, match="gyro must lie in"):
        replace(SILENT, gyro=-1.0)
