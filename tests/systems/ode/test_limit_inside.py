"""A definition that saturates: a controller with a limit of which the study says nothing."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose.search.scan import scan
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.linearization import linearization_at
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study, described

LIMIT = 3.0  # N
SERVO = {
    "inputs": [{"name": "force", "held": True}],
    "rates": {"x": "v", "v": "(push - c*v - k*x)/m"},
    "parameters": {
        "m": {"value": 1.0, "percent": 15, "unit": "kg"},
        "c": {"value": 0.8, "percent": 50, "unit": "N s/m"},
        "k": {"value": "40 N/m", "percent": 5},
        "kp": {"value": 60.0, "percent": 20, "unit": "N/m"},
    },
    "time_step": 0.005,
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "m", "force": "push"}],
}
PUSH = "kp*(0.05*force - x) - 4*v"


def servo(push, **define):
    """The study and its setup, with definitions."""
    study = cart_study(model=described(**SERVO, define={"push": push, **define}))
    return study, setup_of(study)


@pytest.mark.parametrize(
    ("rate", "is_told"),
    [
        ("(push - c*v - k*x)/m", True),
        ("(push*where(x > 0, 2, 1) - c*v - k*x)/m", True),
        ("(push - 0.1*push*abs(push) - c*v - k*x)/m", False),
        ("(max(push, 0) - c*v - k*x)/m", False),
        ("where(push > 1, push, 0)/m", False),
        ("-k*x/(m + push)", False),
    ],
)
def test_a_coupling_is_no_cause_where_its_share_of_the_force_is_not_told(rate, is_told):
    """The share is that of rates under forces of 0 and 1, a straight line."""
    model = described(**{**SERVO, "rates": {"x": "v", "v": rate}}, define={"push": PUSH})
    names = {effect.name for effect in setup_of(cart_study(model=model)).effects}
    assert ("elastic_coupling" in names) is is_told


def problem_of(study, setup, *names):
    effects = tuple(e for e in setup.effects if e.name in names)
    return Problem(setup.model, study.fit_runs, WhiteNoise(study.channels), effects)


def recorded_under(limit):
    """What the servo with a limit does in the runs to fit, (N,) [m]."""
    study, setup = servo(f"clip({PUSH}, -{limit}, {limit})")
    problem = problem_of(study, setup)
    return problem.record(np.zeros(problem.num_base))


def test_a_limit_inside_is_the_formula_clipped():
    study, setup = servo(PUSH)
    (limit,) = [e for e in setup.effects if e.name == "limit_inside_push"]
    assert (limit.shown_unit, limit.shown_power, limit.signed) == ("N", -1, False)
    problem = problem_of(study, setup, "limit_inside_push")
    size = limit.shown_times / LIMIT  # of the usual push, how much weaker
    x = problem.standardized(np.array([*np.zeros(problem.num_base), size / problem.size_units[0]]))
    np.testing.assert_allclose(problem.record(x), recorded_under(LIMIT), atol=1e-9)
    np.testing.assert_allclose(problem.record(np.zeros(len(x))), recorded_under(1e9), atol=1e-12)


def test_forces_beside_a_limited_one_are_not_limited():
    """A weight on a motor's shaft was clipped with the motor's torque."""
    study, setup = servo(PUSH)
    problem = problem_of(study, setup, "constant_force", "limit_inside_push")
    sizes = {
        e.name: 1.5 if e.shown_times is None else e.shown_times / LIMIT for e in problem.effects
    }
    own = np.array([sizes[e.name] for e in problem.effects]) / problem.size_units
    found = problem.record(problem.standardized(np.array([*np.zeros(problem.num_base), *own])))
    study, setup = servo(f"clip({PUSH}, -{LIMIT}, {LIMIT}) + 1.5")
    plain = problem_of(study, setup)
    np.testing.assert_allclose(found, plain.record(np.zeros(plain.num_base)), atol=1e-9)


def test_a_limit_has_a_unit_only_where_a_place_states_that_of_its_force():
    """The outer loop of a cascade is a speed: its limit was read in newtons."""
    _, setup = servo("kp*(goal - v)", goal="3*(0.05*force - x)")
    units = {e.name: e.shown_unit for e in setup.effects if e.name.startswith("limit_inside")}
    assert units == {"limit_inside_goal": "-"}


def test_the_size_of_a_limit_is_found_although_its_slope_at_zero_is_zero():
    """Nothing moves until the limit is reached: slopes promised nothing, and drag helped."""
    study, setup = servo(PUSH)
    problem = problem_of(study, setup, "limit_inside_push")
    at = linearization_at(problem, np.zeros(problem.num_base + 1), screen=True)
    base = list(range(problem.num_base))
    seen = recorded_under(LIMIT)
    (limit,) = problem.effects
    measured = np.split(seen, np.cumsum([r.measured.size for r in problem.runs])[:-1])
    runs = tuple(
        replace(r, measured=m.reshape(r.measured.shape))
        for r, m in zip(problem.runs, measured, strict=True)
    )
    found = scan(replace(problem, runs=runs), base, at, [0])
    assert found.at is not None
    size = problem.scaled(found.at.x)[-1] * problem.size_units[0]
    assert limit.shown_times / size == pytest.approx(LIMIT, rel=0.25)
