"""A controller all of whose numbers are off by one factor, such as a gear that is counted twice."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose.judge.records import CauseRow, Interval
from diffsim.diagnose.say.factors import gain_words
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.linearization import linearization_at
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study, described

SERVO = {
    "inputs": [{"name": "force", "held": True}],
    "rates": {"x": "v", "v": "(push - c*v)/m"},
    "parameters": {
        "m": {"value": 1.0, "percent": 3, "unit": "kg"},
        "c": {"value": 0.8, "percent": 20, "unit": "N s/m"},
        "kp": {"value": 60.0, "percent": 3, "unit": "N/m"},
        "kd": {"value": 4.0, "percent": 5, "unit": "N s/m"},
    },
    "time_step": 0.005,
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "m", "force": "push"}],
}
PUSH = "kp*(0.05*force - x) - kd*v"


def servo(push, **numbers):
    """The study and its setup; ``numbers``: other values of parameters."""
    stated = SERVO["parameters"]
    changed = {name: {**stated[name], "value": value} for name, value in numbers.items()}
    model = described(**{**SERVO, "parameters": {**stated, **changed}}, define={"push": push})
    study = cart_study(model=model)
    return study, setup_of(study)


@pytest.mark.parametrize(
    ("push", "is_offered"),
    [
        (PUSH, True),
        ("kp*(0.05*force - x - 0.1*v)", False),  # kp is its gain
        ("clip(kp*(0.05*force - x - kd*v), -2, 2)", False),
        ("force - 0.5*v", False),  # no number that may be off
    ],
)
def test_a_gain_is_a_cause_where_no_number_is_one(push, is_offered):
    names = {effect.name for effect in servo(push)[1].effects}
    assert ("gain_inside_push" in names) is is_offered


def test_a_drive_four_times_as_strong_is_found_where_masses_are_known():
    study, strong = servo(PUSH, kp=240.0, kd=16.0)
    white = WhiteNoise(study.channels)
    real = Problem(strong.model, study.fit_runs, white)
    record = real.record(np.zeros(real.num_base))
    rng = np.random.default_rng(1)
    runs, begins = [], 0
    for run in study.fit_runs:
        seen = record[begins : (begins := begins + run.measured.size)].reshape(run.measured.shape)
        runs.append(replace(run, measured=seen + rng.normal(0.0, 1e-3, seen.shape)))
    _, setup = servo(PUSH)
    (effect,) = (e for e in setup.effects if e.name == "gain_inside_push")
    plain = Problem(setup.model, tuple(runs), white)
    fit, _ = gauss_newton(plain, linearization_at(plain, np.zeros(plain.num_base)))
    assert abs(fit.values["kp"] - 60.0) > 10.0 * 1.8  # the plain fit leaves its data sheet
    problem = Problem(setup.model, tuple(runs), white, (effect,))
    fit, _ = gauss_newton(problem, linearization_at(problem, np.append(fit.x, 0.0)))
    assert fit.values["gain_inside_push"] == pytest.approx(3.0, abs=0.3)
    assert fit.values["m"] == pytest.approx(1.0, abs=0.06)


def test_a_gain_of_a_controller_is_asked_whether_a_gear_was_counted_twice():
    size = {"size": Interval(3.01, 2.95, 3.06)}
    row = CauseRow("gain_inside_push", "gain", "effect", "likely", 1.0, size, "-")
    assert gain_words(row) == "4.01 times: is a gear counted twice?"
