"""An unknown force is as fast as what a fit leaves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.search.evidence import Hypothesis, LaplaceEvidence
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.bandwidth import FIRST, band_nats, num_cosines, num_cosines_of, octaves_of
from diffsim.systems.registry import setup_of

STEP = 0.01
MODEL = {
    "system": "ode",
    "parameters": {"M": 1.2, "c": 3.0},
    "inputs": [{"name": "force", "held": True}],
    "states": {"x": 0, "v": 0},
    "define": {"push": "force"},
    "rates": {"x": "v", "v": "(push - c*v)/M"},
    "readings": {"x": "x"},
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "M", "force": "push"}],
}
NOISE = 1e-3
CHANNELS = (Channel("x", "m", "position", NOISE),)


def cart(seconds):
    """A cart under a slow push, before anything is recorded."""
    t = STEP * np.arange(round(seconds / STEP))
    run = Run("a", t, np.zeros((len(t), 1)), {"force": np.sin(2.0 * t)}, "a")
    return Study("cart", "ode", CHANNELS, (run,), model=MODEL)


def under_force(frequency_Hz, seconds=6.0):
    """Problem of a cart that a hidden force shakes by four noise sd, and the generic force of its
    setup."""
    study = cart(seconds)
    setup = setup_of(study)
    (force,) = setup.unknowns
    fine = force.suited(1000).effect
    knots = np.linspace(0.0, seconds, len(fine.components))
    pulse = 2.0 * np.pi * frequency_Hz
    hidden = torch.from_numpy(1.2 * 4.0 * NOISE * pulse**2 * np.cos(pulse * knots))
    clean = setup.model.predict(study.runs[0], setup.model.at_prior(), {fine: hidden}).numpy()
    noise = NOISE * np.random.default_rng(0).normal(size=clean.shape)
    run = replace(study.runs[0], measured=clean + noise)
    return Problem(setup.model, (run,), WhiteNoise(CHANNELS)), force


def left_beside(problem, force):
    """Misfit of the plain model and of that with the force [noise variances per sample]."""
    x = np.zeros(len(problem.names))
    residual = problem.residual(x)
    jacobian = np.zeros((len(residual), len(x)))
    moved = force.responses(problem, x)
    evidence = LaplaceEvidence(problem, x, residual, jacobian, [moved], 1)
    beside = evidence.weigh(Hypothesis(frozenset(), 0))
    return residual @ residual / len(residual), beside.chi2 / len(residual)


def test_a_force_of_four_hertz_is_followed_over_six_seconds():
    """Forty knots, 0.15 s apart, leave most of it."""
    problem, force = under_force(4.0)
    count = num_cosines_of(problem, problem.residual(np.zeros(len(problem.names))))
    assert count == 64  # 48 half periods
    suited = force.suited(count)
    assert len(suited.effect.components) == 193 and suited.label != force.label
    plain, forty = left_beside(problem, force)
    _, followed = left_beside(problem, suited)
    assert plain > 3.0
    assert followed < 1.1
    assert forty > 0.9 * plain


def test_a_slow_force_has_few_knots_and_a_count_of_them_is_the_limit():
    problem, force = under_force(0.3)
    count = num_cosines_of(problem, problem.residual(np.zeros(len(problem.names))))
    assert count == 8 and len(force.suited(count).effect.components) == 25
    assert len(force.suited(1000).effect.components) == 200
    (short,) = setup_of(cart(0.6)).unknowns
    assert len(short.suited(1000).effect.components) == 30  # half of its samples


@pytest.mark.parametrize("stretch", [1.0, 2.0])
def test_bands_hold_what_stands_out_of_noise(stretch):
    """A cosine of the longest record is one of half the number in one half as long."""
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(400, 2))
    assert num_cosines(band_nats([octaves_of(noise, stretch)])) == FIRST
    course = np.cos(np.pi * 50.0 / stretch * np.arange(400)[:, None] / 400.0)
    nats = band_nats([octaves_of(noise + course, stretch)])
    assert num_cosines(nats) == 64
    assert nats.max() > 20.0
