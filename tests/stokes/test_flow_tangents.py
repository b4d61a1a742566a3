"""Forward mode of the flow, of cut cells and of fluxes: transposes of reverse mode, and right."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp, vjp

from diffsim import stokes
from diffsim.core.errors import ConvergenceWarning
from diffsim.stokes.shapes import BezierCurve2d, sample
from tests.stokes.cases import small_flow, small_inputs, tensor

pytestmark = [pytest.mark.grad, pytest.mark.filterwarnings("ignore:the shape is thinner")]
Layer = Callable[..., Tensor]


def rough(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def everything(flow: stokes.StokesFlow, names: tuple[str, ...]) -> Layer:
    """Every output of a flow, pressure scaled to be as large as the rest."""

    def layer(*values: Tensor) -> Tensor:
        given = dict(zip(names, values, strict=True))
        field = flow(given.pop("phi"), given.pop("inlet", None), **given)
        parts = field.velocity, 0.1 * field.pressure, field.volume_fraction, field.flux(0, 2)
        return torch.cat([part.flatten() for part in parts])

    return layer


def assert_transposed(layer: Layer, args: tuple[Tensor, ...], rtol: float = 1e-8) -> None:
    """<w, J d> = <J' w, d>, input by input; with every input by itself no term hides another."""
    out, pull = vjp(layer, *args)
    weight = rough(*out.shape, seed=1)
    gradients = pull(weight)
    for k, gradient in enumerate(gradients):
        directions = [torch.zeros_like(a) for a in args]
        directions[k] = rough(*args[k].shape, seed=2 + k)
        _, moved = jvp(layer, args, tuple(directions))
        forward, reverse = (weight * moved).sum(), (gradient * directions[k]).sum()
        scale = float((weight * moved).norm())
        assert scale > 0.0
        assert abs(float(forward - reverse)) < rtol * scale, (k, float(forward), float(reverse))


EVERY_SOLVER = pytest.mark.parametrize(
    ("dim", "incompressible", "method"),
    [
        *((dim, incompressible, "direct") for dim in (2, 3) for incompressible in (False, True)),
        *((2, False, "iterative"), (3, False, "iterative"), (3, True, "iterative")),
    ],
)
WALLS = pytest.mark.parametrize("wall", ["no_slip", "no_separation"])


def flow_and_inputs(dim: int, incompressible: bool, method: str, wall: str):
    """A small flow that is solved to rounding, and all that it may be differentiated by."""
    sharp = {"tolerance": 1e-12} if method == "direct" else {"rtol": 1e-12}
    options = stokes.SolverOptions(method=method, **sharp)
    flow = small_flow(dim, wall=wall, incompressible=incompressible, solver=options)
    return flow, {name: value.detach() for name, value in small_inputs(flow).items()}


@WALLS
@EVERY_SOLVER
def test_all_inputs_against_the_adjoint(dim, incompressible, method, wall):
    flow, inputs = flow_and_inputs(dim, incompressible, method, wall)
    assert_transposed(everything(flow, tuple(inputs)), tuple(inputs.values()))


@WALLS
@EVERY_SOLVER
def test_every_input_against_differences(dim, incompressible, method, wall):
    """With the test above, reverse mode is right, too."""
    flow, inputs = flow_and_inputs(dim, incompressible, method, wall)
    layer, args = everything(flow, tuple(inputs)), tuple(inputs.values())
    for k, name in enumerate(inputs):
        step = 1e-6 if name == "phi" else 1e-4  # linear in the others but viscosity
        directions = [torch.zeros_like(a) for a in args]
        directions[k] = rough(*args[k].shape, seed=4 + k)
        moved = jvp(layer, args, tuple(directions))[1]
        ends = []
        for sign in (1.0, -1.0):
            given = [a + sign * step * d for a, d in zip(args, directions, strict=True)]
            ends.append(layer(*given))
        change = (ends[0] - ends[1]) / (2 * step)
        # rounding of the outputs, and of what the iterations leave, over the step
        noise = 1e-12 * float(ends[0].norm()) / step
        assert float((change - moved).norm()) < 1e-6 * float(moved.norm()) + noise, name


def cavity(**options) -> tuple[stokes.StokesFlow, Tensor, Tensor, Tensor]:
    """A box without open face around a block, driven by a lid; phi, lid and force."""
    grid = stokes.Grid((6, 5), (0.2, 0.22))
    flow = stokes.StokesFlow(grid, [stokes.Inlet("y+")], **options)
    phi = (grid.nodes - tensor(0.61, 0.53)).norm(dim=-1) - 0.23
    lid = torch.zeros(7, 2, dtype=torch.float64)
    lid[1:-1, 0] = tensor(0.3, 0.8, 1.0, 0.7, 0.4)
    return flow, phi, lid, rough(*grid.node_shape, 2, seed=9)


@pytest.mark.parametrize("incompressible", [False, True])
def test_a_closed_box_whose_mean_pressure_moves_with_its_shape(incompressible):
    options = stokes.SolverOptions(tolerance=1e-12)
    flow, phi, lid, force = cavity(incompressible=incompressible, solver=options)
    full = everything(flow, ("phi", "inlet", "body_force"))

    def layer(phi: Tensor, force: Tensor) -> Tensor:  # another lid would let fluid in
        return full(phi, lid, force)

    assert_transposed(layer, (phi, force))
    direction, step = rough(*phi.shape, seed=3), 1e-7  # a corner's pressure bends soon
    moved = jvp(lambda phi: layer(phi, force), (phi,), (direction,))[1]
    ahead, behind = (layer(phi + s * step * direction, force) for s in (1.0, -1.0))
    assert float(((ahead - behind) / (2 * step) - moved).norm()) < 1e-6 * float(moved.norm())


@pytest.mark.parametrize("dim", [2, 3])
def test_cut_cells(dim):
    flow = small_flow(dim)
    phi = small_inputs(flow)["phi"].detach()

    def layer(phi: Tensor) -> Tensor:
        cells = stokes.cut_cells(flow.grid, phi)
        return torch.cat([part.flatten() for part in cells])

    assert_transposed(layer, (phi,), 1e-12)
    torch.testing.assert_close(jacfwd(layer)(phi), jacrev(layer)(phi))


@WALLS
@pytest.mark.parametrize("dim", [2, 3])
def test_fluxes(dim, wall):
    flow = small_flow(dim, wall=wall)
    inputs = small_inputs(flow)
    field = flow(inputs["phi"].detach(), inputs["inlet"].detach())

    def layer(phi: Tensor, velocity: Tensor) -> Tensor:
        moved = stokes.FlowField(**{**field.__dict__, "phi": phi, "velocity": velocity})
        return torch.stack([moved.flux(axis, k) for axis in range(dim) for k in (0, 1, -1)])

    assert_transposed(layer, (field.phi.detach(), field.velocity.detach()), 1e-12)


def test_through_a_shape():
    """Control points of a curve: one solve per direction forward, one per output backward."""
    grid = stokes.Grid((10, 8), spacing=1.0 / 8)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], wall="no_separation")
    points = torch.tensor([[-0.1, 0.12], [0.5, 0.2], [0.9, 0.31], [1.5, 0.33]]).double()

    def layer(points: Tensor) -> Tensor:
        phi = sample(BezierCurve2d(points, fluid="left"), grid.nodes)
        field = flow(phi, inlet=tensor(1.0, 0.0))
        return torch.cat([field.velocity[0, -1, :, 0], field.pressure[0, 0]])

    forward, reverse = jacfwd(layer)(points), jacrev(layer)(points)
    torch.testing.assert_close(forward, reverse, rtol=1e-8, atol=1e-8 * float(reverse.abs().max()))


def test_a_tangent_that_does_not_converge_says_so():
    options = stokes.SolverOptions(method="iterative", max_iters=2, on_failure="warn")
    flow = small_flow(3, solver=options)
    inputs = {name: value.detach() for name, value in small_inputs(flow).items()}
    directions = tuple(torch.ones_like(value) for value in inputs.values())
    with pytest.warns(ConvergenceWarning, match="tangent of the Stokes solve stopped"):
        jvp(everything(flow, tuple(inputs)), tuple(inputs.values()), directions)
