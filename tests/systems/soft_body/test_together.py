"""Scenes that differ by their commands alone are simulated at once, and to the same numbers."""

import pytest
import torch

from diffsim.systems.soft_body import line
from labs.systems.beam import lab_beam
from labs.systems.beam_causes import (
    TENSION_BACKLASH,
    TENSION_DEAD_BAND,
    VOLUME_DRAG,
)
from labs.virtual import SoftBeamLab


@pytest.fixture(scope="module")
def bar():
    study = SoftBeamLab()(3)
    return lab_beam(study, cells=(4, 2, 1), dt_s=1e-2), study.fit_runs[0]


@pytest.fixture
def rollouts(monkeypatch):
    """Bodies in every rollout that was asked for."""
    seen = []
    true = line.soft.rollout

    def counted(body, state, *args, **kwargs):
        seen.append(state.x.shape[:-2].numel())
        return true(body, state, *args, **kwargs)

    monkeypatch.setattr(line.soft, "rollout", counted)
    return seen


def predicted(bar, effect, sizes):
    """At once, and one by one."""
    model, run = bar
    sizes = torch.tensor(sizes, dtype=torch.float64)[:, None]
    q = torch.zeros(len(sizes), len(model.base), dtype=torch.float64)
    with torch.no_grad():
        many = model.predict_many(run, q, {effect: sizes})
        single = [model.predict(run, x, {effect: s}) for x, s in zip(q, sizes, strict=True)]
    return many, torch.stack(single)


@pytest.mark.parametrize("effect", [TENSION_DEAD_BAND, TENSION_BACKLASH])
def test_commands_that_differ_share_a_rollout(bar, rollouts, effect):
    many, single = predicted(bar, effect, [0.01, 0.2, 0.6])
    assert rollouts[0] == 3 and rollouts[1:] == [1, 1, 1]
    assert (many[2] - many[0]).abs().max() > 1e-4  # the sizes do something
    torch.testing.assert_close(many, single, rtol=0.0, atol=1e-10)


def test_forces_and_other_bodies_are_simulated_apart(bar, rollouts):
    many, single = predicted(bar, VOLUME_DRAG, [100.0, 2000.0])
    assert set(rollouts) == {1}
    torch.testing.assert_close(many, single, rtol=0.0, atol=0.0)


def test_other_materials_are_simulated_apart(bar, rollouts):
    model, run = bar
    q = torch.zeros(2, len(model.base), dtype=torch.float64)
    q[1, 0] = 1.0
    with torch.no_grad():
        many = model.predict_many(run, q, {TENSION_DEAD_BAND: torch.full_like(q[:, :1], 0.1)})
    assert rollouts == [1, 1]
    assert (many[1] - many[0]).abs().max() > 1e-5
