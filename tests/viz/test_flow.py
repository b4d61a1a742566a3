"""Pictures and scenes of flows: they draw, and refuse what they cannot draw."""

import pytest
import torch

from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid
from diffsim.viz import flow
from diffsim.viz.flow_scene import write_rerun
from tests.optional import needs

needs("matplotlib")


def channel(dim, size=2.0):
    """Parabolic flow along x, without a solve."""
    grid = Grid((12, *[8] * (dim - 1)), size=(size, *[0.5 * size] * (dim - 1)))
    away = (grid.nodes[..., 1:] - 0.25 * size).norm(dim=-1)
    phi = 0.2 * size - away
    velocity = torch.zeros(2, *grid.node_shape, dim, dtype=torch.float64)
    velocity[0, ..., 0] = (1.0 - (away / (0.2 * size)) ** 2).clamp(min=0.0)
    velocity[1] = 2.0 * velocity[0]
    zero = torch.zeros(2, *grid.shape, dtype=torch.float64)
    return FlowField(grid, phi, velocity, zero, torch.ones(grid.shape, dtype=torch.float64), {})


def test_speed_map_shows_speed_lines_and_wall(tmp_path):
    field = channel(2, size=2e-3)
    figure = flow.speed_map(field, title="channel", lines=5)
    ax, bar = figure.axes
    assert ax.get_title(loc="left") == "channel"
    assert ax.get_xlabel() == "x [mm]" and bar.get_ylabel() == "speed [m/s]"
    assert len(ax.lines) == 5
    assert 0.9 < ax.images[0].get_clim()[1] <= 1.0
    assert flow.speed_map(field, case=1, lines=0).axes[0].images[0].get_clim()[1] > 1.8
    assert flow.save(figure, tmp_path / "new" / "a.png").stat().st_size > 5000
    with pytest.raises(ValueError, match=r"\.png, \.svg or \.pdf"):
        flow.save(figure, tmp_path / "a.jpg")


def test_panels_share_a_color_scale():
    figure = flow.compare([("initial", channel(2)), ("optimized", channel(2))], case=1)
    first, second, _ = figure.axes
    assert first.images[0].get_clim() == second.images[0].get_clim()
    assert [ax.get_title(loc="left") for ax in (first, second)] == ["initial", "optimized"]


def test_slices_and_view_of_three_dimensions(tmp_path):
    field = channel(3)
    figure = flow.slices(field, title="tube")
    titles = [ax.get_title(loc="left") for ax in figure.axes[:3]]
    assert titles == ["z = 0.5 m", "y = 0.5 m", "x = 1 m"]
    assert [len(ax.collections) for ax in figure.axes[:3]].count(2) == 1  # no flow within x = 1
    flow.save(figure, tmp_path / "slices.png", dpi=50)
    figure = flow.view([("initial", field), ("optimized", field)], lines=6)
    flow.save(figure, tmp_path / "view.png", dpi=50)
    flow.save(flow.compare([("tube", field)], plane=("x", 1.0)), tmp_path / "plane.svg")


@pytest.mark.parametrize("size", [0.02, 2.0])
def test_short_sides_of_a_view_have_few_labels(size):
    """At any size: a side of 0.2 of the longest has its ends alone, others more."""
    grid = Grid((20, 10, 4), size=(size, 0.5 * size, 0.2 * size))
    away = (grid.nodes[..., 1:] - grid.nodes.new_tensor([0.25, 0.1]) * size).norm(dim=-1)
    velocity = torch.zeros(1, *grid.node_shape, 3, dtype=torch.float64)
    velocity[..., 0] = 1.0
    zero = torch.zeros(1, *grid.shape, dtype=torch.float64)
    open_ = torch.ones(grid.shape, dtype=torch.float64)
    field = FlowField(grid, 0.08 * size - away, velocity, zero, open_, {})
    ax = flow.view([("tube", field)], lines=2).axes[0]
    ticks = [
        len(a.get_major_locator().tick_values(0.0, 1.0)) for a in (ax.xaxis, ax.yaxis, ax.zaxis)
    ]
    assert ticks[0] == ticks[1] > 2 == ticks[2]


def test_wrong_arguments_say_what_to_do():
    with pytest.raises(ValueError, match="in 3D, got 2D"):
        flow.slices(channel(2))
    with pytest.raises(ValueError, match="in 3D, got 2D"):
        flow.view(channel(2))
    with pytest.raises(ValueError, match=r"plane must be an axis"):
        flow.slices(channel(3), [("w", 0.5)])
    with pytest.raises(ValueError, match=r"case must lie in \[0, 2\)"):
        flow.speed_map(channel(2), case=2)
    with pytest.raises(ValueError, match="at least one flow"):
        flow.compare([])
    with pytest.raises(TypeError, match="must be a FlowField"):
        flow.speed_map(torch.zeros(3))


@pytest.mark.parametrize("dim", [2, 3])
def test_rerun_scene(tmp_path, dim):
    pytest.importorskip("rerun")
    field = channel(dim)
    path = write_rerun(tmp_path / "new" / "flow.rrd", field, lines=4, num_arrows=50)
    content = path.read_bytes()
    assert content[:4] in (b"RRF2", b"RRIO") or content[:2] == b"RR"
    for name in (b"streamlines", b"arrows", b"wall", b"tracers", b"box"):
        assert name in content
    assert [p.name for p in path.parent.iterdir()] == ["flow.rrd"]
    with pytest.raises(ValueError, match=r"must end in \.rrd"):
        write_rerun(tmp_path / "flow.rr", field)
    with pytest.raises(TypeError, match="must be a FlowField"):
        write_rerun(tmp_path / "flow.rrd", None)
    if dim == 3:
        with pytest.raises(ValueError, match="height is for 2D"):
            write_rerun(tmp_path / "flow.rrd", field, height=1.0)
