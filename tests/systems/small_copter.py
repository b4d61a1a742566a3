"""A quadcopter of its own, z up: Newton and Euler by a Runge-Kutta method, nothing of diffsim."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np

GRAVITY = 9.81
MASS, ARM = 0.5, 0.12
INERTIA = np.diag([3.6e-3, 3.7e-3, 6.5e-3])
COEFFICIENT, TORQUE_RATIO = 5.57e-6, 0.0245  # N s^2, m
RADIUS = 0.1  # of the propellers, m
PLACES = np.array([[ARM, -ARM, 0.0], [-ARM, ARM, 0.0], [ARM, ARM, 0.0], [-ARM, -ARM, 0.0]])
REACTION = np.array([1.0, 1.0, -1.0, -1.0])  # about +z: the propeller turns clockwise from above
SPINS = ("cw", "cw", "ccw", "ccw")


@dataclass(frozen=True)
class Causes:
    """What the flight has and the plain model lacks."""

    motor_lag_s: float = 0.0
    speed_drag: float = 0.0  # N per (m/s rad/s) and rotor
    center_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shares: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    torques: tuple[float, float, float, float] | None = None  # shares too; None: as the thrusts
    tilt: tuple[float, float] = (0.0, 0.0)  # axis of the second rotor towards +x and +y, rad
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)  # N
    gust: tuple[float, float] = (0.0, 0.0)  # N along x, Hz
    extra_mass: float = 0.0
    load: tuple[float, float] = (0.0, 0.5)  # kg on a string of so many m
    ground: float = 0.0  # thrust times 1 + ground (RADIUS / 4 height)^2


@dataclass
class Flight:
    """Records at even times, world z up, body forward-left-up."""

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    rates: np.ndarray
    specific: np.ndarray
    speeds: np.ndarray = field(repr=False)  # as commanded

    @property
    def quaternion(self) -> np.ndarray:
        """(w, x, y, z), of any sign."""
        from scipy.spatial.transform import Rotation

        return np.roll(Rotation.from_matrix(self.rotation).as_quat(), 1, axis=-1)


def path(kind: str, t: float) -> np.ndarray:
    """Where the vehicle should be, and its yaw."""
    if kind == "circle":
        return np.array([np.cos(1.3 * t) - 1.0, np.sin(1.3 * t), 1.0 + 0.2 * np.sin(t), 0.3 * t])
    if kind == "low":
        return np.array([0.5 * np.sin(1.2 * t), 0.4 * np.sin(t), 0.2 + 0.08 * np.sin(2.0 * t), 0.0])
    if kind == "lower":
        return np.array(
            [0.3 * np.sin(t), 0.5 * np.sin(1.6 * t), 0.17 + 0.06 * np.sin(2.7 * t), 0.0]
        )
    if kind == "dash":
        return np.array([1.2 * np.sin(1.9 * t), 0.3 * np.sin(2.5 * t), 1.0, 0.4 * np.sin(t)])
    return np.array([0.5 * np.sin(t), 0.5 * np.sin(2.1 * t), 1.0 + 0.5 * np.sin(1.4 * t), 0.8])


def fly(
    kind: str, causes: Causes | None = None, seconds: float = 3.0, dt: float = 0.02, fine: int = 10
) -> Flight:
    """Closed loop: commands held for ``dt``, motion integrated in ``fine`` steps of it."""
    causes = causes or Causes()
    start = path(kind, 0.0)
    state = np.zeros(26)
    state[:3], state[6:15] = start[:3], np.eye(3).ravel()
    hover = np.sqrt(MASS * GRAVITY / 4 / COEFFICIENT)
    state[18:22] = hover
    state[22:24] = 0.0
    count = round(seconds / dt)
    rows, commands, means = [], [], []
    for k in range(count + 1):
        command = _control(kind, k * dt, state)
        rows.append(state.copy())
        commands.append(command)
        if not causes.motor_lag_s:
            state[18:22] = command
        before = state[3:6].copy()
        h, turn = dt / fine, state[6:15].reshape(3, 3).copy()
        for i in range(fine):
            t = k * dt + i * h
            a = _rate(state, command, causes, t)
            b = _rate(state + 0.5 * h * a, command, causes, t + 0.5 * h)
            c = _rate(state + 0.5 * h * b, command, causes, t + 0.5 * h)
            d = _rate(state + h * c, command, causes, t + h)
            state = state + h / 6.0 * (a + 2 * b + 2 * c + d)
        halfway = 0.5 * (turn + state[6:15].reshape(3, 3))
        means.append(halfway.T @ ((state[3:6] - before) / dt + [0.0, 0.0, GRAVITY]))
    s = np.array(rows)
    specific = np.array([means[0], *means[:-1]])
    return Flight(
        dt * np.arange(count + 1),
        s[:, :3],
        s[:, 3:6],
        s[:, 6:15].reshape(-1, 3, 3),
        s[:, 15:18],
        specific,
        np.array(commands),
    )


NEXT, AFTER = [1, 2, 0], [2, 0, 1]
MIXER = np.array([np.ones(4), PLACES[:, 1], -PLACES[:, 0], TORQUE_RATIO * REACTION])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """As numpy's, which takes a third of a flight."""
    return a[..., NEXT] * b[..., AFTER] - a[..., AFTER] * b[..., NEXT]


@cache
def _rotors(causes: Causes) -> tuple[np.ndarray, ...]:
    """Arms, axes, and shares of thrust and torque."""
    axes = np.tile([0.0, 0.0, 1.0], (4, 1))
    east, north = causes.tilt
    axes[1] = [np.sin(east) * np.cos(north), np.sin(north), np.cos(east) * np.cos(north)]
    taken = causes.shares if causes.torques is None else causes.torques
    arms = PLACES - np.array(causes.center_of_mass)
    return arms, axes, np.array(causes.shares), np.array(taken)


def _control(kind: str, t: float, s: np.ndarray) -> np.ndarray:
    """Speeds that a geometric controller asks for."""
    h = 1e-3
    here, aim = path(kind, t), (path(kind, t + h) - path(kind, t - h)) / (2 * h)
    push = (path(kind, t + h) - 2 * here + path(kind, t - h)) / h**2
    wish = push[:3] + 9.0 * (here[:3] - s[:3]) + 5.0 * (aim[:3] - s[3:6]) + [0, 0, GRAVITY]
    z = wish / np.linalg.norm(wish)
    y = _cross(z, np.array([np.cos(here[3]), np.sin(here[3]), 0.0]))
    y /= np.linalg.norm(y)
    want = np.column_stack([_cross(y, z), y, z])
    turn = s[6:15].reshape(3, 3)
    off = 0.5 * (want.T @ turn - turn.T @ want)
    error = np.array([off[2, 1], off[0, 2], off[1, 0]])
    torque = INERTIA @ (-np.array([90, 90, 25.0]) * error - np.array([16, 16, 8.0]) * s[15:18])
    thrusts = np.linalg.solve(MIXER, [MASS * float(wish @ turn[:, 2]), *torque])
    return np.sqrt(np.clip(thrusts, 0.1, 4.0) / COEFFICIENT)


def _rate(s: np.ndarray, command: np.ndarray, causes: Causes, t: float) -> np.ndarray:
    turn, rates, speed = s[6:15].reshape(3, 3), s[15:18], s[18:22]
    arms, axes, shares, taken = _rotors(causes)
    thrusts = COEFFICIENT * speed**2 * shares
    if causes.ground:
        heights = np.maximum(s[2] + (PLACES @ turn.T)[:, 2], 0.5 * RADIUS)
        thrusts = thrusts * (1.0 + causes.ground * (RADIUS / (4.0 * heights)) ** 2)
    forces = thrusts[:, None] * axes
    if causes.speed_drag:
        hubs = turn.T @ s[3:6] + _cross(rates, arms)
        forces[:, :2] -= causes.speed_drag * speed[:, None] * hubs[:, :2]
    torque = _cross(arms, forces).sum(0)
    torque += (TORQUE_RATIO * COEFFICIENT * REACTION * speed**2 * taken) @ axes
    mass = MASS + causes.extra_mass
    outside = np.array(causes.wind)
    outside[0] += causes.gust[0] * np.sin(2 * np.pi * causes.gust[1] * t)
    force = turn @ forces.sum(0) + outside
    out = np.zeros_like(s)
    load, length = causes.load
    swing, swing_rate = s[22:24], s[24:26]
    if load:  # small swings: the load follows the vehicle's height
        force[:2] += load * GRAVITY / length * swing
        acceleration = np.array([force[0] / mass, force[1] / mass, force[2] / (mass + load)])
        acceleration[2] -= GRAVITY
        out[22:24] = swing_rate
        out[24:26] = -GRAVITY / length * swing - acceleration[:2]
    else:
        acceleration = force / mass - [0.0, 0.0, GRAVITY]
    spin = np.array(
        [[0, -rates[2], rates[1]], [rates[2], 0, -rates[0]], [-rates[1], rates[0], 0.0]]
    )
    out[:3], out[3:6], out[6:15] = s[3:6], acceleration, (turn @ spin).ravel()
    out[15:18] = np.linalg.solve(INERTIA, torque - _cross(rates, INERTIA @ rates))
    if causes.motor_lag_s:
        out[18:22] = (command - speed) / causes.motor_lag_s
    return out
