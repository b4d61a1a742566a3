"""Are the gradients of L_theta and L_a those of differences, and does identification identify?"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Run
from diffsim.identify import Problem, WhiteNoise
from labs.loop.command import Command, Limits
from labs.loop.identification import FitSettings, correlation_length, identify, loss_of
from labs.loop.model import Starfish, as_displacements
from labs.loop.recordings import COMMAND
from labs.loop.trajectory import TrajectorySettings, optimize, travel_loss

CHANGED = {"youngs_modulus": 6e5, "drag_4": 2.6}
PULL = 0.005 * (1.0 - np.cos(2.0 * np.pi * np.arange(24) / 24))


@pytest.fixture(scope="module")
def precise() -> Starfish:
    return Starfish(rtol=1e-10)


@pytest.fixture(scope="module")
def guesses(precise) -> dict[str, float]:
    return {p.name: p.value for p in precise.parameters}


@pytest.fixture(scope="module")
def recorded(precise, guesses) -> Run:
    """What the model itself does with other parameters."""
    with torch.no_grad():
        places = precise.motion(guesses | CHANGED, torch.from_numpy(PULL)).numpy()
    return Run("run_0", np.arange(24) / 60.0, places[:, :-1], {COMMAND: PULL}, "run_0")


def test_gradient_of_the_identification_loss(recorded, precise):
    cut, channels = as_displacements(recorded, 0.4, 1e-3)
    sim = precise.fit_model(["run_0"])
    problem = Problem(sim, (cut,), WhiteNoise(channels))
    x = np.full(len(problem.names), 0.1)
    _, slope = problem.gradient(x)
    h = 1e-4
    for k in (0, 1, 4, 9):  # E, w, a point of C_d and of C_t
        step = h * np.eye(len(x))[k]
        ends = [0.5 * float(np.sum(problem.residual(x + s * step) ** 2)) for s in (1.0, -1.0)]
        assert slope[k] == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-3, abs=1e-5)


def test_gradient_of_the_travel(precise, guesses):
    period = torch.from_numpy(PULL + 1e-3).requires_grad_()
    (slope,) = torch.autograd.grad(travel_loss(precise, guesses, period, 1), period)
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(24, generator=generator, dtype=torch.float64)
    h = 1e-7
    with torch.no_grad():
        ends = [
            float(travel_loss(precise, guesses, period + s * h * direction, 1)) for s in (1, -1)
        ]
    assert float(slope @ direction) == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-3)


def test_identification_lowers_the_loss_towards_the_truth(recorded, guesses):
    model = Starfish(rtol=1e-6)
    settings = FitSettings(duration_s=0.3, sd_m=2e-4, method="gauss_newton", max_evaluations=4)
    found = identify(model, [recorded], settings)
    assert found.loss_after < 0.02 * found.loss_before
    assert found.loss_before == pytest.approx(loss_of(model, recorded, guesses, 0.3), rel=1e-9)
    ratio = found.values["youngs_modulus"] / found.values["axial_stiffness"]
    assert ratio == pytest.approx(6e5 / 300.0, rel=0.1)  # what bending tells: E over w
    i, j = found.names.index("youngs_modulus"), found.names.index("axial_stiffness")
    assert found.correlation[i][j] > 0.5  # and E and w trade off


def test_optimized_command_travels_farther_within_the_limits(guesses):
    limits = Limits(contraction_m=0.012, rate_m_s=0.15)
    settings = TrajectorySettings(periods=1, num_knots=12, max_evaluations=2)
    found = optimize(Starfish(), guesses, Command(PULL), limits, settings)
    found.command.check(limits)
    assert found.loss_after < found.loss_before - 2e-4


def test_a_recording_without_its_command_is_refused(recorded):
    with pytest.raises(ValueError, match=COMMAND):
        as_displacements(replace(recorded, command={}), 0.4, 1e-3)


def test_correlation_length_of_white_and_held_noise():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((4000, 8))
    assert correlation_length(white.ravel()) < 1.6
    held = np.repeat(white[:400], 10, axis=0)
    assert correlation_length(held.ravel()) == pytest.approx(10.0, rel=0.4)
