"""The search for designs: reaches the amplifier's optimum, goes on where it was interrupted."""

import dataclasses
import json

import pytest
import torch

from diffsim.cli.main import main
from diffsim.stokes import devices
from diffsim.stokes.devices.losses import area, mean_velocity


def test_amplifier_amplifies_three_times(tmp_path):
    device = devices.make("amplifier", 0.5)
    best = devices.optimize(device, 6, seed=0, progress=False)
    assert best.loss < 1e-4  # the thesis reaches 1.7e-5 with 10 samples on 64 x 48 cells
    assert best.loss < 1e-2 * float(best.sample_losses.min())
    assert float(best.sample_losses.mean()) == pytest.approx(1.0)
    assert bool((best.x >= device.lower).all() and (best.x <= device.upper).all())
    flow = device.solve(best.x)
    # a loss of 1e-4 times the unit of a few m^2/s^2
    assert float(mean_velocity(flow, ["x+"])[0, 0]) == pytest.approx(3.0, abs=0.03)
    assert float(area(flow, ["x+"])) == pytest.approx(0.25, abs=0.003)


class Interrupted:
    """A device whose evaluations end after some calls, as by Ctrl-C."""

    def __init__(self, device: devices.Device, calls: int):
        self.device, self.left = device, calls

    def __getattr__(self, name):
        return getattr(self.device, name)

    @property
    def __class__(self):
        return type(self.device)

    def value(self, x):
        self._count()
        return self.device.value(x)

    def value_and_gradient(self, x):
        self._count()
        return self.device.value_and_gradient(x)

    def _count(self):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1


def test_progress_of_an_older_version_is_refused(tmp_path):
    path = tmp_path / "progress.json"
    path.write_text(json.dumps({"settings": {"device": "amplifier"}, "samples": []}, indent=2))
    with pytest.raises(ValueError, match="older version"):
        devices.optimize(devices.make("amplifier", 0.25), 2, path=path, progress=False)


@pytest.mark.parametrize("calls", [2, 7])  # while sampling, while improving
def test_interrupted_runs_go_on(tmp_path, calls):
    device = devices.make("amplifier", 0.25)
    options = {"seed": 3, "max_evaluations": 8, "progress": False}
    whole = devices.optimize(device, 4, **options)
    path = tmp_path / "progress.jsonl"
    stopped = Interrupted(device, calls)
    with pytest.raises(KeyboardInterrupt):
        devices.optimize(stopped, 4, path=path, **options)
    assert len(path.read_text().splitlines()) == 1 + calls  # a header, and a line per flow
    rest = Interrupted(device, 4 + len(whole.evaluations) - calls)  # not one more
    resumed = devices.optimize(rest, 4, path=path, **options)
    assert rest.left == 0
    assert torch.equal(resumed.evaluations, whole.evaluations)
    assert torch.equal(resumed.x, whole.x)
    assert resumed.loss == whole.loss
    with pytest.raises(ValueError, match="belongs to another run"):
        devices.optimize(device, 5, path=path, **options)


def test_designs_without_flow_are_drawn_again_and_avoided():
    device = devices.make("amplifier", 0.25)
    walls = device.states[0].shape

    def no_narrow_ones(x):
        if float(x[4]) > 0.36:
            raise ValueError("closed")
        return walls(x)

    state = dataclasses.replace(device.states[0], shape=no_narrow_ones)
    fussy = dataclasses.replace(device, states=(state,))
    best = devices.optimize(fussy, 6, seed=1, max_evaluations=15, progress=False)
    assert best.num_rejected > 0
    assert bool((best.samples[:, 4] <= 0.36).all())
    assert float(best.x[4]) <= 0.36
    assert best.loss <= float(best.sample_losses.min())


def test_command_line_writes_numbers_and_picture(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    amplifier = ["devices", "amplifier", "--resolution", "0.25", "--out", str(tmp_path)]
    assert main([*amplifier, "--samples", "2", "--evaluations", "3"]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert len(result["design"]) == 5
    assert result["evaluations"] == 3
    assert (tmp_path / "flow.png").stat().st_size > 10_000
    assert "loss in the thesis" in capsys.readouterr().out
    (tmp_path / "progress.json").write_text("{}")  # as earlier versions kept
    assert main([*amplifier, "--samples", "3"]) == 2
    captured = capsys.readouterr()
    assert "belongs to another run" in captured.err
    assert "progress.json is of an older version" in captured.out
    assert main(["devices", "gate", "--no-slip"]) == 2
