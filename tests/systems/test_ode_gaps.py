"""A held command that changed while rows were lost: a nuisance of the run, no cause."""

import numpy as np
import pytest
import torch

from diffsim.causes.signals import Grid
from diffsim.data.study import Run
from diffsim.diagnose import diagnose
from diffsim.systems.ode.gaps import find_gaps
from diffsim.systems.registry import setup_of
from tests.systems.sound_pendulum import pendulum_study


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_is_missing_from_a_sound_pendulum_with_lost_rows(seed):
    """Without the nuisance both were "unknown": a jump comes up to 20 ms late."""
    study = pendulum_study(seed=seed)
    setup = setup_of(study)
    assert any("change_in_gap" in p.name for p in setup.model.base)
    report = diagnose(
        study, setup.model, setup.effects, seed=0, unknowns=setup.unknowns, settings=setup.settings
    )
    assert report.verdict == "none"


def test_without_lost_rows_there_is_no_nuisance():
    names = [p.name for p in setup_of(pendulum_study(lost=0.0, seed=1)).model.base]
    assert not any("change_in_gap" in name for name in names)


def _run(time, command):
    return Run("a", time, np.zeros((len(time), 1)), {"u": command}, "a")


def test_a_command_that_moves_on_goes_on_in_a_gap():
    """It was held over the gap: of 2 % lost rows a null had "dead band", 1.3 times the noise."""
    whole = np.arange(0.0, 2.0, 0.01)
    time = np.delete(whole, [50, 120])
    run = _run(time, np.sin(3.0 * time))
    gaps = find_gaps(run, ["u"])
    assert [gap.swept for gap in gaps] == [1, 1]
    grid = Grid.of(time, 0.01)
    seen = grid.resampled(run.command["u"], held=True)
    for gap in gaps:
        seen = gap.change(seen, grid, {})
    assert grid.times.numpy() == pytest.approx(whole)
    assert seen.numpy() == pytest.approx(np.sin(3.0 * whole), abs=5e-4)
    assert not find_gaps(_run(time, np.ones(len(time))), ["u"])


def test_a_command_that_rests_jumped_in_a_gap():
    time = np.delete(np.arange(0.0, 2.0, 0.01), [50, 120])
    jumps = np.where(time > 0.5, 1.0, 0.0)
    (gap,) = find_gaps(_run(time, jumps), ["u"])
    assert (gap.start, gap.end) == pytest.approx((0.49, 0.51))


def test_a_change_inside_a_gap_keeps_its_area():
    time = np.array([0.0, 0.1, 0.2, 0.6, 0.7, 0.8])
    run = _run(time, np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0]))
    (gap,) = find_gaps(run, ["u"])
    grid = Grid.of(time, 0.1)
    held = grid.resampled(run.command["u"], held=True)
    share = torch.tensor([0.0, 0.3, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    changed = gap.change(held, grid, {gap.name: share})
    steps = grid.times.diff()
    area = (changed[:, :-1] * steps).sum(1)
    until = 0.2 + 0.4 * share.detach()
    torch.testing.assert_close(area.detach(), until + 3.0 * (0.8 - until))
    torch.testing.assert_close(changed[3].detach(), held)
    area.sum().backward()
    torch.testing.assert_close(share.grad[1], torch.tensor(-0.8, dtype=torch.float64))


def test_the_first_part_of_a_run_ends_before_its_gap():
    time = np.array([0.0, 0.1, 0.2, 0.6, 0.7, 0.8])
    (gap,) = find_gaps(_run(time, np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])), ["u"])
    short = Grid.of(time[:3], 0.1)
    held = torch.ones(3, dtype=torch.float64)
    share = torch.tensor(0.5, dtype=torch.float64)
    assert torch.equal(gap.change(held, short, {gap.name: share}), held)
