"""Every cause of every kind of system: nothing at size 0, something at its usual size, slopes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from diffsim.identify import Problem, WhiteNoise
from diffsim.systems.registry import setup_of
from tests.systems.soft_body import described as soft
from tests.systems.soft_body.test_instruments import bar as sensed_bar
from tests.systems.test_bench_description import bench
from tests.systems.test_unseen_runs import MADE, study_of

FALL = soft.run_of("heavy", np.arange(-1, 24) * 0.02, load_kg=0.03)
EXACT = {"time_step": 0.008, "correct_mesh": False, "tolerance": 1e-10}
MORE = {
    "bench": bench,
    "sensors of a soft body": lambda: sensed_bar(numerics=EXACT),
    "weight on a soft body": lambda: soft.study_of(soft.BAR, (FALL,), numerics=EXACT),
}
KINDS = (*MADE, *MORE)
#: what a study cannot show, and why
SILENT = {
    "rod": {"twist_stiffness": "its poses lie in a plane"},
    "rigid_body": dict.fromkeys(("rolling_resistance", "tangential_rebound"), "it never spins"),
}


@cache
def ready(kind):
    """A study and its setup, and what its channels predict without a cause, by run [noise sd]."""
    study = study_of(kind) if kind in MADE else MORE[kind]()
    runs = tuple(replace(run, order=k) for k, run in enumerate(study.runs, start=1))  # for drifts
    study = replace(study, runs=runs)
    setup = setup_of(study)
    study = setup.study or study
    with torch.no_grad():
        plain = [predict(study, setup, run) for run in study.runs]
    return study, setup, plain


def predict(study, setup, run, sizes=None):
    """Channels of a run in units of their noise."""
    sd = torch.tensor([c.sd or 1.0 for c in study.channels], dtype=torch.float64)
    return setup.model.predict(run, setup.model.at_prior(), sizes) / sd


def uniform(effect, share):
    """The same share of its usual size in every component."""
    return torch.full((len(effect.components),), share * effect.typical, dtype=torch.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cause_is_nothing_at_size_zero_and_something_at_its_usual_size(kind):
    study, setup, plain = ready(kind)
    assert len(setup.effects) > 8
    for effect in setup.effects:
        largest = 0.0  # in the first run that shows it
        for run, before in zip(study.runs, plain, strict=True):
            with torch.no_grad():
                none = predict(study, setup, run, {effect: uniform(effect, 0.0)})
                some = predict(study, setup, run, {effect: uniform(effect, 1.0)})
            torch.testing.assert_close(none, before, rtol=0, atol=1e-7, equal_nan=True)
            assert torch.equal(some.isfinite(), before.isfinite()), effect.name
            largest = max(largest, float((some - before).nan_to_num().abs().max()))
            if largest > 1e-2:
                break
        assert (largest > 1e-2) == (effect.name not in SILENT.get(kind, {})), (effect.name, largest)


def groups_of(kind, causes):
    """Causes that are differentiated together.

    Beside others tangents of a dynamic body are off by a percent (load_inertia), and its adjoint by
    seven (stiffness_loss beside stiffening).
    """
    if kind == "weight on a soft body":
        return [(cause,) for cause in causes]
    if kind == "sensors of a soft body":
        return [tuple(cause for cause in causes if "_of_" in cause.name)]
    return [causes]


# a simulator of one's own has no slopes, and the windows of a multicopter begin where its record
# says (tests/systems/test_multicopter.py)
@pytest.mark.grad
@pytest.mark.cpu(8)  # differences along every cause: 5 s of a soft body, beside others 9
@pytest.mark.parametrize("kind", [k for k in KINDS if k not in ("outside", "multicopter")])
def test_columns_of_parameters_and_smooth_causes_are_those_of_differences(kind):
    """At a third of the usual sizes: one-sided causes act there, and no delay is a whole sample."""
    study, setup, _ = ready(kind)
    channels = [c if c.sd is not None else replace(c, sd=1.0) for c in study.channels]
    smooth = tuple(e for e in setup.effects if e.smooth)
    for causes in groups_of(kind, smooth):
        problem = Problem(setup.model, study.runs[-1:], WhiteNoise(channels), causes)
        x = np.full(len(problem.names), 0.3)
        residual, columns = problem.linearize(x)
        _, gradient = problem.gradient(x)
        for i, name in enumerate(problem.names):
            step = np.eye(len(x))[i] * 1e-3
            slope = -(problem.residual(x + step) - problem.residual(x - step)) / 2e-3
            assert np.abs(columns[:, i] - slope).max() <= 2e-3 * np.abs(slope).max() + 1e-6, name
            reach = np.linalg.norm(residual) * np.linalg.norm(slope)
            assert abs(gradient[i] + columns[:, i] @ residual) <= 1e-3 * reach + 1e-6, name
