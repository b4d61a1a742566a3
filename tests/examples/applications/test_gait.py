"""Signals and measures of gaits, and what optimizing them needs."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from diffsim.systems import robots
from examples.applications import Evaluation, Parameters, minimize, random_losses, solver_options
from examples.applications.gait import _measure_turn, gait, lines_between_knots, sinusoid
from tests.examples.applications.test_applications import made


def test_sinusoid_bends_fronts_and_backs_against_each_other():
    dt, values = 0.01, torch.tensor([0.5, 0.2, 4.0], dtype=torch.float64)
    found = sinusoid(dt, 25)(values)
    time = dt * torch.arange(1, 26, dtype=torch.float64)
    torch.testing.assert_close(found[:, 0], 0.5 * torch.sin(2.0 * math.pi * 4.0 * time))
    torch.testing.assert_close(found[:, 1], -0.4 * found[:, 0])
    assert torch.autograd.gradcheck(sinusoid(dt, 25), values.requires_grad_())


def test_lines_run_through_the_knots():
    knots = torch.from_numpy(np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3)))
    found = lines_between_knots(5, 41)(knots.flatten())
    torch.testing.assert_close(found[::10], knots)
    torch.testing.assert_close(found[5], 0.5 * (knots[0] + knots[1]))


def test_turns_are_counted_beyond_a_full_one():
    angle = torch.linspace(0.0, 3.5 * math.pi, 50, dtype=torch.float64)
    attitude = torch.zeros(50, 3, 3, dtype=torch.float64)
    attitude[:, 0, 2], attitude[:, 2, 2] = torch.sin(angle), torch.cos(angle)
    assert _measure_turn(attitude) == pytest.approx(630.0)
    assert _measure_turn(attitude.flip(0)) == pytest.approx(-630.0)


def test_scale_sets_the_first_step():
    """The first step of L-BFGS-B is the slope over the scale, in parameters from 0 to 1."""
    steps = []
    for scale in (1.0, 2.0):
        found = minimize(dataclasses.replace(made(), scale=scale), max_evaluations=2)
        first, second = (
            made().parameters.scaled(np.array(e.values)) for e in found.evaluations[:2]
        )
        steps.append(second - first)
    assert np.linalg.norm(steps[0]) > 0.0
    assert steps[0] == pytest.approx(2.0 * steps[1], rel=1e-6)


def test_starts_that_were_tried_are_the_random_sample():
    tried = [
        Evaluation(
            values=[], loss=loss, gradient=[], forward_s=0, backward_s=0, forward_cpu_s=0,
            backward_cpu_s=0,
        )
        for loss in (1.0, 2.0, math.inf)
    ]  # fmt: skip
    assert random_losses(made(), count=3, tried=tried) == [1.0, 2.0]
    assert len(random_losses(made(), count=4, tried=tried)) == 4


def test_loss_is_the_mean_over_versions_of_the_robot():
    def version(dt):
        robot = robots.quadruped(coarse=True, dt=dt, per_muscle=False, youngs_modulus=3e5)
        return robot, sinusoid(dt, round(0.04 / dt))

    def made(first, also=()):
        return gait(
            first[0],
            solver_options("projective_dynamics", rtol=1e-6),
            Parameters(names=("front", "back", "Hz"), lower=[0] * 3, upper=[9] * 3, first=[1] * 3),
            first[1],
            title="",
            source="",
            scale=1.0,
            also=also,
        )

    values = torch.tensor([0.9, 0.1, 7.0], dtype=torch.float64)
    coarse, fine = version(0.02), version(0.01)
    apart = [made(one) for one in (coarse, fine)]
    losses = [float(one.loss(values, one.simulate(values))) for one in apart]
    both = made(coarse, [fine])
    assert losses[0] != losses[1]
    mean = float(both.loss(values, both.simulate(values)))
    assert mean == pytest.approx(sum(losses) / 2.0, rel=1e-9)
