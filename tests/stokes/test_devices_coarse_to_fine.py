"""Designs sampled on a coarser grid: same optimum, honest unit of the loss, resumable."""

import pickle
from dataclasses import replace

import pytest
import torch

from diffsim.core import open_executor
from diffsim.core.errors import DiffsimError
from diffsim.optim import Log
from diffsim.stokes import devices
from diffsim.stokes.devices.coarse_to_fine import unit_on_fine_grid
from diffsim.stokes.devices.sampling import DesignSamples, values
from tests.stokes.test_devices_optimize import Interrupted

F64 = torch.float64


def amplifiers():
    return devices.make("amplifier", 0.375), devices.make("amplifier", 0.25)


def samples_of(losses):
    return DesignSamples(torch.zeros(len(losses), 5, dtype=F64), losses, 0)


def test_amplifier_by_way_of_a_coarser_grid():
    device, coarse = amplifiers()
    best = devices.coarse_to_fine(
        device, coarse, 6, num_starts=2, num_checked=3, max_evaluations=30, progress=False
    )
    assert best.loss < 1e-3  # 1e-4 of a random design's mean is the aim of the full search
    stage = best.coarse
    assert stage is not None
    # all normalized losses are this grid's, in its unit
    assert device.value(best.x) == pytest.approx(best.loss * best.unit_loss, rel=1e-9)
    assert float(best.evaluation_losses[0]) == pytest.approx(
        device.value(best.start) / best.unit_loss, rel=1e-9
    )
    # the start is the best result of the coarse grid, judged on this one
    fine = torch.tensor([device.value(d.x) for d in stage.descents], dtype=F64)
    torch.testing.assert_close(stage.fine_losses, fine, rtol=1e-9, atol=0)
    assert torch.equal(best.start, stage.descents[int(fine.argmin())].x)
    assert float(best.evaluation_losses[0]) >= best.loss
    # samples belong to the coarse grid; their first ones were checked on both
    assert coarse.value(best.samples[4]) == pytest.approx(
        float(best.sample_losses[4]) * stage.unit_loss, rel=1e-9
    )
    assert device.value(best.samples[2]) == pytest.approx(float(stage.checked_fine[2]), rel=1e-9)
    # the true mean of all six lies within four standard errors
    true = sum(device.value(x) for x in best.samples) / 6
    assert 0.0 < stage.unit_error < 0.2 * best.unit_loss
    assert abs(best.unit_loss - true) < 4.0 * stage.unit_error


def test_unit_is_exact_where_nothing_is_left_to_chance():
    low = torch.tensor([1.0, 2.0, 4.0, 5.0], dtype=F64)
    high = torch.tensor([1.5, 1.0, 6.0, 4.5], dtype=F64)
    assert unit_on_fine_grid(samples_of(low), high) == pytest.approx((3.25, 0.0))  # all checked
    unit, error = unit_on_fine_grid(samples_of(low), 1.1 * low[:2])  # one ratio everywhere
    assert (unit, error) == pytest.approx((3.3, 0.0), abs=1e-12)
    unit, _ = unit_on_fine_grid(samples_of(low), torch.tensor([2.0, torch.inf, 8.0], dtype=F64))
    assert unit == pytest.approx(6.0)  # the one without flow is left out
    with pytest.raises(DiffsimError, match="only 1 of 2"):
        unit_on_fine_grid(samples_of(low), torch.tensor([2.0, torch.inf], dtype=F64))


def test_standard_error_of_the_unit_is_that_of_repeated_draws():
    generator = torch.Generator().manual_seed(0)
    off = []
    for _ in range(400):
        low = 1.0 + torch.rand(100, generator=generator, dtype=F64)
        high = low * (1.2 + 0.1 * torch.randn(100, generator=generator, dtype=F64))
        unit, error = unit_on_fine_grid(samples_of(low), high[:20])
        off.append((unit - float(high.mean())) / error)
    spread = torch.tensor(off).std().item()
    # 20 points estimate a scatter to 16 %, which widens the spread by a few per cent; 400 draws
    # measure it to 4 %
    assert spread == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("calls", [1, 4, 8])  # while judging, while improving, while checking
def test_interrupted_runs_go_on(tmp_path, calls):
    device, coarse = amplifiers()
    options = {"num_starts": 2, "max_evaluations": 4, "max_coarse_evaluations": 3}
    options |= {"num_checked": 3, "progress": False, "path": tmp_path / "progress.jsonl"}
    with pytest.raises(KeyboardInterrupt):
        devices.coarse_to_fine(Interrupted(device, calls), coarse, 4, **options)
    rest = Interrupted(device, 2 + 4 + 3 - calls)
    resumed = devices.coarse_to_fine(rest, Interrupted(coarse, 0), 4, **options)
    assert rest.left == 0
    whole = devices.coarse_to_fine(device, coarse, 4, **{**options, "path": None})
    assert torch.equal(resumed.evaluations, whole.evaluations)
    assert (resumed.loss, resumed.unit_loss) == (whole.loss, whole.unit_loss)
    # one more check costs one more flow
    more = Interrupted(device, 1)
    devices.coarse_to_fine(more, Interrupted(coarse, 0), 4, **{**options, "num_checked": 4})
    assert more.left == 0


def test_kept_losses_of_other_designs_are_not_mixed_up(tmp_path):
    device = devices.make("amplifier", 0.25)
    log = Log(tmp_path / "log.jsonl")
    designs = [device.sample(torch.Generator().manual_seed(k)) for k in range(3)]
    first = values(device, log, "improved", designs[:2], progress=False)
    again = values(Interrupted(device, 1), log, "improved", designs[::2], progress=False)
    assert float(again[0]) == float(first[0])
    assert float(again[1]) == device.value(designs[2])
    assert len(Log(tmp_path / "log.jsonl")["improved"]) == 3


def test_refuses_what_is_not_a_coarser_grid_of_the_same_device():
    device, coarse = amplifiers()
    with pytest.raises(ValueError, match="same device"):
        devices.coarse_to_fine(device, devices.make("gate", 0.1))
    with pytest.raises(ValueError, match="fewer cells"):
        devices.coarse_to_fine(coarse, device)
    with pytest.raises(ValueError, match=r"num_checked must lie in \[2, 10\], got 11"):
        devices.coarse_to_fine(device, coarse, num_checked=11)
    with pytest.raises(ValueError, match="num_starts must be at least 1"):
        devices.coarse_to_fine(device, coarse, num_starts=0)


def test_an_executor_changes_nothing(tmp_path):
    device, coarse = amplifiers()
    options = {"num_starts": 2, "num_checked": 2, "max_evaluations": 3, "progress": False}
    options |= {"max_coarse_evaluations": 4}
    alone = devices.coarse_to_fine(device, coarse, 5, seed=3, **options)
    with open_executor("processes:2") as workers:
        path = tmp_path / "progress.jsonl"
        found = devices.coarse_to_fine(
            device, coarse, 5, seed=3, path=path, executor=workers, **options
        )
    assert torch.equal(found.x, alone.x) and found.loss == alone.loss
    assert torch.equal(found.samples, alone.samples) and found.num_rejected == alone.num_rejected
    assert alone.coarse is not None and found.coarse is not None
    for one, other in zip(alone.coarse.descents, found.coarse.descents, strict=True):
        assert torch.equal(one.designs, other.designs) and torch.equal(one.losses, other.losses)

    # the log is whole: the same search goes on from it here, and computes nothing
    def forbidden(self, x):
        raise AssertionError("computed again")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(devices.Device, "value", forbidden)
        patch.setattr(devices.Device, "value_and_gradient", forbidden)
        again = devices.coarse_to_fine(device, coarse, 5, seed=3, path=path, **options)
    assert torch.equal(again.x, alone.x)


def test_a_device_of_ones_own_says_how_it_comes_to_a_worker():
    own = replace(amplifiers()[1], remake=None)
    with pytest.raises(TypeError, match="give it remake, a function of a module"):
        pickle.dumps(own)
