"""What the devices' pictures show: angles, speeds, both inlets at once, every position."""

import numpy as np
import pytest
import torch

from diffsim.stokes import devices
from diffsim.viz.device_evolution import draw_shapes, milestones
from tests.optional import needs
from tests.stokes.test_devices import made_up, some_design

needs("matplotlib")


F64 = torch.float64


def picture():
    from diffsim.viz import device_picture as picture

    return picture


def optimum_of(device, x):
    """As if L-BFGS had found x at once."""
    y = some_design(device, 1)
    return devices.Optimum(
        x=x, loss=0.5, start=y, samples=torch.stack([y, x]),
        sample_losses=torch.tensor([0.8, 1.2], dtype=F64), unit_loss=1.0,
        evaluations=torch.stack([y, x]), evaluation_losses=torch.tensor([0.8, 0.5], dtype=F64),
        num_rejected=0, seconds=1.0, message="made up",
    )  # fmt: skip


def test_colors_are_angles_to_the_wanted_direction():
    device = devices.make("gate", 0.1)
    grid = device.grid
    velocity = torch.zeros(1, *grid.node_shape, 3, dtype=F64)
    velocity[0, 1:, :, :, 0] = 2.0  # along x; at rest where x = 0
    velocity[0, -1, :, :, :] = torch.tensor([-1.0, 1.0, 0.0], dtype=F64)
    field = made_up(grid, torch.ones(grid.node_shape, dtype=F64), velocity)
    panel = picture()._slice(field, velocity[0], 0.5, (1.0, 1.0))
    np.testing.assert_allclose(panel["color"][1:-1], 45.0)
    np.testing.assert_allclose(panel["color"][-1], 90.0)
    assert np.isnan(panel["color"][0]).all()
    speeds = picture()._slice(field, velocity[0], 0.5, None)["color"]
    np.testing.assert_allclose(speeds[1:-1], 2.0)


def test_third_panel_is_the_flow_of_both_inlets():
    device = devices.make("gate", 0.2)
    x = some_design(device)
    cases = picture()._cases(device, device.solve(x))
    assert [c[2] for c in cases] == [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)]
    half = {n: v.mean(0, keepdim=True) for n, v in device.states[0].inlet.items()}
    both = device.flow(device.level_set(x), inlet=half).velocity[0]
    torch.testing.assert_close(cases[2][1], both, rtol=0, atol=1e-7)  # condition 1e8


@pytest.mark.parametrize(
    ("name", "titles"),
    [
        ("amplifier", [""]),
        ("averager", ["lower inlet", "upper inlet", "both, half each"]),
        ("twister", ["height 0.75", "height 0.375", "height 0"]),
        ("switch", ["on", "off"]),
    ],
)
def test_panels(name, titles):
    device = devices.make(name, 0.2)
    module = picture()
    assert list(module._panels(device, module._flows(device, some_design(device)))) == titles


# of a switch and of two inlets tests/stokes/test_devices_export.py has pictures
@pytest.mark.parametrize(
    "name",
    [
        "amplifier",
        "twister",
        *(pytest.param(n, marks=pytest.mark.story) for n in ("averager", "switch")),
    ],
)
def test_pictures(tmp_path, name):
    device = devices.make(name, 0.2)
    x = some_design(device)
    module = picture()
    path = module.draw(device, optimum_of(device, x), tmp_path / "flow.png")
    assert path.stat().st_size > 10_000
    shapes = draw_shapes(device, optimum_of(device, x), tmp_path / "shapes.png")
    assert shapes.stat().st_size > 5_000


def test_milestones_are_designs_better_than_all_before():
    device, coarse = devices.make("amplifier", 0.375), devices.make("amplifier", 0.25)
    best = devices.coarse_to_fine(
        device, coarse, 3, num_starts=2, num_checked=2, max_evaluations=5,
        max_coarse_evaluations=6, progress=False,
    )  # fmt: skip
    way = milestones(best, 20)
    descent = best.coarse.descents[int(best.coarse.fine_losses.argmin())]
    assert way[0][0] == 1
    assert torch.equal(way[0][2], descent.designs[0])
    assert torch.equal(way[-1][2], best.x)
    assert way[-1][1] == pytest.approx(best.loss)
    numbers = [n for n, _, _ in way]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] <= len(descent.losses) + len(best.evaluations)
    fine = [loss for n, loss, _ in way if n > len(descent.losses)]
    assert fine == sorted(fine, reverse=True)
    assert [n for n, _, _ in milestones(best, 2)] == [numbers[0], numbers[-1]]
    with pytest.raises(ValueError, match="count must be at least 2"):
        milestones(best, 1)
