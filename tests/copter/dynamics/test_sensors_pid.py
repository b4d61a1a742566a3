"""Sensors: what they read without noise and how it spreads; the PID baseline flies."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.copter import GRAVITY
from diffsim.copter.dynamics.flight import fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.dynamics.pid import PidController, PidGains
from diffsim.copter.simulator.sensing import FlightSensors, SensorNoise, SensorStream
from diffsim.copter.vehicle.effects import BodyDrag, FlightEffects, MotorLag
from tests.copter.flight_cases import tensor
from tests.copter.vehicle.test_vehicle import plus_quadcopter

SILENT = SensorNoise(
    gyro=0.0, gyro_bias=0.0, accelerometer=0.0, accelerometer_bias=0.0, position=0.0
)
LEANING = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0.0, 0.3, 0.0]]))
TARGET = tensor([1.0, -2.0, -3.0])


def stream(noise, seed=0):
    return SensorStream(FlightSensors(noise=noise), seed)


def test_accelerometer_reads_thrust_over_mass():
    """Whatever the attitude: gravity is not felt."""
    start = FlightState.at_rest(torch.zeros(1, 3).double(), tensor([[0.4, -0.3, 1.0]]))
    flight = fly(plus_quadcopter(), start, tensor([3.0] * 4).expand(1, 1, 4), dt=0.01)
    acceleration = flight.state.velocity[0].diff(dim=0)[0].numpy() / 0.01
    seen = stream(SILENT).read(start, acceleration)
    np.testing.assert_allclose(seen.accelerometer, [0.0, 0.0, -12.0 / 1.2], atol=1e-12)
    np.testing.assert_array_equal(seen.position, start.position[0].numpy())
    still = stream(SILENT).read(LEANING, np.zeros(3)).accelerometer
    np.testing.assert_allclose(still, GRAVITY * np.array([np.sin(0.3), 0.0, -np.cos(0.3)]))


def test_noise_has_the_stated_spread():
    noise = SensorNoise(gyro=0.01, gyro_bias=0.05, position=0.3)

    def readings(seed):
        one = stream(noise, seed)
        return [one.read(LEANING, np.zeros(3)) for _ in range(20)]

    series = [readings(seed) for seed in range(200)]
    gyro = np.array([[r.gyro for r in one] for one in series])
    assert (gyro - gyro.mean(1, keepdims=True)).std() == pytest.approx(0.01, rel=0.05)
    assert gyro.mean(1).std() == pytest.approx(0.05, rel=0.1)  # 600 biases
    position = np.array([[r.position for r in one] for one in series])
    assert position.std() == pytest.approx(0.3, rel=0.02)


def flown(vehicle, state, target, controller, *, steps, dt=0.01, yaw=0.0, effects=None):
    """The last state under the controller, one period after the other."""
    batch = len(state.position)
    integral, yaw = torch.zeros(batch, 3).double(), torch.full((batch,), yaw).double()
    for _ in range(steps):
        thrusts, integral = controller.thrusts(state, target.expand(batch, 3), yaw, integral, dt)
        after = fly(vehicle, state, thrusts[:, None], dt=dt, effects=effects).state
        names = ("position", "quaternion", "velocity", "body_rates", "thrusts")
        state = FlightState(*(getattr(after, name)[:, 1] for name in names))
    return state


def arrival(effects=None, vehicle=None, yaw=0.0, gains=None):
    """From four starts to (1, -2, -3) within 6 s; the last state."""
    rng = np.random.default_rng(0)
    start = FlightState.at_rest(
        tensor(rng.uniform(-1, 1, (4, 3))), tensor(rng.uniform(-0.3, 0.3, (4, 3)))
    )
    believed = plus_quadcopter()
    flies, controller = vehicle or believed, PidController(believed, gains)
    return flown(flies, start, TARGET, controller, steps=600, yaw=yaw, effects=effects)


def test_pid_arrives_and_stays():
    last = arrival(yaw=0.7)
    assert float((last.position - TARGET).norm(dim=-1).max()) < 0.02
    assert float(last.velocity.norm(dim=-1).max()) < 0.02
    assert float((last.rpy[:, 2] - 0.7).abs().max()) < 1e-3


def test_integral_holds_against_wind_lag_and_a_heavier_vehicle():
    drag = BodyDrag(linear=tensor([0.3] * 3), quadratic=tensor([0.0] * 3))
    effects = FlightEffects(
        motor_lag=MotorLag(time_constants=tensor([0.03] * 4)),
        body_drag=drag,
        wind=tensor([2.0, 1.0, 0.0]),
    )
    heavier = plus_quadcopter().replace(mass=tensor(1.35))
    off = [
        (arrival(effects, heavier, gains=gains).position - TARGET).norm(dim=-1)
        for gains in (PidGains(), PidGains(integral=0.0))
    ]
    assert float(off[0].max()) < 0.15
    # without: the missing lift, (0.15 / 1.2) g, against position times velocity gain
    assert float(off[1].min()) > 0.15 / 1.2 * GRAVITY / (1.5 * 3.0)


def thrusts_by_hand(gains, vehicle, state, target, yaw, integral, dt):
    """The cascade of one vehicle in numpy; angles by the skew part of scipy's matrices."""

    def short(vector, bound):
        return vector * min(1.0, bound / np.linalg.norm(vector))

    at, speed, rates = (v[0].numpy() for v in (state.position, state.velocity, state.body_rates))
    mass, inertia = float(vehicle.mass), vehicle.inertia.numpy()
    wanted = short(gains.position * (target - at), gains.max_speed)
    integral = integral + dt * gains.integral * short(wanted - speed, gains.max_slip)
    integral = np.clip(integral, -gains.max_integral, gains.max_integral)
    force = gains.velocity * (wanted - speed) + integral - [0.0, 0.0, GRAVITY]
    lift = max(-force[2], 0.2 * GRAVITY)
    force = np.array([*short(force[:2], lift * np.tan(gains.max_tilt)), -lift])
    z = -force / np.linalg.norm(force)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
    y /= np.linalg.norm(y)
    is_now = Rotation.from_quat(np.roll(state.quaternion[0].numpy(), -1)).as_matrix()
    off = np.stack([np.cross(y, z), y, z], 1).T @ is_now
    angle = 0.5 * np.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]])
    spin = gains.rate * (-gains.attitude * angle - rates)
    torque = inertia @ spin + np.cross(rates, inertia @ rates)
    arms = np.cross(vehicle.positions, vehicle.directions)
    arms += (vehicle.spins * vehicle.torque_ratios)[:, None].numpy() * vehicle.directions.numpy()
    effects = np.vstack([vehicle.directions[:, 2], arms.T])
    asked = np.linalg.pinv(effects) @ [mass * force @ is_now[:, 2], *torque]
    return np.clip(asked, 0.0, vehicle.max_thrusts), integral


@pytest.mark.reference
@pytest.mark.parametrize("far", [0.02, 0.3, 3.0])
def test_pid_is_its_formula(far):
    """Near by without a limit, far off with all of them."""
    random, vehicle = np.random.default_rng(2), plus_quadcopter()
    gains = PidGains(**{k: v * random.uniform(0.5, 1.0) for k, v in vars(PidGains()).items()})
    for _ in range(20):
        state = FlightState.at_rest(
            tensor(random.normal(size=(1, 3))), tensor(random.normal(scale=0.3, size=(1, 3)))
        )
        speed, rates = far * random.normal(size=(2, 1, 3))
        state = replace(state, velocity=tensor(speed), body_rates=tensor(0.1 * rates))
        target = state.position[0].numpy() + far * random.normal(size=3)
        integral = random.uniform(-gains.max_integral, gains.max_integral, 3)
        yaw = random.uniform(-3.0, 3.0)
        found = PidController(vehicle, gains).thrusts(
            state, tensor(target)[None], tensor([yaw]), tensor(integral)[None], 0.02
        )
        expected = thrusts_by_hand(gains, vehicle, state, target, yaw, integral, 0.02)
        for part, known in zip(found, expected, strict=True):
            np.testing.assert_allclose(part[0].numpy(), known, rtol=1e-9, atol=1e-9)


@pytest.mark.grad
def test_pid_flight_is_differentiable():
    vehicle = plus_quadcopter()
    start = FlightState.at_rest(tensor([[0.1, 0.2, 0.0]]), tensor([[0.05, -0.1, 0.2]]))

    def end(mass, target):
        flies, controller = vehicle.replace(mass=mass), PidController(vehicle)
        return flown(flies, start, target, controller, steps=3, dt=0.02).position

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
    with pytest.raises(ValueError, match="gyro must lie in"):
        replace(SILENT, gyro=-1.0)
