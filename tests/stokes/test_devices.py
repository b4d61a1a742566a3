"""The six fluidic devices: sizes, gradients of the whole chain, losses, symmetry, linearity."""

import math
import warnings
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from diffsim.stokes import StokesFlow, devices
from diffsim.stokes.devices import losses
from diffsim.stokes.devices.device import FAILURES, SOLVER
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid

F64 = torch.float64
# cells, parameters, wall, random designs of thesis table 4.5
TABLE = {
    "amplifier": ((64, 48), 5, "no_separation", 10),
    "averager": ((64, 64, 4), 8, "no_separation", 10),
    "funnel": ((64, 64, 16), 10, "no_separation", 10),
    "gate": ((64, 64, 4), 5, "no_separation", 10),
    "twister": ((64, 64, 32), 32, "no_separation", 100),
    "switch": ((64, 64, 32), 26, "no_slip", 100),
}


@pytest.fixture(autouse=True)
def _coarse():
    """Small grids do not resolve all random designs, and say so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def some_design(device: devices.Device, seed: int = 0) -> Tensor:
    """A design in the middle half of the bounds."""
    x = device.sample(torch.Generator().manual_seed(seed))
    return 0.5 * x + 0.25 * (device.lower + device.upper)


def made_up(grid: Grid, phi: Tensor, velocity: Tensor) -> FlowField:
    return FlowField(grid, phi, velocity, phi.new_zeros(1), phi.new_zeros(1), {})


@pytest.mark.parametrize("name", list(devices.DEVICES))
def test_sizes_are_those_of_the_thesis(name):
    device = devices.make(name)
    cells, parameters, wall, samples = TABLE[name]
    assert device.grid.shape == cells
    assert len(device.parameters) == parameters
    assert device.flow.wall == wall
    assert device.num_samples == samples
    assert len({p.name for p in device.parameters}) == parameters
    assert max(device.grid.spacing) == pytest.approx(min(device.grid.spacing))


@pytest.mark.grad
@pytest.mark.parametrize(
    ("name", "resolution", "options"),
    [
        ("amplifier", 0.5, {"objective": "average"}),
        ("averager", 0.25, {}),
        ("averager", 0.25, {"objective": "average"}),
        ("funnel", 0.2, {}),
        ("gate", 0.25, {}),
        ("twister", 0.2, {}),
        ("twister", 0.2, {"wall": "no_slip"}),
        ("switch", 0.2, {}),
        ("switch", 0.2, {"profile": "crossed"}),
    ],
)
def test_gradient_of_the_whole_chain(name, resolution, options):
    device = devices.make(name, resolution, **options)
    x = some_design(device)
    value, gradient = device.value_and_gradient(x)
    assert value == pytest.approx(device.value(x), rel=1e-12)
    generator = torch.Generator().manual_seed(1)
    along = torch.randn(len(x), generator=generator, dtype=F64)
    step = 1e-6
    slope = (device.value(x + step * along) - device.value(x - step * along)) / (2 * step)
    # rounding of a solution with condition 1e8 over the step, and curvature times the step
    assert float(gradient @ along) == pytest.approx(slope, rel=2e-4)


@pytest.mark.grad
@pytest.mark.parametrize("name", ["funnel", "twister"])
def test_the_loose_tolerance_of_large_devices_is_enough(name):
    """By the iteration of full grids, against the factor."""
    device = devices.make(name, 0.25)
    x = some_design(device)
    value, gradient = device.value_and_gradient(x)
    options = replace(SOLVER, method="iterative")
    flow = StokesFlow(device.grid, device.flow.boundary, wall=device.flow.wall, solver=options)
    loose, slope = replace(device, flow=flow).value_and_gradient(x)
    assert loose == pytest.approx(value, rel=1e-4) and loose != value
    assert float((slope - gradient).norm() / gradient.norm()) < 1e-3  # 4e-4; 5e-6 on full grids


@pytest.mark.grad
def test_gradient_of_the_amplifier_entry_by_entry():
    device = devices.make("amplifier")
    x = some_design(device)
    _, gradient = device.value_and_gradient(x)
    step = 1e-5
    for k, unit in enumerate(step * torch.eye(5, dtype=F64)):
        slope = (device.value(x + unit) - device.value(x - unit)) / (2 * step)
        # third derivatives, about 1e4 of the first ones, times 1e-10
        assert float(gradient[k]) == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", ["averager", "gate"])
def test_mirrored_inputs_are_equally_good(name):
    device = devices.make(name, 0.25)
    x = some_design(device)
    both = device.loss(x)
    (state,) = device.states
    for case in (0, 1):
        alone = {n: v[case : case + 1] for n, v in state.inlet.items()}
        field = device.flow(device.level_set(x), inlet=alone)
        if name == "gate":
            target = torch.eye(3, dtype=F64)[case]
            loss = losses.squared_difference(field, ["x+", "y+"], target)
        else:
            loss = state.loss(field)
        assert float(loss) == pytest.approx(float(both), rel=1e-7)


@pytest.mark.property
@pytest.mark.parametrize("name", ["funnel", "gate", "averager"])
@pytest.mark.parametrize("speeds", [(0.5, 0.5), (-0.3, 2.0)])
def test_flow_is_linear_in_the_inputs(name, speeds):
    device = devices.make(name, 0.2)
    x = some_design(device)
    first, second = device.solve(x).velocity
    mixed = {n: speeds[0] * v[:1] + speeds[1] * v[1:] for n, v in device.states[0].inlet.items()}
    velocity = device.flow(device.level_set(x), inlet=mixed).velocity[0]
    # solutions of one system with condition 1e8
    expected = speeds[0] * first + speeds[1] * second
    torch.testing.assert_close(velocity, expected, rtol=0, atol=1e-7)
    # the two cases are not alike: a mixture that ignored one would be seen
    assert float((velocity - speeds[0] * first).abs().max()) > 0.1


def test_closed_passages_are_refused():
    device = devices.make("averager", 0.5)
    # the left island reaches down into the lower wall, and up into the upper one
    x = torch.tensor([0.3, 0.49, 0.6, 0.49, 0.9, 0.45, 0.49, 0.01], dtype=F64)
    with pytest.raises(FAILURES):
        device.value(x)


def test_amplifier_through_a_straight_channel():
    device = devices.make("amplifier")
    x = torch.tensor([0.4, 0.125, 0.9, 0.125, 0.125], dtype=F64)
    field = device.solve(x)
    mean = losses.mean_velocity(field, ["x+"])[0]
    # nothing turns without friction: (1, 0) to the ratio of the viscosities, 1e-5
    torch.testing.assert_close(mean, torch.tensor([1.0, 0.0], dtype=F64), rtol=0, atol=1e-4)
    assert float(losses.area(field, ["x+"])) == pytest.approx(0.75, abs=1e-12)
    assert device.value(x) == pytest.approx(4.0, abs=1e-3)


def test_outlet_means_of_known_fields():
    grid = Grid((8, 10, 4), size=(1.0, 1.0, 0.5))
    x, y, z = grid.nodes.unbind(-1)
    phi = 0.63 - y  # fluid below; cuts cells of the outlet
    field = made_up(grid, phi, torch.stack([y, 2.0 + 0 * x, z], -1)[None])
    assert float(losses.area(field, ["x+"])) == pytest.approx(0.63 * 0.5, abs=1e-12)
    mean = losses.mean_velocity(field, ["x+"])[0]
    # bilinear values on cells cut by planes: exact
    expected = torch.tensor([0.315, 2.0, 0.25], dtype=F64)
    torch.testing.assert_close(mean, expected, rtol=0, atol=1e-12)
    lower = losses.mean_velocity(field, ["x+"], y < 10.0)[0]
    torch.testing.assert_close(lower, expected, rtol=0, atol=1e-12)
    difference = losses.squared_difference(field, ["x+"], field.velocity - 1.0)
    assert float(difference) == pytest.approx(3.0, abs=1e-12)


def test_angles_and_curl_of_known_fields():
    grid = Grid((6, 6, 3), size=(1.0, 1.0, 0.5))
    x, y, _ = grid.nodes.unbind(-1)
    phi, zero = torch.ones_like(x), torch.zeros_like(x)
    straight = torch.stack([zero + 1.0, zero, zero], -1)
    diagonal = torch.stack([zero + 1.0, zero + 1.0, zero], -1)
    field = made_up(grid, phi, torch.stack([straight, diagonal]))
    got = losses.angle_difference(field, ["x+", "y+"], math.pi / 4)
    # one case off by 45 degrees, one not at all; rounded off by 1e-3 rad
    assert float(got) == pytest.approx(math.pi / 8, abs=1e-3)
    spin = torch.stack([-3.0 * (y - 0.5), 3.0 * (x - 0.5), zero], -1)
    curl = losses.vertical_curl(made_up(grid, phi, spin[None]), "z-")
    torch.testing.assert_close(curl, torch.full((1, 6, 6), 6.0, dtype=F64))


def test_angle_of_resting_fluid_has_a_gradient():
    grid = Grid((2, 2, 2), size=1.0)
    velocity = torch.zeros(1, 3, 3, 3, 3, dtype=F64, requires_grad=True)
    field = made_up(grid, torch.ones(3, 3, 3, dtype=F64), velocity)
    (gradient,) = torch.autograd.grad(losses.angle_difference(field, ["x+"], 0.5), velocity)
    assert bool((gradient == 0).all())


def test_switch_turns_its_obstacle():
    device = devices.make("switch", 0.25)
    x = 0.5 * (device.lower + device.upper)
    x[0], x[24], x[25] = 0.3, 0.0, -math.pi / 2  # a nose at 0 degrees
    on, off = device.level_set(x, 0), device.level_set(x, 1)
    k = device.grid.shape[2] // 8  # near the bottom, where ring 1 is
    nose = [round(s * n) for s, n in zip((0.6 + 0.22, 0.5), device.grid.shape, strict=False)]
    turned = [round(s * n) for s, n in zip((0.6, 0.5 - 0.22), device.grid.shape, strict=False)]
    assert float(on[(*nose, k)]) < 0 < float(off[(*nose, k)])
    assert float(off[(*turned, k)]) < 0 < float(on[(*turned, k)])


def test_twister_is_a_tunnel_with_round_ends():
    device = devices.make("twister", 0.5)
    x = some_design(device)
    phi = device.level_set(x)
    radius = (device.grid.nodes[:, :, 0, :2] - 0.5).norm(dim=-1)
    for k in (0, -1):  # eight control points make a circle to 1e-3 of the radius
        assert bool((phi[:, :, k][radius < 0.298] > 0).all())
        assert bool((phi[:, :, k][radius > 0.302] < 0).all())


def test_wrong_arguments_say_what_is_wanted():
    with pytest.raises(ValueError, match="name must be"):
        devices.make("pump")
    with pytest.raises(ValueError, match="objective must be"):
        devices.amplifier(objective="sum")
    with pytest.raises(ValueError, match="wall must be"):
        devices.twister(wall="slip")
    with pytest.raises(ValueError, match="below upper"):
        devices.Parameter("x", 1.0, 1.0)
    with pytest.raises(ValueError, match="x must"):
        devices.make("amplifier", 0.25).value(torch.zeros(3, dtype=F64))


def test_loss_as_one_graph_has_the_same_gradient():
    device = devices.make("switch", 0.15)
    x = some_design(device).requires_grad_(True)
    (whole,) = torch.autograd.grad(device.loss(x), x)  # the first state's factor is made again
    _, by_state = device.value_and_gradient(x.detach())
    torch.testing.assert_close(whole, by_state, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("ask", ["value_and_gradient", "value", "loss", "solve", "level_set"])
def test_designs_of_another_kind_are_refused_by_name(ask):
    device = devices.make("amplifier", resolution=0.25)
    x = some_design(device)
    for wrong in (x.long(), x.float(), x[:-1], x[None], x * math.nan, x.tolist(), None):
        with pytest.raises((TypeError, ValueError), match=r"\bx must"):
            getattr(device, ask)(wrong)
    if ask in ("solve", "level_set"):
        for state in (-1, len(device.states), "first"):
            with pytest.raises((TypeError, ValueError), match="state must"):
                getattr(device, ask)(x, state)


def test_values_of_another_shape_are_refused_by_losses():
    grid = Grid((4, 3, 2), size=(4.0, 3.0, 2.0))
    phi = torch.ones(grid.node_shape, dtype=F64)
    field = made_up(grid, phi, torch.ones(1, *grid.node_shape, 3, dtype=F64))
    for ask, name in [
        (lambda: losses.integral(field, "x-", phi[0]), "values"),
        (lambda: losses.mean(field, ["x-"], phi), "nodal"),
        (lambda: losses.mean(field, ["x-"], phi[None].float()), "nodal"),
        (lambda: losses.mean_velocity(field, ["x-"], phi[0] > 0), "region"),
        (lambda: losses.mean_velocity(field, ["x-"], phi), "region"),
        (lambda: losses.squared_difference(field, ["x-"], torch.ones(2, dtype=F64)), "target"),
        (lambda: losses.angle_difference(field, ["x-"], math.nan), "angle"),
        (lambda: losses.vertical_curl(field, "x-"), "face"),
        (lambda: losses.integral(None, "x-", phi[None, 0]), "field"),
    ]:
        with pytest.raises((TypeError, ValueError), match=rf"\b{name} "):
            ask()
