"""Soft-body bed: columns by tangents of the simulation against differences of whole simulations.

Differences of the fourth order, from two steps of second-order ones, are the yardstick: their
truncation is below 1e-5 of a column, and the solver's tolerance of 1e-11 adds 1e-8.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run
from diffsim.diagnose import SimModel, library
from diffsim.diagnose.beds import actuator
from diffsim.diagnose.beds.soft import SoftModel, beam_model, tendon_model, unknown_force
from diffsim.diagnose.beds.soft import forces as soft_forces
from diffsim.diagnose.beds.soft.scene import Force
from diffsim.identify import Jacobian, Parameter, Problem, WhiteNoise
from tests.diagnose.test_soft_bed import BAR

CELLS = (5, 1, 1)
SMOOTH = [e for e in library("soft_body") if e.smooth]
AIR = [e for e in SMOOTH if e.kind != "actuator" and e.name != "delay"]
NOISE = WhiteNoise([Channel(c, "m", "position", sd=1e-3) for c in "xyz"])


def record(until_s=0.2, **command):
    time = np.arange(0.0, until_s + 1e-9, 0.01)
    values = {name: signal(time) for name, signal in command.items()}
    return Run("a", time, np.zeros((len(time), 3)), values, "g", order=2)


FREE = record()
PULLED = record(shortening=lambda time: 0.03 * np.sin(2 * np.pi * 3.0 * time) ** 2)


def beam(**changes):
    return beam_model(BAR, **{"cells": CELLS, "rtol": 1e-11, "runs": ["a"]} | changes)


def tendon(**changes):
    return tendon_model(**{"cells": (5, 2, 2), "rtol": 1e-11} | changes)


def columns(problem, x, **changes):
    """Residual and Jacobian by tangents, and by extrapolated differences."""
    found = problem.linearise(x)
    coarse, fine = (
        replace(problem, jacobian=Jacobian(method="differences", step=h)).linearise(x)
        for h in (1e-2, 5e-3)
    )
    return found, (fine[0], (4.0 * fine[1] - coarse[1]) / 3.0)


def assert_alike(problem, x, rtol=1e-4):
    (residual, found), (expected_residual, expected) = columns(problem, x)
    np.testing.assert_allclose(residual, expected_residual, atol=1e-6)
    for k, name in enumerate(problem.names):
        error = np.linalg.norm(found[:, k] - expected[:, k])
        assert error <= rtol * np.linalg.norm(expected[:, k]) + 1e-9, name


def simulations(monkeypatch):
    """Counts scenes that are simulated as a whole."""
    count = []
    simulate = SimModel.simulate_scenes

    def counted(self, scenes):
        count.extend(scenes)
        return simulate(self, scenes)

    monkeypatch.setattr(SimModel, "simulate_scenes", counted)
    return count


@pytest.mark.parametrize("integrator", ["bdf2", "implicit_midpoint"])
def test_every_effect_at_zero(integrator, monkeypatch):
    count = simulations(monkeypatch)
    problem = Problem(beam(integrator=integrator), (FREE,), NOISE, tuple(AIR))
    x = np.zeros(len(problem.names))
    problem.linearise(x)
    assert not count  # no column is simulated
    assert_alike(problem, x)


def test_effects_that_act():
    """Forces that remember, of the speed and of the material, at sizes that matter."""
    problem = Problem(beam(), (FREE,), NOISE, tuple(AIR))
    x = np.array([0.3 if n.split(".")[0] in ACTING else 0.0 for n in problem.names])
    assert_alike(problem, x)


ACTING = ("loss_factor", "stiffening", "linear_drag", "dry_friction", "tilt", "release_time@a")


def test_tendon_from_equilibrium():
    """A command on its way through a lag, a start that depends on the material, no forces."""
    effects = tuple(e for e in SMOOTH if e.name in ("lag", "weight", "sensor_scale", "delay"))
    late = actuator.CommandDelay()
    for delay in (effects, (*(e for e in effects if e.name != "delay"), late)):
        problem = Problem(tendon(), (PULLED,), NOISE, delay)
        x = np.zeros(len(problem.names))
        assert_alike(problem, x)


def test_tendon_in_water():
    """Drag that the body's start depends on too. Faces that turn edge-on make small jumps."""
    problem = Problem(tendon(water=True), (PULLED,), NOISE, (soft_forces.LinearDrag(),))
    x = np.zeros(len(problem.names))
    x[-1] = 0.2
    assert_alike(problem, x, rtol=2e-2)


def test_unknown_force():
    effect = unknown_force(3, 0.2)
    problem = Problem(beam(), (FREE,), NOISE, (soft_forces.LinearDrag(), effect))
    x = np.zeros(len(problem.names))
    x[3] = 0.3
    assert_alike(problem, x)


def test_non_smooth_effects_are_simulated(monkeypatch):
    band = actuator.DeadBand()
    problem = Problem(tendon(), (PULLED,), NOISE, (band,))
    x = np.zeros(len(problem.names))
    count = simulations(monkeypatch)
    _, found = problem.linearise(x, screen=True)
    assert len(count) == 2  # here, and where the secant ends
    by_differences = replace(problem, jacobian=Jacobian(method="differences"))
    _, expected = by_differences.linearise(x, screen=True)
    np.testing.assert_allclose(found[:, -1], expected[:, -1], atol=1e-9)


class OldHook(Force):
    """Understands single states only, as hooks may."""

    def __init__(self, size):
        self._size, self._seen = size, 0.0

    def __call__(self, scene, moment):
        self._seen = self._seen + moment.v[-1, 2]
        force = torch.zeros_like(moment.x)
        force[-1] = -self._size * self._seen
        return force


class Remembering(soft_forces.LinearDrag):
    typical = 2e-3

    def apply(self, scene, size, run):
        return scene.with_force(lambda: OldHook(size[0]))


def test_hooks_and_observers_without_leading_axes():
    plain = beam()

    def build(values, run, numerics):
        scene = plain.build(values, run, numerics)
        nodes = [-1, -2]
        return scene.changed(observe=lambda x: x[nodes].mean(0) + values["place"])

    model = SoftModel(build, (*plain.base, Parameter("place", 0.0, 1e-3, "m")))
    problem = Problem(model, (FREE,), NOISE, (Remembering(), soft_forces.LinearDrag()))
    x = np.zeros(len(problem.names))
    x[-2:] = 0.3
    assert_alike(problem, x)


def test_explicit_steps_fall_back_to_differences(monkeypatch):
    model = beam(integrator="semi_implicit_euler", dt_s=2e-4)
    problem = Problem(model, (record(0.02),), NOISE)
    count = simulations(monkeypatch)
    problem.linearise(np.zeros(len(problem.names)))
    assert len(count) == 1 + 2 * len(problem.names)
