"""Friction and a constant torque in a stiff loop, where steps that suit the plain model do not."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from diffsim.cli.diagnose_inputs import FIRST, SEARCH
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose import diagnose
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.systems.registry import setup_of

INERTIA, STIFFNESS, DAMPING = 30.0, 4000.0, 420.0
FRICTION, TORQUE, NOISE = 104.0, -111.0, np.radians(0.02)
T = 0.02 * np.arange(300)
DEMANDS = {
    "slow": 0.05 * np.sin(1.3 * T) + 0.02 * np.sin(4.1 * T),
    "steps": np.select([T < 1.5, T < 3.0, T < 4.5], [0.04, 0.11, 0.07], 0.14) - 0.08,
    "fast": 0.04 * np.sin(1.9 * T + 1.0) + 0.02 * np.sin(3.3 * T),
}
MODEL = {
    "system": "ode",
    "parameters": {
        "I": {"value": INERTIA, "percent": 5, "unit": "kg m^2"},
        "kp": {"value": STIFFNESS, "percent": 5, "unit": "N m/rad"},
        "kd": {"value": DAMPING, "percent": 20, "unit": "N m s/rad"},
    },
    "inputs": [{"name": "demand", "held": True}],
    "states": {"q": 0, "w": 0},
    "define": {"torque": "kp*(demand - q) - kd*w"},
    "rates": {"q": "w", "w": "torque/I"},
    "readings": {"pitch": "q"},
    "places": [
        {
            **{"name": "blade", "position": "q", "velocity": "w", "inertia": "I"},
            **{"force": "torque", "unit": "N m", "position_unit": "rad"},
        }
    ],
}
# a third of the causes: what makes steps finer is the friction, not how many others stand by
FRICTIONS = ("dry_friction", "viscous_friction", "friction_asymmetry", "constant_force")
MODEL["effects"] = {
    "only": [
        *(f"{name}_at_blade" for name in FRICTIONS),
        *("lag", "delay", "command_offset", "command_gain", "slack", "sensor_offset_of_angle"),
    ]
}
# a command's offset of TORQUE/kp is the same to these records
SAME = {"constant_force_at_blade", "command_offset", "sensor_offset_of_angle", "slack"}


def drive() -> Study:
    rng = np.random.default_rng(4)
    runs = []
    for order, (name, given) in enumerate(DEMANDS.items()):
        demand = given * (1.0 - np.exp(-2.0 * T)) + 0.1 * (1.0 - np.exp(-3.0 * T))

        def rates(s: float, y: np.ndarray, demand: np.ndarray = demand) -> tuple[float, float]:
            now = demand[min(int(s / 0.02 + 1e-9), len(T) - 1)]
            torque = STIFFNESS * (now - y[0]) - DAMPING * y[1] + TORQUE
            return y[1], (torque - FRICTION * np.tanh(y[1] / 0.002)) / INERTIA

        options = {"method": "LSODA", "max_step": 0.005, "rtol": 1e-8, "atol": 1e-10}
        seen = solve_ivp(rates, (0.0, T[-1]), np.zeros(2), t_eval=T, **options).y[:1].T
        use = "test" if name == "fast" else "fit"
        measured = seen + NOISE * rng.normal(size=seen.shape)
        runs.append(Run(name, T, measured, {"demand": demand}, name, order, use))
    channels = (Channel("pitch", "rad", "angle", NOISE),)
    return Study("drive", "ode", channels, tuple(runs), model=MODEL)


@pytest.mark.story  # searched twice, by steps of milliseconds
def test_a_first_answer_repeats_under_finer_steps_what_coarse_ones_could_not_fit():
    study = drive()
    setup = setup_of(study)
    settings = DiagnosisSettings(search=SearchSettings(**SEARCH), **FIRST)
    given = {"unknowns": setup.unknowns, "settings": settings}
    report = diagnose(study, setup.model, setup.effects, seed=0, **given)
    best = {e.name for e in report.best.problem.effects}
    assert "dry_friction_at_blade" in best and best & SAME, report.sentences
    assert report.left < 1.2, report.sentences
