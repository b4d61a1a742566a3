"""Gate of gradients: wrong ones are seen, sound ones are not doubted, and it costs little."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.diagnose.checks import gradients
from diffsim.diagnose.checks.gradients import LEFT_OUT, gradient_gate
from diffsim.identify import Jacobian
from diffsim.identify.model import TOGETHER
from diffsim.identify.problem import BACKWARD
from tests.diagnose import linear


@pytest.mark.grad
@pytest.mark.parametrize("method", ["differences", "forward_mode"])
def test_gradient_gate_passes_and_sees_a_wrong_gradient(method):
    pull = linear.line("pull")

    def wrong(scene, size, run):
        scene = pull.apply(scene, size, run)
        # same value, 1 % more slope
        more = 0.01 * (linear.shapes("pull", run) @ (size - size.detach()))
        return replace(scene, record=scene.record + more)

    right = (linear.line("push"), *(linear.line(f"more {i}") for i in range(8)))
    effects = (*right, replace(pull, apply=wrong))
    problem, x = linear.problem(effects), np.zeros(12)
    problem = replace(problem, jacobian=Jacobian(method=method))
    at = problem, x, *problem.linearize(x)
    gates = {g.name: g for g in gradient_gate(*at)}
    assert not gates.pop("gradient:pull").passed
    assert all(g.passed and g.value == 0.0 for g in gates.values()) and len(gates) == 9


@pytest.mark.grad
def test_sound_gradients_are_checked_by_three_simulations_of_a_run():
    effects = tuple(linear.line(f"push {i}") for i in range(8))
    problem = replace(linear.problem(effects), jacobian=Jacobian(method="forward_mode"))
    at = problem, np.zeros(10), *problem.linearize(np.zeros(10))
    before = problem.model.simulations.count
    assert all(g.passed for g in gradient_gate(*at))
    # one to see whether there is a gradient, one for the adjoint, three for the direction
    assert problem.model.simulations.count - before == 1 + len(problem.runs) * 4


class Exact(torch.autograd.Function):
    """A response whose forward mode is exact, and whose values carry a solver's tolerance."""

    @staticmethod
    def forward(size, curvature, tolerance):
        value = size + curvature * size**4
        # rounded like an iterative solve that stops early: a step, never in the slope
        return value + tolerance * torch.sin(1e6 * size.detach())

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(inputs[0])
        ctx.save_for_forward(inputs[0])
        ctx.curvature = inputs[1]

    @staticmethod
    def backward(ctx, grad):
        (size,) = ctx.saved_tensors
        return grad * (1.0 + 4.0 * ctx.curvature * size**3), None, None

    @staticmethod
    def jvp(ctx, grad, *_):
        (size,) = ctx.saved_tensors
        return grad * (1.0 + 4.0 * ctx.curvature * size**3)


def bent(name, curvature=0.0, tolerance=0.0):
    def apply(scene, size, run):
        moved = linear.shapes(name, run)[..., 0] * Exact.apply(size, curvature, tolerance)[0]
        return replace(scene, record=scene.record + moved)

    return replace(linear.line(name), apply=apply)


@pytest.mark.grad
@pytest.mark.parametrize(
    ("curvature", "tolerance"), [(2e4, 0.0), (0.0, 2e-7)], ids=["curved", "tolerance"]
)
def test_sound_gradients_are_not_doubted_for_the_errors_of_differences(curvature, tolerance):
    """One length of differences is wrong by more than a slope may be; another is not."""
    effects = tuple(bent(f"push {i}", curvature, tolerance) for i in range(8))
    problem = replace(linear.problem(effects), jacobian=Jacobian(method="forward_mode"))
    at = problem, np.zeros(10), *problem.linearize(np.zeros(10))
    before = problem.model.simulations.count
    gates = gradient_gate(*at)
    assert all(g.passed for g in gates) and len(gates) == 8
    # three lengths of one direction at most; effect by effect it would be 80 simulations a run
    assert problem.model.simulations.count - before <= 1 + len(problem.runs) * (1 + 9)


@pytest.mark.grad
def test_what_a_spent_budget_leaves_out_is_said():
    pull = linear.line("pull")

    def wrong(scene, size, run):
        more = 0.01 * (linear.shapes("pull", run) @ (size - size.detach()))
        scene = pull.apply(scene, size, run)
        return replace(scene, record=scene.record + more)

    effects = (linear.line("push"), replace(pull, apply=wrong))
    problem = replace(linear.problem(effects), jacobian=Jacobian(method="forward_mode"))
    at = problem, np.zeros(4), *problem.linearize(np.zeros(4))
    (gate,) = gradient_gate(*at, steps=0.0)
    assert gate.name == LEFT_OUT and not gate.applies and "push, pull" in gate.note
    named = {g.name: g.passed for g in gradient_gate(*at)}
    assert named == {"gradient:push": True, "gradient:pull": False}


def many_runs(effects, count=12):
    """Slopes of a problem with many runs, by forward mode."""
    runs = [linear.run(f"r{i}", i) for i in range(count)]
    problem = replace(linear.problem(effects, runs), jacobian=Jacobian(method="forward_mode"))
    x = np.zeros(problem.num_base + len(effects))
    return problem, x, *problem.linearize(x)


def steeper(effect):
    """The same values, and 1 % more slope."""

    def apply(scene, size, run):
        more = 0.01 * (linear.shapes(effect.name, run) @ (size - size.detach()))
        scene = effect.apply(scene, size, run)
        return replace(scene, record=scene.record + more)

    return replace(effect, apply=apply)


@pytest.mark.grad
def test_one_run_of_many_shows_a_wrong_gradient_within_a_small_budget():
    at = many_runs((linear.line("push"), steeper(linear.line("pull"))))
    simulations = at[0].model.simulations
    before = simulations.count
    gates = {g.name: g for g in gradient_gate(*at, steps=1.0)}
    # is there a gradient, the adjoint of one run; then nothing else is begun but a direction
    assert simulations.count - before <= 1 + 1 + 9
    assert gates[LEFT_OUT].note.startswith("of push, pull")
    gates = {g.name: g for g in gradient_gate(*at)}
    assert gates["gradient:push"].passed and not gates["gradient:pull"].passed
    assert "of 12 runs" not in gates["gradient:pull"].note


@pytest.mark.grad
def test_runs_that_show_every_effect_come_first(monkeypatch):
    """An effect that acts in one run of twelve is checked, though the budget is for two."""

    def only_in_r9(scene, size, run):
        there = 1.0 if run.name == "r9" else 0.0
        shape = there * linear.shapes("rare", run)[..., 0]
        more = 0.01 * shape * (size - size.detach())
        return replace(scene, record=scene.record + shape * size + more)

    rare = replace(linear.line("rare"), apply=only_in_r9)
    at = many_runs((linear.line("push"), linear.line("pull"), rare))
    # whether there is a gradient costs a prediction of a run; an adjoint one and a backward pass
    one, adjoint = at[0].cost() / 12, 2.0 + TOGETHER * BACKWARD
    monkeypatch.setattr(gradients, "ADJOINT_SHARE", 0.01)
    gates = {g.name: g for g in gradient_gate(*at, steps=200.0 * adjoint * one)}
    assert not gates["gradient:rare"].passed
    assert gates["gradient:rare"].note.endswith("2 of 12 runs")


@pytest.mark.grad
def test_effects_with_kinks_are_not_compared():
    kinked = replace(linear.line("stick"), smooth=False)
    problem = linear.problem((linear.line("push"), kinked))
    at = problem, np.zeros(4), *problem.linearize(np.zeros(4))
    assert [g.name for g in gradient_gate(*at)] == ["gradient:push"]


@pytest.mark.grad
@pytest.mark.parametrize("bend", [0.02, 2e-3, 2e-4])
def test_a_sharply_bent_response_is_followed_up_with_shorter_steps(bend):
    """Differences of slopes that are themselves differences: both are too long at first."""

    def friction(scene, size, run):
        moved = linear.shapes("drag", run)[..., 0] * bend * torch.tanh(size[0] / bend)
        return replace(scene, record=scene.record + moved)

    drag = replace(linear.line("drag"), apply=friction)
    problem = linear.problem((linear.line("push"), drag))
    at = problem, np.zeros(4), *problem.linearize(np.zeros(4))
    assert all(g.passed for g in gradient_gate(*at))
