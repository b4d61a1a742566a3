"""Random multicopters for the tests of hover, linearization and control."""

import numpy as np
import torch

from diffsim.copter import Multicopter


def random_copter(seed: int, *, n: int = 6, tilt: float = 0.3, max_thrust: float = 9.0):
    """Arms of about 0.25 m around the circle, axes tilted by up to about ``tilt`` [rad], 2 kg."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * (np.arange(n) + 0.2 * rng.uniform(-1, 1, n)) / n
    arm = rng.uniform(0.2, 0.3, n)
    height = rng.uniform(-0.05, 0.05, n)
    positions = np.stack([arm * np.cos(angle), arm * np.sin(angle), height], 1)
    directions = np.concatenate([tilt * rng.uniform(-0.7, 0.7, (n, 2)), -np.ones((n, 1))], 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    factor = rng.uniform(-0.1, 0.1, (3, 3))
    inertia = np.diag([0.02, 0.025, 0.04]) + 0.02 * factor @ factor.T
    values = {
        "mass": 2.0,
        "inertia": inertia,
        "positions": positions,
        "directions": directions,
        "spins": np.where(np.arange(n) % 2 == 0, 1.0, -1.0),
        "torque_ratios": rng.uniform(0.01, 0.03, n),
        "max_thrusts": max_thrust * rng.uniform(0.9, 1.1, n),
        "radii": np.full(n, 0.1),
    }
    return Multicopter(**{k: torch.as_tensor(v, dtype=torch.float64) for k, v in values.items()})
