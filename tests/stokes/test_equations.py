"""Solved flows against dense linear algebra on the same equations, their residuals, and what stops
a direct solver's iteration to div v = 0."""

import numpy as np
import pytest
import torch

import diffsim
from diffsim import stokes
from diffsim.core.errors import ConvergenceError
from diffsim.stokes import _ops_flow
from tests.stokes.cases import tensor
from tests.stokes.test_iterative import solve, tube

pytestmark = pytest.mark.filterwarnings("ignore:the shape is thinner")
WALLS = ("no_slip", "no_separation")


def tilted(wall: str, **options) -> tuple[stokes.StokesFlow, torch.Tensor]:
    """A channel whose walls cut off corners of cells, down to 1e-9 of a cell."""
    grid = stokes.Grid((11, 10), spacing=0.1)
    x, y = grid.nodes.unbind(-1)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], wall=wall, **options)
    return flow, 0.2999 - (y - 0.5 - 0.12 * torch.sin(2.0 * x)).abs()


def loads(flow: stokes.StokesFlow) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    shape = (*flow.grid.node_shape, flow.grid.dim)
    return {
        "inlet": tensor(1.0, 0.2),
        "wall_velocity": 0.1 * flow.grid.nodes.cos(),
        "body_force": torch.randn(shape, generator=generator, dtype=torch.float64),
    }


class Dense:
    """The equations of a flow as a matrix, probed column by column, and numpy's solution."""

    def __init__(self, flow: stokes.StokesFlow, phi: torch.Tensor, inputs: dict):
        self.flow, self.context = flow, flow._context
        self.inputs = stokes.flow.flow_inputs(
            flow.boundary,
            phi,
            inputs["inlet"],
            viscosity=1.0,
            wall_velocity=inputs["wall_velocity"],
            body_force=inputs["body_force"],
            traction=None,
        )
        field = flow(phi, **inputs)
        self.system = self.context.system(self.inputs.phi, 1)
        fluid = field.volume_fraction > 0.0
        at = torch.zeros(flow.grid.node_shape, dtype=torch.bool)
        for i, j in fluid.nonzero().tolist():
            at[i : i + 2, j : j + 2] = True
        fixed = self.context.fixed.bool().reshape(-1, 2)
        self.free = (at.reshape(-1, 1) & ~fixed).flatten().numpy()
        self.held = (at.reshape(-1, 1) & fixed).flatten().numpy()
        self.cells = fluid.flatten().numpy()

    def equations(self, velocity: np.ndarray, pressure: np.ndarray, *, driven: bool) -> np.ndarray:
        """Left sides at given values; without what drives the flow where not ``driven``."""
        empty = torch.zeros(0, dtype=torch.float64)
        inputs = self.inputs if driven else self.inputs._replace(wall_velocity=empty)
        inputs = inputs if driven else inputs._replace(body_force=empty)
        momentum, mass = np.empty(len(self.free)), np.empty(len(self.cells))
        self.system.equations(
            inputs=_ops_flow._arrays(self.context, inputs, 1.0),
            velocity=velocity.ctypes.data,
            pressure=pressure.ctypes.data,
            momentum=momentum.ctypes.data,
            mass=mass.ctypes.data,
            num_threads=1,
        )
        return np.concatenate([momentum[self.free], mass[self.cells]])

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """(num_nodes, 2) velocities and (num_cells,) pressures with div v = 0 in every cell."""
        n, size = int(self.free.sum()), int(self.free.sum() + self.cells.sum())
        matrix = np.empty((size, size))
        for column in range(size):
            v, p = np.zeros(len(self.free)), np.zeros(len(self.cells))
            if column < n:
                v[np.flatnonzero(self.free)[column]] = 1.0
            else:
                p[np.flatnonzero(self.cells)[column - n]] = 1.0
            matrix[:, column] = self.equations(v, p, driven=False)
        velocity = np.where(self.held, self.inputs.prescribed[0].flatten().numpy(), 0.0)
        pressure = np.zeros(len(self.cells))
        right = -self.equations(velocity, pressure, driven=True)
        stiffness = np.abs(np.diag(matrix)[:n])
        held = (matrix[n:, :n] ** 2 / stiffness).sum(1)  # a pressure's own, by the diagonal
        scale = 1.0 / np.sqrt(np.concatenate([stiffness, held]))
        found = scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * right)
        velocity[self.free], pressure[self.cells] = found[:n], found[n:]
        return velocity.reshape(-1, 2), pressure


@pytest.mark.reference
@pytest.mark.parametrize("wall", WALLS)
def test_incompressible_flow_is_numpy_s_solution(wall):
    flow, phi = tilted(wall, incompressible=True)
    field = flow(phi, **loads(flow))
    assert flow.report(phi)["solver"] == "direct"
    fractions = field.volume_fraction
    assert float(fractions[fractions > 0.0].min()) < 1e-2
    velocity, pressure = Dense(flow, phi, loads(flow)).solve()
    fluid = (fractions > 0.0).flatten()
    for found, expected in (
        (field.velocity[0].reshape(-1, 2), torch.from_numpy(velocity)),
        (field.pressure[0].flatten()[fluid], torch.from_numpy(pressure)[fluid]),
    ):
        assert float((found - expected).norm() / expected.norm()) < 1e-8


@pytest.mark.reference
@pytest.mark.grad
@pytest.mark.parametrize("wall", WALLS)
def test_incompressible_derivatives_are_those_of_numpy_s_solution(wall):
    """By the shape: central differences of dense solutions, the adjoint and the tangent."""
    flow, phi = tilted(wall, incompressible=True)
    given = loads(flow)
    generator = torch.Generator().manual_seed(8)
    weights = torch.randn((*phi.shape, 2), generator=generator, dtype=torch.float64)
    direction = torch.randn(phi.shape, generator=generator, dtype=torch.float64)

    def loss(shape: torch.Tensor) -> torch.Tensor:
        return (flow(shape, **given).velocity[0] * weights).sum()

    ends = [
        (Dense(flow, phi + step * direction, given).solve()[0] * weights.reshape(-1, 2).numpy())
        for step in (1e-6, -1e-6)
    ]
    expected = (ends[0].sum() - ends[1].sum()) / 2e-6
    shape = phi.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(shape), shape)
    _, tangent = torch.func.jvp(loss, (phi,), (direction,))
    assert float((slope * direction).sum()) == pytest.approx(expected, rel=2e-6)
    assert float(tangent) == pytest.approx(expected, rel=2e-6)


@pytest.mark.reference
@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_incompressible_direct_solves_are_right_at_their_tolerance(dim, wall):
    """Where a wall enters a cell through a corner the divergence does not see its pressure.

    With the divergence alone to stop at, gradients by the shape were off by 5e-3 in the plane.
    """
    made = {"incompressible": True, "max_iters": 1000}
    exact = solve(*tube(wall, dim, "iterative", rtol=1e-12, tolerance=1e-11, **made), rough=False)
    found = solve(*tube(wall, dim, "direct", incompressible=True), rough=False)
    for name, value in exact.items():
        error = float((found[name] - value).norm() / value.norm())
        assert error < (1e-7 if name in ("pressure", "d phi") else 1e-8), (name, error)


@pytest.mark.parametrize("incompressible", [False, True])
@pytest.mark.parametrize("wall", WALLS)
def test_direct_solves_carry_their_residual(wall, incompressible):
    flow, phi = tilted(wall, incompressible=incompressible)
    with diffsim.record() as record:
        field = flow(phi.requires_grad_(), **loads(flow))
        field.velocity.square().sum().backward()
    assert len(record.solves) == 2
    for solved in record.solves:
        assert 0.0 < solved.residual[0] < 1e-9 and solved.ended == ("converged",)
    assert float(field.stats["residual"]) == record.solves[0].residual[0]


def test_a_factor_that_rounds_is_corrected_by_the_residual():
    """One solve with a bulk modulus of 1e8 leaves 1e-8, for the factor's rounding grows with it."""
    flow, phi = tilted("no_slip", bulk_ratio=1e8)
    field = flow(phi, **loads(flow))
    assert float(field.stats["num_iters"]) == 2.0 and float(field.stats["residual"]) < 1e-13


def test_a_direct_solve_that_does_not_converge_is_reported():
    options = stokes.SolverOptions(method="direct", max_iters=2)
    flow, phi = tilted("no_slip", incompressible=True, bulk_ratio=10.0, solver=options)
    message = r"after 2 iterations at .* (divergence|pressures) .*raise max_iters or bulk_ratio"
    with pytest.raises(ConvergenceError, match=message):
        flow(phi, **loads(flow))
