"""Two large causes that drive the plain model far from its data sheet."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.systems.registry import setup_of

G, STEP, LATE, FRICTION = 9.81, 0.02, 0.07, 0.6
T = STEP * np.arange(200)
ONLY = [
    *("dry_friction", "viscous_friction", "friction_along_stroke"),
    *("delay", "lag", "dead_band", "command_gain", "slow_share"),
    *("sensor_delay", "sensor_delay_of_position", "sensor_delay_of_angle"),
    *("sensor_lag_of_position", "sensor_drift_of_position", "sensor_scale_of_angle"),
]
MODEL = {
    "system": "ode",
    "parameters": {
        "M": {"value": 1.2, "percent": 3},
        "m": {"value": 0.25, "percent": 3},
        "L": {"value": 0.4, "percent": 2},
        "c": {"value": 1.0, "percent": 50},
    },
    "inputs": [{"name": "force", "held": True}],
    "states": {"x": 0, "v": 0, "q": 0, "w": 0},
    "define": {
        "push": "force - c*v",
        "a": f"(push + m*sin(q)*(L*w**2 + {G}*cos(q)))/(M + m*sin(q)**2)",
    },
    "rates": {"x": "v", "v": "a", "q": "w", "w": f"-(a*cos(q) + {G}*sin(q))/L - 0.02*w"},
    "readings": {"x": "x", "angle": "q"},
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "M", "force": "push"}],
    "effects": {"only": ONLY},
    "effort": {"max_effects": 2, "num_refits": 2, "max_rounds": 2},
}
FORCES = {
    "sine": 4.0 * np.sin(3.1 * T),
    "square": np.where(np.sin(2.2 * T + 0.3) > 0.0, 3.0, -3.0),
    "multi": 2.0 * np.sin(1.7 * T) + 2.0 * np.sin(5.3 * T + 1.0),
    "sweep": 4.0 * np.sin(2.0 * np.pi * (0.2 + 0.12 * T) * T),
}


def record(force: np.ndarray) -> np.ndarray:
    """Position and angle of a cart that rubs, as a camera shows them that is late."""

    def rates(s: float, y: np.ndarray) -> tuple[float, ...]:
        _, v, q, w = y
        push = force[min(int(s / STEP + 1e-9), len(T) - 1)] if s >= 0.0 else 0.0
        push -= 0.8 * v + FRICTION * np.tanh(v / 0.01)
        a = (push + 0.25 * np.sin(q) * (0.4 * w * w + G * np.cos(q))) / (
            1.2 + 0.25 * np.sin(q) ** 2
        )
        return v, a, w, -(a * np.cos(q) + G * np.sin(q)) / 0.4 - 0.02 * w

    at = np.maximum(T - LATE, 0.0)
    span, options = (0.0, T[-1]), {"max_step": 0.005, "rtol": 1e-7}
    seen = solve_ivp(rates, span, np.zeros(4), dense_output=True, **options)
    return seen.sol(at)[[0, 2]].T


def cart() -> Study:
    rng = np.random.default_rng(5)
    channels = (Channel("x", "m", "position", 1e-3), Channel("angle", "rad", "angle", 5e-3))
    runs = []
    for order, (name, force) in enumerate(FORCES.items()):
        noise = rng.normal(size=(len(T), 2)) * [1e-3, 5e-3]
        use = "test" if name == "sweep" else "fit"
        measured = record(force) + noise
        runs.append(Run(name, T, measured, {"force": force}, name, order, use))
    return Study("cart", "ode", channels, tuple(runs), model=MODEL)


def test_two_large_causes_are_named_although_neither_helps_alone():
    study = cart()
    setup = setup_of(study)
    report = diagnose(study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns)
    assert report.verdict == "named", report.sentences
    assert set(report.named) == {"dry_friction", "sensor_delay"}, report.sentences
    (late,) = next(c.size for c in report.causes if c.name == "sensor_delay").values()
    assert late.low <= LATE <= late.high
    (rubs,) = next(c.size for c in report.causes if c.name == "dry_friction").values()
    assert abs(rubs.value - FRICTION) < 0.03
    masses = {row.name: row for row in report.base if row.name in ("M", "m")}
    assert all(abs(row.pull) < 2.0 for row in masses.values())
