"""Soft-body bed: columns by tangents of the simulation against differences of whole simulations.

Both difference with a step of 0.002, one what is cheap and the other the record. Central
differences are then wrong by about 1e-5 of a column, and the solver's tolerance of 1e-11 adds 1e-8.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run
from diffsim.identify import Jacobian, Parameter, Problem, WhiteNoise
from diffsim.identify.problem import PredictionError
from diffsim.systems.soft_body import (
    SoftModel,
    model,
    tangents,
    unknown_force,
)
from diffsim.systems.soft_body.material import _Relaxation
from diffsim.systems.soft_body.scene import Force
from diffsim.systems.soft_body.unknown import _Knots
from tests.systems.soft_body.bars import model_of, pulled_bar, released_bar
from tests.systems.soft_body.causes import ANY_BODY, CAUSES
from tests.systems.test_soft_body import held_beam, held_run

CELLS = (4, 1, 1)
SMOOTH = [e for e in ANY_BODY if e.smooth]
AIR = [e for e in SMOOTH if e.kind != "actuator" and e.name != "delay"]
NOISE = WhiteNoise([Channel(c, "m", "position", sd=1e-3) for c in "xyz"])


def record(until_s=0.15, **command):
    time = np.arange(0.0, until_s + 1e-9, 0.01)
    values = {name: signal(time) for name, signal in command.items()}
    return Run("a", time, np.zeros((len(time), 3)), values, "g", order=2)


SWAY = {
    "support_x_m": lambda time: 1e-3 * np.sin(30.0 * time),
    "support_z_m": lambda time: 5e-4 * np.sin(25.0 * time),
}
FREE = record(**SWAY)
PULLED = record(shortening=lambda time: 0.03 * np.sin(2 * np.pi * 3.0 * time) ** 2)


def beam(**changes):
    given = released_bar(**{"cells": CELLS, "dt_s": 8e-3, "rtol": 1e-11} | changes)
    late = {"clock": {"offset": {"value": 0.0, "sd": 3e-3, "per": "run"}}}
    return model_of(given | late, FREE)


def tendon(**changes):
    given = pulled_bar(**{"cells": (4, 1, 2), "dt_s": 8e-3, "rtol": 1e-11} | changes)
    return model_of(given, PULLED)


def problem_of(model, run, *effects):
    return Problem(model, (run,), NOISE, effects, Jacobian(step=2e-3))


def assert_alike(problem, x, rtol=1e-4):
    residual, found = problem.linearize(x)
    simulated = replace(problem, jacobian=Jacobian(method="differences", step=2e-3))
    expected_residual, expected = simulated.linearize(x)
    np.testing.assert_allclose(residual, expected_residual, atol=1e-6)
    for k, name in enumerate(problem.names):
        error = np.linalg.norm(found[:, k] - expected[:, k])
        assert error <= rtol * np.linalg.norm(expected[:, k]) + 1e-9, name


def simulations(monkeypatch):
    """Counts scenes that are simulated as a whole."""
    count = []
    simulate = SoftModel.simulate_scenes

    def counted(self, scenes):
        count.extend(scenes)
        return simulate(self, scenes)

    monkeypatch.setattr(SoftModel, "simulate_scenes", counted)
    return count


@pytest.mark.parametrize("integrator", ["bdf2", "implicit_midpoint"])
def test_every_effect_at_zero(integrator, monkeypatch):
    count = simulations(monkeypatch)
    effects = AIR if integrator == "bdf2" else AIR[:3]
    problem = problem_of(beam(integrator=integrator), FREE, *effects)
    x = np.zeros(len(problem.names))
    problem.linearize(x)
    assert not count  # no column is simulated
    assert_alike(problem, x)


def test_effects_that_act():
    """Forces that remember, of the speed and of the material, at sizes that matter."""
    problem = problem_of(beam(), FREE, *AIR)
    x = np.array([0.3 if n.split(".")[0] in ACTING else 0.0 for n in problem.names])
    assert_alike(problem, x)


ACTING = (
    "support_motion",
    "loss_factor",
    "stiffening",
    "linear_drag",
    "dry_friction",
    "tilt",
    "clock_offset@a",
)


def test_solids_that_differ_by_a_factor_share_one_evaluation(monkeypatch):
    """Stiffness and the loss factor itself make a relaxing solid's force a multiple: each step asks
    once for the force and once for all directions."""
    calls = []
    ask = _Relaxation.__call__
    monkeypatch.setattr(_Relaxation, "__call__", lambda *a: calls.append(1) or ask(*a))
    loss = next(e for e in AIR if e.name == "loss_factor")
    problem = problem_of(beam(), FREE, loss)
    x = np.zeros(len(problem.names))
    x[-1] = 0.3
    problem.residual(x)
    once = len(calls)
    problem.linearize(x)
    assert len(calls) == 3 * once
    assert_alike(problem, x)


def test_tendon_from_equilibrium():
    """A command on its way through a lag, a start that depends on the material, no forces."""
    effects = tuple(e for e in SMOOTH if e.name in ("lag", "weight", "sensor_scale", "delay"))
    late = CAUSES["delay"]
    for delay in (effects, (*(e for e in effects if e.name != "delay"), late)):
        problem = problem_of(tendon(), PULLED, *delay)
        x = np.zeros(len(problem.names))
        assert_alike(problem, x)


def test_tendon_in_water():
    """Drag, in a start that is sought with the forces and in the motion."""
    problem = problem_of(tendon(in_water=True), PULLED, CAUSES["linear_drag"])
    x = np.zeros(len(problem.names))
    x[-1] = 0.2
    assert_alike(problem, x)


def test_unknown_force():
    effect = unknown_force(3, 0.2)
    problem = problem_of(beam(), FREE, CAUSES["linear_drag"], effect)
    x = np.zeros(len(problem.names))
    x[3] = 0.3
    assert_alike(problem, x)


def test_knots_are_evaluated_at_once(monkeypatch):
    """What each gives alone: to the last bit from zero on, where an unknown cause is weighed."""
    effect = unknown_force(3, 0.2)
    problem = problem_of(beam(), FREE, CAUSES["linear_drag"], effect)
    x = np.zeros(len(problem.names))
    acting = x + 0.3 * np.arange(len(x))
    zero_at_once, at_once = problem.linearize(x)[1], problem.linearize(acting)[1]
    calls = []
    ask = _Knots.__call__
    monkeypatch.setattr(_Knots, "__call__", lambda *a: calls.append(1) or ask(*a))
    problem.residual(acting)
    once = len(calls)
    problem.linearize(acting)
    assert len(calls) <= 3 * once  # not once for each of eighteen lines
    monkeypatch.setattr(_Knots, "stacked_with", Force.stacked_with)
    np.testing.assert_array_equal(zero_at_once, problem.linearize(x)[1])
    columns = problem.linearize(acting)[1]
    np.testing.assert_allclose(at_once, columns, atol=1e-9 * np.abs(columns).max(), rtol=0)
    scene = problem.model.scene(FREE, torch.zeros(problem.num_base, dtype=torch.float64))
    size = torch.ones(len(effect.components), dtype=torch.float64)
    one = effect.apply(scene, size, FREE).makers[-1]()
    other = unknown_force(3, 0.3).apply(scene, size, FREE).makers[-1]()
    monkeypatch.undo()
    assert one.stacked_with([one]) is not None
    assert one.stacked_with([other]) is None
    assert one.stacked_with([CAUSES["dry_friction"].apply(scene, size, FREE).makers[-1]()]) is None


def test_lines_of_effects_share_one_plain_scene(monkeypatch):
    """Scenes are built once per point of the base parameters; no line gets another point's."""
    problem = problem_of(beam(), FREE, *AIR)
    x = np.full(len(problem.names), 0.1)
    shared = problem.linearize(x)[1]
    built = []
    make = SoftModel.scene

    def scene(self, run, q, *rest):
        built.append(q.numpy().tobytes())
        return make(self, run, q, *rest)

    monkeypatch.setattr(SoftModel, "scene", scene)
    problem.linearize(x)
    assert len(built) == len(set(built)) == 1 + 2 * problem.num_base
    monkeypatch.setattr(model, "_PlainScenes", Anew)
    monkeypatch.setattr(tangents, "_PhysicsRates", _each_alone(tangents._PhysicsRates))
    np.testing.assert_array_equal(shared, problem.linearize(x)[1])


class Anew(model._PlainScenes):
    """Every scene is built when it is asked for."""

    def __call__(self, q):
        self._made.clear()
        return super().__call__(q)


def _each_alone(rates):
    return lambda: lambda line: rates()(line)


def test_forces_of_time_after_a_catch():
    """After a slack string has caught its weight, a support's motion goes on where it was."""
    loaded = held_run(0.05)
    time = loaded.time_s
    run = replace(loaded, command={name: sway(time) for name, sway in SWAY.items()}, order=2)
    caught = replace(CAUSES["slack_string"], smooth=True)  # at sizes above zero it is
    problem = problem_of(held_beam(), run, CAUSES["support_motion"], caught)
    x = np.zeros(len(problem.names))
    x[problem.columns_of(CAUSES["support_motion"])[0]] = 0.5
    x[problem.columns_of(caught)[0]] = 0.5
    found, simulated = problem, replace(problem, jacobian=Jacobian(method="differences", step=2e-3))
    columns, expected = (p.linearize(x)[1] for p in (found, simulated))
    for name in ("support_motion.shift", "support_motion.turn"):
        k = problem.names.index(name)
        error = np.linalg.norm(columns[:, k] - expected[:, k])
        assert error <= 1e-4 * np.linalg.norm(expected[:, k]), name


def test_non_smooth_effects_are_simulated(monkeypatch):
    band = CAUSES["dead_band"]
    problem = problem_of(tendon(), PULLED, band)
    x = np.zeros(len(problem.names))
    count = simulations(monkeypatch)
    _, found = problem.linearize(x, screen=True)
    assert len(count) == 2  # here, and where the secant ends
    by_differences = replace(problem, jacobian=Jacobian(method="differences"))
    _, expected = by_differences.linearize(x, screen=True)
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


def remembering(scene, size, run):
    return scene.with_hook(lambda: OldHook(size[0]))


def test_hooks_and_observers_without_leading_axes():
    plain = beam()

    def build(values, run, numerics):
        scene = plain.build(values, run, numerics)
        nodes = [-1, -2]
        return scene.changed(observe=lambda x: x[nodes].mean(0) + values["place"], output_maps=())

    model = SoftModel(build, (*plain.base, Parameter("place", 0.0, 1e-3, "m")))
    old = replace(CAUSES["linear_drag"], typical=2e-3, apply=remembering)
    problem = problem_of(model, FREE, old, CAUSES["linear_drag"])
    x = np.zeros(len(problem.names))
    x[-2:] = 0.3
    assert_alike(problem, x)


def test_explicit_steps_fall_back_to_differences(monkeypatch):
    model = beam(integrator="semi_implicit_euler", dt_s=5e-5, cells=(2, 1, 1))
    problem = problem_of(model, record(0.02))
    count = simulations(monkeypatch)
    problem.linearize(np.zeros(len(problem.names)))
    assert len(count) == 1 + 2 * len(problem.names)


class _Endless(Force):
    """A force without an end, at any size but zero."""

    def __call__(self, scene, moment):
        return torch.full_like(moment.x, float("inf"))


def test_derivatives_that_leave_the_range_of_numbers_are_a_step_too_far():
    """A fit shortens its step then: a diagnosis ended with an error about an argument."""

    def apply(scene, size, run):
        return scene.changed(forces=(*scene.forces, ("", _Endless))) if bool(size.any()) else scene

    endless = replace(AIR[0], name="endless", components=("size",), apply=apply)
    problem = problem_of(beam(), FREE, endless)
    with pytest.raises(PredictionError, match="left the range of numbers at 0"):
        problem.linearize(np.zeros(len(problem.names)))
