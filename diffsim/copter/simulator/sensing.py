"""Sensors of one flying vehicle, reading by reading, and the state estimate made of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.core.checked import checked

# A bias may change by that share of itself from reading to reading: found within seconds. At 1e-3
# it takes ten of them, during which a hover stands 3 cm off (SensorNoise() at 100 Hz).
_DRIFT = 0.03
_FLOOR = 1e-6  # standard deviations count as at least this in the filter [SI]
_GRAVITY = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """White noise of every reading and constant biases of gyro and accelerometer."""

    gyro: float = 0.003  # standard deviation of a reading [rad/s]
    # standard deviation of the bias, drawn once per vehicle and axis [rad/s]
    gyro_bias: float = 0.005
    accelerometer: float = 0.05  # noise of the accelerometer, sd [m/s^2]
    accelerometer_bias: float = 0.05  # bias of the accelerometer, sd [m/s^2]
    position: float = 0.02  # noise of the position, sd [m]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_number(name, value, at_least=0.0)


@checked
@dataclass(frozen=True, kw_only=True)
class FlightSensors:
    """Gyro, accelerometer and motion capture (thesis 3.6 flies with one).

    Attributes:
        noise: Noise of gyro, accelerometer and position.
        attitude: Standard deviation of the captured attitude, per axis [rad].
    """

    noise: SensorNoise = field(default_factory=SensorNoise)
    attitude: float = 0.005

    def __post_init__(self) -> None:
        require_number("attitude", self.attitude, at_least=0.0)


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings at one time: gyro [rad/s], accelerometer [m/s^2] (body frame), position [m]."""

    gyro: Array
    accelerometer: Array
    position: Array
    attitude: Rotation


class SensorStream:
    """Noisy readings one after the other; equal for equal seeds.

    Args:
        sensors: Noise of the sensors; biases are drawn once, here.
    """

    def __init__(self, sensors: FlightSensors, seed: int):
        self._sensors = sensors
        self._rng = np.random.default_rng(seed)
        noise = sensors.noise
        self._gyro_bias = noise.gyro_bias * self._rng.standard_normal(3)
        self._accelerometer_bias = noise.accelerometer_bias * self._rng.standard_normal(3)

    def read(self, state: FlightState, acceleration: Array) -> Readings:
        """Readings of a state, leading axis (1,), with its world acceleration, (3,) [m/s^2]."""
        noise, white = self._sensors.noise, self._rng.standard_normal((4, 3))
        rotation = _rotation(state)
        specific = rotation.inv().apply(acceleration - _GRAVITY)
        return Readings(
            gyro=state.body_rates[0].numpy() + self._gyro_bias + noise.gyro * white[0],
            accelerometer=specific + self._accelerometer_bias + noise.accelerometer * white[1],
            position=state.position[0].numpy() + noise.position * white[2],
            attitude=rotation * Rotation.from_rotvec(self._sensors.attitude * white[3]),
        )


class StateEstimator:
    """Steady-state Kalman filters of position, velocity and attitude with the sensors' biases.

    Position: inertial navigation with the accelerometer, corrected by the captured position.
    Attitude: the gyro, corrected by the captured attitude. The accelerometer's bias is taken to be
    constant in the world frame, which it is while the heading is.

    Args:
        sensors: Whose noise to expect.
        dt: Between readings [s].
        start: First state, leading axis (1,).
    """

    def __init__(self, sensors: FlightSensors, dt: float, start: FlightState):
        noise = sensors.noise
        self._dt = dt
        self._place = np.stack([start.position[0].numpy(), start.velocity[0].numpy(), np.zeros(3)])
        self._attitude, self._gyro_bias = _rotation(start), np.zeros(3)
        self._move = np.array([[1.0, dt, -0.5 * dt * dt], [0.0, 1.0, -dt], [0.0, 0.0, 1.0]])
        push = np.array([0.5 * dt * dt, dt, 0.0])
        drift = _spread(_DRIFT * noise.accelerometer_bias) ** 2 * np.diag([0.0, 0.0, 1.0])
        shake = _spread(noise.accelerometer) ** 2 * np.outer(push, push)
        self._push = push
        self._place_gain = _kalman_gain(self._move, shake + drift, _spread(noise.position))
        spin = np.array([[1.0, -dt], [0.0, 1.0]])
        jitter = [(dt * _spread(noise.gyro)) ** 2, _spread(_DRIFT * noise.gyro_bias) ** 2]
        self._attitude_gain = _kalman_gain(spin, np.diag(jitter), _spread(sensors.attitude))

    def update(self, readings: Readings) -> FlightState:
        """The state after one more set of readings, leading axis (1,)."""
        self._attitude = self._attitude * Rotation.from_rotvec(
            self._dt * (readings.gyro - self._gyro_bias)
        )
        off = (self._attitude.inv() * readings.attitude).as_rotvec()
        self._attitude = self._attitude * Rotation.from_rotvec(self._attitude_gain[0] * off)
        self._gyro_bias = self._gyro_bias + self._attitude_gain[1] * off

        acceleration = self._attitude.apply(readings.accelerometer) + _GRAVITY
        self._place = self._move @ self._place + np.outer(self._push, acceleration)
        self._place = self._place + np.outer(self._place_gain, readings.position - self._place[0])
        return FlightState(
            position=torch.from_numpy(self._place[:1].copy()),
            quaternion=torch.from_numpy(self._attitude.as_quat()[None, [3, 0, 1, 2]]),
            velocity=torch.from_numpy(self._place[1:2].copy()),
            body_rates=torch.from_numpy((readings.gyro - self._gyro_bias)[None]),
        )


def _rotation(state: FlightState) -> Rotation:
    return Rotation.from_quat(state.quaternion[0, [1, 2, 3, 0]].numpy())


def _spread(value: float) -> float:
    return max(value, _FLOOR)


def _kalman_gain(move: Array, process: Array, reading: float) -> Array:
    """Steady gain of x+ = move x + w with the first state read with a standard deviation."""
    row = np.eye(len(move))[:1]
    covariance = solve_discrete_are(move.T, row.T, process, np.array([[reading**2]]))
    return covariance[:, 0] / (covariance[0, 0] + reading**2)
