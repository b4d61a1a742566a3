"""A tilted hexacopter that is nowhere symmetric, with every effect on."""

import numpy as np
import torch

from diffsim.copter import Multicopter
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.effects import (
    BatterySag,
    BodyDrag,
    FlightEffects,
    GroundEffect,
    Interference,
    MotorLag,
    RotorDrag,
    ThrustCurve,
)


def tensor(value):
    return torch.as_tensor(value, dtype=torch.float64)


def crooked_copter(num_rotors=5, seed=0):
    """Unequal arms, tilts, spins and propellers."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, num_rotors, endpoint=False) + rng.uniform(0, 0.4, num_rotors)
    positions = np.stack([0.3 * np.cos(angle), 0.25 * np.sin(angle), 0.05 * np.sin(3 * angle)], -1)
    directions = np.array([0.0, 0.0, -1.0]) + 0.2 * rng.standard_normal((num_rotors, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    root = 0.1 * np.eye(3) + 0.02 * rng.standard_normal((3, 3))
    return Multicopter(
        mass=tensor(1.4),
        inertia=tensor(2.0 * root @ root.T),
        positions=tensor(positions),
        directions=tensor(directions),
        spins=tensor([(-1.0) ** i for i in range(num_rotors)]),
        torque_ratios=tensor(rng.uniform(0.01, 0.02, num_rotors)),
        max_thrusts=tensor(rng.uniform(6.0, 8.0, num_rotors)),
        radii=tensor(rng.uniform(0.12, 0.18, num_rotors)),
    )


def all_effects(num_rotors=5, steps=4, seed=1):
    """Every effect, strong enough to matter within a few steps."""
    rng = np.random.default_rng(seed)

    def around(value):
        return tensor(value * rng.uniform(0.8, 1.2, num_rotors))

    return FlightEffects(
        motor_lag=MotorLag(time_constants=around(0.04)),
        thrust_curve=ThrustCurve(exponents=around(1.1), reference_thrusts=around(4.0)),
        rotor_drag=RotorDrag(coefficient=tensor(0.05)),
        body_drag=BodyDrag(linear=tensor([0.1, 0.2, 0.3]), quadratic=tensor([0.2, 0.1, 0.15])),
        wind=tensor(rng.normal(0, 2.0, (steps, 3))),
        ground_effect=GroundEffect(coefficient=tensor(1.2), terrain_height=tensor(-0.3)),
        interference=Interference(losses=tensor(rng.uniform(0.0, 0.1, (num_rotors, num_rotors)))),
        battery=BatterySag(
            resistance=tensor(0.05),
            capacity=tensor(40.0),
            nominal_voltage=tensor(11.1),
            exponent=tensor(1.8),
            open_circuit=tensor([9.0, 3.0, -1.5, 2.0]),
            current_coefficients=around(0.6),
            current_exponents=around(1.3),
            idle_current=tensor(0.7),
        ),
    )


def tumbling(batch=2, num_rotors=5, seed=2):
    """States well away from level, rest and gimbal lock."""
    rng = np.random.default_rng(seed)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) + 0.2 * rng.standard_normal((batch, 4))
    return FlightState(
        position=tensor(rng.normal(0, 0.1, (batch, 3))),
        quaternion=tensor(quaternion),
        velocity=tensor(rng.normal(0, 1.0, (batch, 3))),
        body_rates=tensor(rng.normal(0, 1.0, (batch, 3))),
        thrusts=tensor(rng.uniform(2.0, 4.0, (batch, num_rotors))),
        charge=tensor(rng.uniform(0.6, 0.9, batch)),
    )
