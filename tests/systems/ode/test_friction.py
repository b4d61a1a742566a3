"""Friction that holds at rest where steps are too long to follow it, and that falls with speed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Command, Run
from diffsim.identify import Problem, WhiteNoise, fit
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study, described

WIDTH = 1e-4  # m/s, below which friction fades
TIME = 0.01 * np.arange(200.0)


def moved(model, force, sizes):
    """Where a cart is under a steady force and causes of given sizes, (num_samples,) [m]."""
    study = replace(cart_study(model=model), commands=(Command("force", "N"),))
    setup = setup_of(study)
    effects = tuple(e for e in setup.effects if e.name in sizes)
    run = Run("a", TIME, np.zeros((len(TIME), 1)), {"force": np.full(len(TIME), force)}, "a")
    problem = Problem(setup.model, (run,), WhiteNoise(study.channels), effects)
    scaled = [sizes[e.name] / unit for e, unit in zip(effects, problem.size_units, strict=True)]
    x = problem.standardized(np.array([*np.zeros(problem.num_base), *scaled]))
    with torch.no_grad():
        return problem.predict(run, torch.from_numpy(x)).numpy()[:, 0]


def position(force, friction, *, constant=0.0, step=0.01):
    """Where a cart without a spring is under a steady force, (num_samples,) [m]."""
    place = {"name": "cart", "position": "x", "velocity": "v", "inertia": "m"}
    model = described(
        rates={"x": "v", "v": "(force - c*v)/m"},
        parameters={"m": {"value": 1.0, "percent": 3}, "c": {"value": 0.5, "percent": 3}},
        places=[{**place, "stick_velocity": WIDTH}],
        time_step=step,
    )
    return moved(model, force, {"dry_friction": friction, "constant_force": constant})


@pytest.mark.parametrize("constant", [0.0, 0.6])
def test_what_sticks_stays(constant):
    """It slid with the load at once: steps of 10 ms follow no friction that fades in 0.1 mm/s."""
    assert np.abs(position(1.0, 2.0, constant=constant)).max() < WIDTH * TIME[-1]


@pytest.mark.parametrize("servo", [False, True])
def test_friction_grows_with_what_inputs_push(servo):
    """A tendon over a pulley loses a share of its force; of a controller its force counts."""
    push, spring = ("4*force - 2*x", "") if servo else ("4*force", " - 2*x")
    place = {"name": "cart", "position": "x", "velocity": "v", "inertia": "m"}
    model = described(
        rates={"x": "v", "v": f"(push - v{spring})/m"},
        define={"push": push},
        parameters={"m": {"value": 1.0, "percent": 3}},
        places=[{**place, "stick_velocity": WIDTH}],
        time_step=0.01,
    )
    seen = moved(model, 1.0, {"load_friction": 0.25})
    lost = "0.25*push" if servo else "0.25*4*force"
    rates = {"x": "v", "v": f"(push - {lost} - v{spring})/m"}  # as long as it slides forwards
    exact = moved({**model, "rates": rates, "places": []}, 1.0, {})
    assert (np.diff(exact) > 0.0).all() and exact[-1] > 0.5
    assert seen == pytest.approx(exact, abs=2e-3)


@pytest.mark.parametrize(
    ("rate", "define", "unit", "is_offered"),
    [
        ("(pull - c*v)/m", {"pull": "force*0.01"}, "N", True),
        ("(turn - c*v)/m", {"current": "force - 2*v", "turn": "3*current"}, "V", True),
        ("(force - c*v)/m", {}, "N", True),
        ("(force*abs(force) - c*v)/m", {}, "N", False),
        ("-c*v/m", {}, "N", False),
        # a goal of a position has its zero anywhere; of a voltage nobody knows the force
        ("(9*(force - x) - c*v)/m", {}, "m", False),
        ("(9*(goal - x) - c*v)/m", {"goal": "2*force"}, "m", False),
        ("(push - c*v)/m", {"push": "9*(2*force - x)"}, "m", True),
        ("(2*force - c*v)/m", {}, "V", False),
    ],
)
def test_load_is_what_inputs_push_with_where_that_is_known(rate, define, unit, is_offered):
    parameters = {"m": {"value": 1.0, "percent": 3}, "c": {"value": 0.5, "percent": 3}}
    place = {"name": "cart", "position": "x", "velocity": "v", "inertia": "m"}
    rates = {"x": "v", "v": rate}
    model = described(rates=rates, define=define, parameters=parameters, places=[place])
    study = replace(cart_study(model=model), commands=(Command("force", unit),))
    names = {effect.name for effect in setup_of(study).effects}
    assert "dry_friction" in names and ("load_friction" in names) is is_offered


def test_what_slides_is_slowed_by_all_of_it():
    """Force less friction, against the closed form of v = (1 - exp(-c t/m)) F/c."""
    exact = 2.0 * (TIME / 0.5 - (1.0 - np.exp(-0.5 * TIME)) / 0.25)
    assert position(3.0, 1.0) == pytest.approx(exact, abs=1e-3)


@pytest.mark.story  # finer and finer steps
def test_a_step_that_follows_friction_is_as_it_was():
    """Of 10 us and 5 us: there friction fades by tanh(v/w), to the digits of the integrator."""
    coarse, fine = (position(1.0, 2.0, step=step)[:5] for step in (1e-5, 5e-6))
    assert coarse == pytest.approx(fine, rel=1e-4)
    assert coarse[4] == pytest.approx(WIDTH * np.arctanh(0.5) * 0.04, rel=0.02)


def test_friction_falls_at_the_speed_of_the_joint():
    """At 0.03 m/s, a sixth of what is usual at this pace.

    The record is integrated here in steps of 0.25 ms. At the usual speed the best fit has 3.3 times
    the chi2 of noise, and twice that at the steps of a sample.
    """
    rng, time, fine = np.random.default_rng(0), 0.02 * np.arange(300.0), 80
    force = 2.0 * np.sin(2.5 * time) * np.sin(0.4 * time)
    x = v = 0.0
    seen = []
    for push in force:
        seen.append(x)
        for _ in range(fine):
            rub = (0.3 + 0.5 * np.exp(-((v / 0.03) ** 2))) * np.tanh(v / 0.005)
            v += 0.02 / fine * (push - 0.5 * v - 4.0 * x - rub)
            x += 0.02 / fine * v
    noisy = np.array(seen)[:, None] + 1e-3 * rng.standard_normal((len(time), 1))
    place = {"name": "cart", "position": "x", "velocity": "v", "stick_velocity": 0.005}
    model = described(
        inputs=[{"name": "force", "held": True}],
        rates={"x": "v", "v": "force - c*v - 4*x"},
        parameters={"c": {"value": 0.5, "percent": 10}},
        places=[place],
        time_step=0.005,
    )
    run = Run("a", time, noisy, {"force": force}, "a")
    study = replace(cart_study(model=model), runs=(run,))
    setup = setup_of(study)
    effects = [e for e in setup.effects if e.name in ("dry_friction", "stribeck_friction")]
    found = fit(setup.model, study.runs, study.channels, effects=effects)
    usual = setup.model.frame["scales"]["plain"]["cart"]["velocity"]
    assert found.chi2 / found.num_samples < 1.3
    speed = 0.2 * usual * np.exp(found.values["fall_of_stribeck_friction"])
    assert speed == pytest.approx(0.03, rel=0.15)
