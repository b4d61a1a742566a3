"""Slack inside a definition: a belt whose play no command and no force at a place is."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.search.scan import scan
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.linearization import linearization_at
from diffsim.systems.registry import setup_of

TIME = 0.005 * np.arange(200)
BELT = "k*(motor - drum/2) + c*(speed - turn)"
HALF = 0.02  # rad
CLIPPED = f"clip(moment - drum, -{HALF}, {HALF})"
SLACK = f"k*(motor - drum/2 - clip(motor - drum/2, -{HALF}, {HALF})) + c*(speed - turn)"


def drive(belt: str, **define: str) -> Study:
    """A motor that turns a drum by a belt, both angles read; nothing measured yet."""
    channels = tuple(Channel(name, "rad", "angle", sd=1e-3) for name in ("a", "b"))
    moment = 0.5 * np.sin(9.0 * TIME) + 0.2 * np.sin(31.0 * TIME)
    run = Run("sweep", TIME, np.zeros((len(TIME), 2)), {"moment": moment}, "sweep")
    place = {"unit": "N m", "position_unit": "rad", "inertia": "0.004"}
    model = {
        "system": "ode",
        "parameters": {"k": {"value": 40, "percent": 15}, "c": {"value": 0.03, "percent": 50}},
        "inputs": [{"name": "moment", "held": True}],
        "states": {"motor": 0, "speed": 0, "drum": 0, "turn": 0},
        "define": {"belt": belt, **define},
        "rates": {
            "motor": "speed",
            "speed": "(moment - 0.02*speed - belt)/0.004",
            "drum": "turn",
            "turn": "(belt - 0.03*turn)/0.006",
        },
        "readings": {"a": "motor", "b": "drum"},
        "places": [
            {"name": "motor", "position": "motor", "velocity": "speed", **place},
            {"name": "drum", "position": "drum", "velocity": "turn", **place},
        ],
        "time_step": 0.001,
    }
    return Study("belt", "ode", channels, (run,), model=model)


def problem_of(study: Study, *names: str) -> Problem:
    setup = setup_of(study)
    effects = tuple(e for e in setup.effects if e.name in names)
    return Problem(setup.model, study.fit_runs, WhiteNoise(study.channels), effects)


def recorded(belt: str):
    problem = problem_of(drive(belt))
    return problem.record(np.zeros(problem.num_base))


def with_slack(plain: str):
    """What the cause makes of the record at its true size, (N,) [rad]."""
    problem = problem_of(drive(plain), "slack_inside_belt")
    (effect,) = problem.effects
    assert (effect.shown_unit, effect.signed, effect.smooth) == ("rad", False, False)
    none = np.zeros(problem.num_base)
    np.testing.assert_allclose(problem.record(np.append(none, 0.0)), recorded(plain), atol=1e-12)
    size = HALF / effect.shown_times / problem.size_units[0]
    return problem.record(problem.standardized(np.append(none, size)))


def test_slack_inside_is_the_formula_without_it():
    np.testing.assert_allclose(with_slack(BELT), recorded(SLACK), atol=1e-9)
    assert np.abs(recorded(SLACK) - recorded(BELT)).max() > HALF


def test_nothing_is_damped_within_the_slack_of_places_that_are_states():
    motor, speed, drum, turn, seen, step = 0.0, 0.0, 0.0, 0.0, [], 2e-5
    for moment in drive(BELT).runs[0].command["moment"]:
        seen += [motor, drum]
        for _ in range(round(0.005 / step)):
            apart = motor - drum
            beyond = apart - min(max(apart, -HALF), HALF)
            belt = 40 * beyond + (0.03 * (speed - turn) if beyond else 0.0)
            speed, turn = (
                speed + step * (moment - 0.02 * speed - belt) / 0.004,
                turn + step * (belt - 0.03 * turn) / 0.006,
            )
            motor, drum = motor + step * speed, drum + step * turn
    found = with_slack(BELT.replace("/2", ""))
    np.testing.assert_allclose(found, seen, atol=1e-3)  # of steps of 1 ms
    # speeds that are written otherwise are damped always
    always = with_slack("k*(motor - drum) + c*(1*speed - turn)")
    assert np.abs(always - seen).max() > 4e-3


def test_the_size_of_a_slack_inside_is_found():
    """A belt's 17 mrad were something without a name, 5.3 times the noise."""
    study = drive(BELT)
    seen = recorded(SLACK).reshape(study.runs[0].measured.shape)
    problem = problem_of(study, "slack_inside_belt")
    problem = replace(problem, runs=(replace(study.runs[0], measured=seen),))
    at = linearization_at(problem, np.zeros(problem.num_base + 1), screen=True)
    found = scan(problem, range(problem.num_base), at, [0]).at
    assert found is not None
    (effect,) = problem.effects
    half = problem.scaled(found.x)[-1] * problem.size_units[0] * effect.shown_times
    assert 0.4 * HALF < half < 2.5 * HALF  # decades are tried; the fit does the rest


def test_a_controller_does_nothing_within_its_dead_zone():
    """A camera's head whose error of 2.6 degrees moved nothing was said to rub, 3.1 times the noise
    left; what damps it stays."""
    plain, dead = (f"k*({e}) - c*turn" for e in ("moment - drum", f"moment - drum - {CLIPPED}"))
    np.testing.assert_allclose(with_slack(plain), recorded(dead), atol=1e-9)
    assert np.abs(recorded(dead) - recorded(plain)).max() > 0.1 * HALF


@pytest.mark.parametrize(
    ("belt", "more"),
    [
        ("k*(moment - turn)", {}),  # what follows is no place
        ("k*(speed - turn)", {}),  # speeds have no places
        ("k*(motor - load)", {"load": "2*drum"}),  # nor has what is defined
        ("k*motor + c*(motor - motor/2)", {}),
    ],
)
def test_what_is_no_difference_of_two_places_has_no_slack(belt, more):
    assert not [e.name for e in setup_of(drive(belt, **more)).effects if "slack_inside" in e.name]
