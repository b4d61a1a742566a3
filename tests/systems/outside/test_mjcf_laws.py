"""Causes that MuJoCo has itself: they are its own numbers, and the others stay forces of Python."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.causes.ports import OF_FORCES
from diffsim.core.expression import parse_expression
from diffsim.systems.outside.forces import ForceKnots, PlaceForces, Term
from tests.systems.outside import scenes

pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

from diffsim.systems.outside.mjcf import Mjcf
from diffsim.systems.outside.mjcf_laws import OWN_LAWS
from diffsim.systems.outside.mjcf_steps import Steps
from diffsim.systems.outside.source import Call
from tests.systems.outside.test_mjcf import CHANNELS, OWN, XML

HOLD = "joint.hinge.solreffriction"
SIZES = {
    "viscous_friction": 0.1,
    "dry_friction": 0.4,
    "added_spring": 0.5,
    "square_drag": 0.05,
    "cubic_stiffness": -0.3,
}


def forces_of(law: str, size: float) -> PlaceForces:
    return PlaceForces(["hinge"], [Term("hinge", scenes.law_of(law), size, 3.0)])


def simulate(force, parameters=None, xml=XML):
    return Mjcf(xml, CHANNELS).predict(parameters or {}, scenes.run_of("steps"), force)


def in_python(force, xml=XML):
    """The same forces under a formula that MuJoCo's table does not have."""
    (term,) = force.terms
    other = parse_expression(f"1*({term.law.text})", OF_FORCES)
    return simulate(PlaceForces(["hinge"], [replace(term, law=other)]), xml=xml)


@pytest.mark.parametrize("law", OWN_LAWS)
def test_a_cause_that_mujoco_has_is_its_number(law):
    stated = 0.06 if law == "viscous_friction" else 0.0
    path, size = f"joint.hinge.{OWN_LAWS[law]}", SIZES[law]
    found = simulate(forces_of(law, size))
    np.testing.assert_array_equal(found, simulate(None, {path: stated + size}))
    np.testing.assert_array_equal(  # beside the study's own value of the number
        simulate(forces_of(law, size), {path: 0.2}), simulate(None, {path: 0.2 + size})
    )
    assert np.abs(found - simulate(None)).max() > 0.02
    # RK4 takes the others explicitly, too; friction of Python is viscous at low speed
    limit = 0.1 if law == "dry_friction" else 1e-12
    assert np.abs(found - in_python(forces_of(law, size)))[:, 0].max() < limit


def test_dry_friction_holds_a_joint_where_a_force_of_python_lets_it_creep():
    """Held against gravity for 2.4 s, by a tenth more than what it needs."""
    angle, size = 0.5, 1.1 * 0.4 * 0.5 * 9.81 * np.sin(0.5)
    xml = XML.replace('<motor name="motor" joint="hinge"/>', '<motor name="motor" joint="hinge" '
                      'gear="1e-9"/>').replace("RK4", "Euler")  # fmt: skip
    start = {"joint.hinge.start": angle}
    run, sim = scenes.run_of("steps"), Mjcf(xml, CHANNELS)
    held = sim.predict(start, run, forces_of("dry_friction", size))[:, 0]
    law = parse_expression("-size*tanh(v/w)*1", OF_FORCES)
    let = sim.predict(start, run, PlaceForces(["hinge"], [Term("hinge", law, size, 3.0)]))[:, 0]
    # MuJoCo's constraint is soft: it moves by millimeters a second, thirty times less
    assert abs(held[-1] - angle) < 0.02 < 0.08 < abs(let[-1] - angle)


def test_friction_that_the_file_lacks_takes_hold_as_fast_as_steps_allow():
    """A pendulum that crept before it swung, by MuJoCo's 20 ms, was told an added spring."""
    xml, size, run = XML.replace("0.005", "0.001"), 0.3, scenes.run_of("steps")
    angle, rate, seen, step = 0.0, 0.0, [], 2e-5
    for moment in run.command["moment_Nm"]:
        seen.append(angle)
        for _ in range(round(0.02 / step)):  # sharp friction, by steps that can follow it
            push = moment - OWN["damping"] * rate - size * np.tanh(rate / 1e-3)
            rate += step * (push - OWN["gravity_moment"] * np.sin(angle)) / OWN["inertia"]
            angle += step * rate
    sim = Mjcf(xml, CHANNELS, held=True)
    (term,) = forces_of("dry_friction", size).terms
    sharp = PlaceForces(["hinge"], [replace(term, shapes=(0.0,))])
    dry = sim.predict({}, run, sharp)[:, 0]
    creeping = sim.predict({"joint.hinge.frictionloss": size}, run)[:, 0]
    off, crept = (float(np.abs(found - seen).max()) for found in (dry, creeping))
    assert off < 0.002 < 0.25 * crept


@pytest.mark.parametrize(("step", "soonest"), [("0.005", 0.01), ("0.0005", 1e-3)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, None])
def test_friction_takes_hold_in_the_time_that_is_fitted(share, step, soonest):
    """At 1, as in models saved before it was fitted, it is MuJoCo's soft friction."""
    (term,) = forces_of("dry_friction", 0.4).terms
    force = PlaceForces(["hinge"], [replace(term, shapes=() if share is None else (share,))])
    xml = XML.replace("0.005", step)
    holds = {HOLD: soonest * (0.02 / soonest) ** share} if share not in (1.0, None) else {}
    own = simulate(None, {"joint.hinge.frictionloss": 0.4, **holds}, xml)
    np.testing.assert_allclose(simulate(force, xml=xml), own, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("joint", "stated", "is_open"),
    [
        ("", (), True),
        ('frictionloss="0.1"', (), False),
        ('solreffriction="0.08 1"', (), False),
        ("", ("joint.hinge.frictionloss",), False),
    ],
)
def test_what_a_file_says_of_friction_stays(joint, stated, is_open):
    xml = XML.replace("<joint", f"<joint {joint}", 1)
    sim = Mjcf(xml, CHANNELS)
    assert sim.fits_hold("hinge", stated) is is_open
    (term,) = forces_of("dry_friction", 0.4).terms
    parts = [PlaceForces(["hinge"], [replace(term, shapes=(s,))]) for s in (0.0, 1.0)]
    numbers = dict.fromkeys(stated, 0.05)
    a, b = (simulate(force, numbers, xml) for force in parts)
    assert np.array_equal(a, b) is not is_open


NO_FRICTION = ("<option", '<option><flag frictionloss="disable"/></option><option')


@pytest.mark.parametrize(
    ("law", "size", "change"),
    [
        ("viscous_friction", -0.1, ("", "")),  # the number would be negative
        ("dry_friction", -0.02, ("", "")),
        ("dry_friction", 0.2, NO_FRICTION),
        ("added_spring", 0.5, ('axis="0 -1 0"', 'axis="0 -1 0" springref="40"')),
    ],
)
def test_what_the_number_does_not_do_is_left_to_python(law, size, change):
    xml = XML.replace(*change)
    found = simulate(forces_of(law, size), xml=xml)
    np.testing.assert_array_equal(found, in_python(forces_of(law, size), xml=xml))
    assert np.abs(found - simulate(None, xml=xml)).max() > 0.01


def test_forces_over_time_are_left_to_mujoco_and_are_the_same(monkeypatch):
    """Knots and constants are known before: stepped through in Python they were most of the time
    of an unknown force."""
    xml, run = XML.replace("RK4", "Euler"), scenes.run_of("steps")
    knots = ForceKnots("hinge", float(run.time_s[0]), 0.3, (0.0, 0.2, -0.1, 0.15))
    push = Term("hinge", scenes.law_of("constant_force"), 0.05)
    sim = Mjcf(xml, CHANNELS)
    calls = [
        Call({}, run, PlaceForces(["hinge"], terms, own))
        for terms, own in (([push], []), ([], [knots]), ([push], [knots]), ([], []))
    ]
    by_step = [
        sim._stepper.step_through(sim._prepare(c, Steps.of(run.time_s, 0.005), 0)) for c in calls
    ]
    monkeypatch.setattr(sim._stepper, "step_through", None)  # nothing is left for Python
    found = sim.predict_many(calls)
    for ours, theirs in zip(found, by_step, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert all(np.abs(found[k] - found[3]).max() > 0.01 for k in range(3))
    assert sim.count_steps(run, calls[2].force) == sim.count_steps(run)
