"""Vehicles with more rotors than forces and torques that they can make."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.data.study import Channel, Run, Study
from diffsim.systems.multicopter.cutting import idle_thrusts
from diffsim.systems.registry import setup_of
from tests.systems import small_copter

MASS, INERTIA, ARM, FULL, TORQUE_RATIO, LAG = 2.1, (0.021, 0.023, 0.04), 0.275, 7.2, 0.016, 0.045
ANGLES = np.deg2rad([30.0, 90.0, 150.0, 210.0, 270.0, 330.0])
PLACES = ARM * np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(6)], 1)
SPINS = ("ccw", "cw") * 3
CHANNELS = {"x": "m", "y": "m", "z": "m", "roll": "rad", "pitch": "rad", "yaw": "rad"}
RATES = {"p": "rad/s", "q": "rad/s", "r": "rad/s"}
SD = {"m": 6e-4, "rad": 2.6e-3, "rad/s": 7e-3}
MODEL = {
    "system": "multicopter",
    "frames": {"world": "NWU", "body": "FLU"},
    "mass": {"value": MASS, "percent": 1},
    "inertia": list(INERTIA),
    "rotors": [{"at": p.tolist(), "spin": s} for p, s in zip(PLACES, SPINS, strict=True)],
    "thrust": {"coefficient": {"value": FULL, "percent": 5}},
    "torque_ratio": TORQUE_RATIO,
    "motor_lag": {"value": LAG, "percent": 20},
    "commands": {"columns": [f"u{i}" for i in range(6)], "as": "throttle"},
    "sensors": {
        "position": ["x", "y", "z"],
        "roll_pitch_yaw": ["roll", "pitch", "yaw"],
        "body_rates": ["p", "q", "r"],
    },
}


def rates(state: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Newton and Euler in roll, pitch and yaw; place, angles, velocity, body rates, speeds."""
    (roll, pitch, yaw), velocity, spin = state[3:6], state[6:9], state[9:12]
    thrusts = FULL * state[12:] ** 2
    moments = np.array([thrusts @ PLACES[:, 1], -thrusts @ PLACES[:, 0], 0.0])
    moments[2] = -TORQUE_RATIO * thrusts @ np.tile([1.0, -1.0], 3)
    sr, cr, sp, cp, sy, cy = (f(a) for a in (roll, pitch, yaw) for f in (np.sin, np.cos))
    up = np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
    turning = np.array(
        [
            spin[0] + (spin[1] * sr + spin[2] * cr) * sp / cp,
            spin[1] * cr - spin[2] * sr,
            (spin[1] * sr + spin[2] * cr) / cp,
        ]
    )
    inertia = np.array(INERTIA)
    faster = (moments - np.cross(spin, inertia * spin)) / inertia
    pull = up * thrusts.sum() / MASS - [0.0, 0.0, small_copter.GRAVITY]
    return np.concatenate([velocity, turning, pull, faster, (speeds - state[12:]) / LAG])


def recorded() -> Run:
    """Two seconds of a flight without control whose torques have no mean, 100 samples a second."""
    time = np.arange(0.0, 2.0, 0.01)
    rng = np.random.default_rng(1)
    hover = np.sqrt(MASS * small_copter.GRAVITY / 6.0 / FULL)
    wave = np.sin(9.0 * time)[:, None] * np.cos(ANGLES) + np.sin(14.0 * time)[:, None] * np.sin(
        ANGLES
    )
    speeds = hover + 0.06 * wave
    before = hover + 0.1 * rng.standard_normal(6)
    state = np.concatenate([np.zeros(12), before])
    states = [state]
    for (start, end), held in zip(pairwise(time), speeds[:-1], strict=True):
        motion = solve_ivp(lambda _, y, u=held: rates(y, u), (start, end), states[-1], rtol=1e-8)
        states.append(motion.y[:, -1])
    seen = np.array(states)[:, [0, 1, 2, 3, 4, 5, 9, 10, 11]]
    units = [*CHANNELS.values(), *RATES.values()]
    seen = seen + rng.standard_normal(seen.shape) * [SD[u] for u in units]
    command = {f"u{i}": speeds[:, i] for i in range(6)}
    return Run("wave", time, seen, command, "wave")


def hexarotor() -> Study:
    channels = tuple(Channel(n, u, "reading") for n, u in (CHANNELS | RATES).items())
    return Study("hexarotor", "multicopter", channels, (recorded(),), model=MODEL)


def test_six_lagging_rotors_fly_in_windows_of_a_second():
    """Thrusts before the record that work against each other once cut it into 50 ms."""
    study = hexarotor()
    model = setup_of(study).model
    windows = model.scene(study.runs[0], model.at_prior()).windows
    assert windows.measured.shape[1] == 100


@pytest.mark.parametrize(("count", "idle"), [(4, 0), (6, 2)])
def test_idle_thrusts_leave_force_and_torque(count, idle):
    angles = 2.0 * np.pi * np.arange(count) / count
    places = 0.2 * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], 1)
    up = np.tile([0.0, 0.0, -1.0], (count, 1))
    vehicle = Fleet(
        mass=torch.ones(1, dtype=torch.float64),
        inertia=torch.eye(3, dtype=torch.float64)[None],
        positions=torch.from_numpy(places)[None],
        directions=torch.from_numpy(up)[None],
        spins=torch.tensor([[1.0, -1.0] * (count // 2)], dtype=torch.float64),
        torque_ratios=torch.full((1, count), 0.016, dtype=torch.float64),
        max_thrusts=torch.full((1, count), 9.0, dtype=torch.float64),
        radii=torch.full((1, count), 0.1, dtype=torch.float64),
    )
    found = idle_thrusts(vehicle)
    if not idle:
        assert found is None
        return
    assert float(found.trace()) == pytest.approx(idle)
    np.testing.assert_allclose(vehicle.directions[0].mT @ found, 0.0, atol=1e-12)
    np.testing.assert_allclose(vehicle.torque_matrix[0] @ found, 0.0, atol=1e-12)


def test_the_yaw_of_a_vehicle_in_the_palm_is_not_idle():
    """45 g on arms of 35 mm: a torque of 0.2 mm per newton turns it at 130 rad/s^2."""
    arm = 0.0353
    places = [[arm, arm, 0.0], [-arm, -arm, 0.0], [arm, -arm, 0.0], [-arm, arm, 0.0]]
    vehicle = Fleet(
        mass=torch.tensor([0.045], dtype=torch.float64),
        inertia=torch.diag(torch.tensor([2.4e-5, 2.4e-5, 3.2e-6], dtype=torch.float64))[None],
        positions=torch.tensor([places], dtype=torch.float64),
        directions=torch.tensor([[[0.0, 0.0, -1.0]] * 4], dtype=torch.float64),
        spins=torch.tensor([[1.0, 1.0, -1.0, -1.0]], dtype=torch.float64),
        torque_ratios=torch.full((1, 4), 2.08e-4, dtype=torch.float64),
        max_thrusts=torch.ones(1, 4, dtype=torch.float64),
        radii=torch.full((1, 4), 0.02, dtype=torch.float64),
    )
    assert idle_thrusts(vehicle) is None
