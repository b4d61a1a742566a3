"""Stokes flow through a shape given by its level set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from diffsim.core.check import require, require_choice, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.module import Float64Module
from diffsim.core.numbers import has_values, require_unmapped, values_of
from diffsim.core.record import Solve, warn
from diffsim.core.values import as_array, joined
from diffsim.stokes import _ops_flow
from diffsim.stokes._ended import STATS, solve_of
from diffsim.stokes._ops_flow import FlowInputs
from diffsim.stokes._systems import StokesContext
from diffsim.stokes.boundary import WALL_KINDS, Boundary, Inlet, Open, Wall
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid
from diffsim.stokes.options import SolverOptions


def flow_inputs(
    boundary: Boundary,
    phi: Tensor,
    inlet: Tensor | Mapping[str, Tensor] | None,
    *,
    viscosity: Tensor | float,
    wall_velocity: Tensor | None,
    body_force: Tensor | None,
    traction: Tensor | None,
) -> FlowInputs:
    """Check the arguments of ``StokesFlow.forward`` and bring them to the solver's shapes.

    Args:
        boundary: Conditions on the box's faces.
        phi: Level set, (*node_shape,) float64.
        inlet: Velocities of the inlets, as ``StokesFlow.forward`` takes them [m/s].
        viscosity: Scalar [Pa s].
        wall_velocity: Velocity of the embedded wall, as ``StokesFlow.forward`` takes it [m/s].
        body_force: Per volume, likewise [N/m^dim].
        traction: Per area of open faces, likewise [N/m^(dim-1)].

    Returns:
        ``FlowInputs``. Gradients: all tensors.

    Raises:
        TypeError, ValueError: wrong shapes, NaN, nothing that drives the flow.
    """
    grid = boundary.grid
    phi = require("phi", phi, grid.node_shape, torch.float64)
    eta = torch.as_tensor(viscosity)
    eta = require("viscosity", eta.to(torch.float64).reshape(-1), (1,), torch.float64)
    if not torch.compiler.is_compiling():
        require_range("viscosity", eta, above=0.0, hint="unit is Pa s")
    if isinstance(inlet, Mapping):
        inlet = {name: _as_tensor(value) for name, value in inlet.items()}
    elif inlet is not None:
        inlet = as_array("inlet", inlet)
    velocities = boundary.inlet_velocities(inlet)

    def load(name: str, value: Tensor | None) -> Tensor:
        if value is None:
            return torch.zeros(0, dtype=torch.float64)
        return grid.nodal_vectors(name, _as_tensor(value)).contiguous()

    loads = {
        "wall_velocity": load("wall_velocity", wall_velocity),
        "body_force": load("body_force", body_force),
        "traction": load("traction", traction),
    }
    if not velocities and not any(value.numel() for value in loads.values()):
        raise ValueError(
            "nothing drives the flow: add an Inlet, a wall_velocity, a body_force or a traction"
        )
    if traction is not None and not boundary.open_faces:
        raise ValueError("traction acts on open faces, and there is none; add Open(face)")
    given = (*velocities.values(), *loads.values())
    counts = {value.shape[0] for value in given if value.ndim == 3} - {1}
    if len(counts) > 1:
        raise ValueError(f"inlets and loads disagree in the number of cases: {sorted(counts)}")
    cases = counts.pop() if counts else 1
    prescribed = phi.new_zeros(cases, grid.num_nodes, grid.dim)
    for name, value in velocities.items():
        nodes = boundary.inlets[name]
        prescribed = prescribed.index_copy(1, nodes, value.expand(cases, len(nodes), grid.dim))
    return FlowInputs(phi=phi.reshape(-1), viscosity=eta, prescribed=prescribed, **loads)


def _as_tensor(value: object) -> Tensor:
    return torch.as_tensor(joined(value), dtype=torch.float64)


MAX_DIRECT_NODES: int = _ops_flow.MAX_DIRECT_NODES
"""What the method "auto" solves directly in three dimensions: at most so many nodes with fluid."""


class StokesFlow(Float64Module):
    """Slow viscous flow on a grid whose fluid is where a level set is positive.

    -div(2 eta D(v)) + grad p = f,  div v = 0 in the fluid; v = wall velocity on the embedded wall
    ("no_slip"), or only its normal component with no shear ("no_separation").

    Multilinear velocities, one pressure per cell; each cell is cut by the plane that fits the level
    set at its corners, or, in 2D, by the chord between the places where the wall crosses its edges.
    Walls by symmetric Nitsche terms, slivers held by a ghost penalty: second order in the cell
    size, symmetric positive definite, no locking. Velocity and pressure depend continuously on phi
    while cells become cut, full or empty, up to terms of the size of the discretization error where
    a wall parallel to the grid passes a layer of nodes. Unless ``incompressible``, div v = -p /
    (bulk_ratio * viscosity), a relative error of about 1 / bulk_ratio.

    Viscosity scales pressure and traction, not a flow that is driven by velocities.

    Args:
        grid: The grid.
        boundary: Conditions on the box's faces; faces that are not mentioned are no-slip walls.
        viscosity: Default viscosity eta [Pa s].
        wall: Condition on the embedded wall, "no_slip" or "no_separation".
        incompressible: Whether to iterate to div v = 0 in every cell (mean over its fluid).
        bulk_ratio: Second viscosity over viscosity, lambda / eta [-].
        penalty: Nitsche penalty beta [-].
        ghost_penalty: Weight gamma of the ghost penalty [-].
        solver: Solver, tolerances and threads; ``SolverOptions()`` by default.

    Gradients: phi, inlet velocities, viscosity, wall velocity, body force, traction; first order.
    Not modeled: inertia, time, free surfaces, surface tension, shapes thinner than a cell (warns;
    with "no_separation" a part of one cut cell that touches nothing raises FactorizationError).
    Slip walls take their normal from the level set's slopes within one cell around (order two where
    phi is smooth). Read velocities where phi > 0: those beyond the wall appear and vanish with the
    cells that need them.

    Example:
        >>> flow = StokesFlow(grid, [Inlet("x-"), Open("x+")], viscosity=1e-3)
        >>> field = flow(phi, inlet=torch.tensor([0.01, 0.0], dtype=torch.float64))
    """

    @checked
    def __init__(
        self,
        grid: Grid,
        boundary: Boundary | Iterable[Inlet | Open | Wall] = (),
        *,
        viscosity: float = 1.0,
        wall: str = "no_slip",
        incompressible: bool = False,
        bulk_ratio: float = 1e5,
        penalty: float = 20.0,
        ghost_penalty: float = 0.04,
        solver: SolverOptions | None = None,
    ):
        super().__init__()
        self.grid = grid
        self.boundary = boundary if isinstance(boundary, Boundary) else Boundary(grid, boundary)
        if self.boundary.grid is not grid:
            raise ValueError("boundary was made for another grid")
        self.viscosity = require_number("viscosity", viscosity, above=0.0)
        self.wall = require_choice("wall", wall, WALL_KINDS)
        self.incompressible = incompressible
        solver = SolverOptions() if solver is None else solver
        self.on_failure, self.num_threads = solver.on_failure, solver.num_threads
        self._context = StokesContext(
            grid.shape,
            grid.spacing,
            fixed=self.boundary.fixed,
            open_faces=[face in self.boundary.open_faces for face in grid.faces],
            options={
                "slip": wall == "no_separation",
                "beta": require_number("penalty", penalty, above=0.0),
                "gamma": require_number("ghost_penalty", ghost_penalty, above=0.0),
                "bulk": require_number("bulk_ratio", bulk_ratio, above=0.0, at_most=1e8),
                "incompressible": incompressible,
                "tolerance": solver.tolerance,
                "max_iters": solver.max_iters,
                "solver": getattr(_ops_flow.FlowSolver, solver.method),
                "rtol": solver.rtol,
            },
            num_kept=solver.num_kept,
            inspect=self._inspect,
        )
        self.handle = self._context.handle

    @checked
    def forward(
        self,
        phi: Tensor,
        inlet: Tensor | Mapping[str, Tensor] | None = None,
        *,
        viscosity: Tensor | float | None = None,
        wall_velocity: Tensor | None = None,
        body_force: Tensor | None = None,
        traction: Tensor | None = None,
    ) -> FlowField:
        """Solve for the flow.

        Args:
            phi: Level set at the nodes, (*node_shape,) float64, > 0 in the fluid. Signed distances
                are best: a warning about thin parts takes them for granted.
            inlet: Velocity of every inlet by name [m/s]: (dim,), (num_inlet_nodes, dim) or
                (cases, 1 or num_inlet_nodes, dim); one tensor where there is one inlet. Node order:
                ``inlet_positions``.
            viscosity: Scalar tensor or number instead of the module's [Pa s].
            wall_velocity: Velocity of the embedded wall [m/s]: (dim,), (*node_shape, dim) or
                (cases, *node_shape, dim).
            body_force: Force per volume [N/m^dim], shapes as of ``wall_velocity``.
            traction: Force per area on open faces [N/m^(dim-1)], shapes as of ``wall_velocity``.

        Returns:
            ``FlowField``.

        Raises:
            TypeError, ValueError: wrong shapes, NaN, no fluid at all, nothing that drives the flow,
                net inflow into a region without an open face.
            FactorizationError: a part of the fluid that nothing holds.
            ConvergenceError: the incompressible iteration or the iterative solver stopped above
                its tolerance; the same in the backward pass.

        Warns:
            UserWarning: parts of the fluid without boundary data, parts thinner than a cell.
        """
        grid = self.grid
        inputs = flow_inputs(
            self.boundary,
            phi,
            inlet,
            viscosity=self.viscosity if viscosity is None else viscosity,
            wall_velocity=wall_velocity,
            body_force=body_force,
            traction=traction,
        )
        outputs = _ops_flow.solve(
            inputs, handle=self.handle, num_threads=self.num_threads, on_failure=self.on_failure
        )
        cases = inputs.prescribed.shape[0]
        return FlowField(
            grid=grid,
            phi=inputs.phi.reshape(grid.node_shape),
            velocity=outputs.velocity.reshape(cases, *grid.node_shape, grid.dim),
            pressure=outputs.pressure.reshape(cases, *grid.shape),
            volume_fraction=outputs.fraction.reshape(grid.shape),
            stats=dict(zip(STATS, outputs.stats.unbind(-1), strict=True)),
            solve=self._solve_of(inputs.phi, outputs.stats),
        ).with_imbalance()

    @checked
    def inlet_positions(self, name: str | None = None) -> Tensor:
        """Positions of an inlet's nodes, (num_inlet_nodes, dim) [m], in the order of its values."""
        if name is None:
            if len(self.boundary.inlets) != 1:
                raise ValueError(f"name one of the inlets {list(self.boundary.inlets)}")
            name = next(iter(self.boundary.inlets))
        require_choice("name", name, self.boundary.inlets)
        return self.grid.nodes.reshape(-1, self.grid.dim)[self.boundary.inlets[name]]

    @checked
    def report(self, phi: Tensor) -> dict[str, float | str]:
        """Solver, sizes and wall times [s] of a level set's prepared system, made if not kept.

        Args:
            phi: Level set at the nodes, (*node_shape,) float64.
        """
        phi = require("phi", phi, self.grid.node_shape, torch.float64).reshape(-1)
        require_unmapped(phi=phi)
        phi = values_of(phi)
        with self._context.lock:
            report = self._context.system(phi, self.num_threads).report
        names = [name for name in dir(report) if not name.startswith("_") and name != "iterative"]
        return {name: getattr(report, name) for name in names} | {
            "solver": "iterative" if report.iterative else "direct"
        }

    def _solve_of(self, phi: Tensor, stats: Tensor) -> Solve | None:
        """Why the cases ended; None where there are no values (torch.compile, torch.func)."""
        if torch.compiler.is_compiling() or not has_values(stats):
            return None
        with self._context.lock:
            iterative = self._context.system(phi.detach(), self.num_threads).report.iterative
        return solve_of(stats.detach(), "Stokes solve", self._context.options, iterative)

    def _inspect(self, report: Any, phi: Tensor) -> None:
        """Warn about what a new geometry will not resolve."""
        if report.num_loose_regions:
            warn(
                f"{report.num_loose_regions} of {report.num_regions} parts of the fluid "
                f"({report.num_loose_cells} of {report.num_cells} cells) touch no inlet, open face "
                "or wall of the box; their fluid rests unless wall or force move it"
                + (
                    ", and nothing but the grid holds a round one's rotation"
                    if self.wall == "no_separation"
                    else ""
                ),
                stacklevel=2,
            )
        thin = count_thin_cells(self.grid, phi.reshape(self.grid.node_shape))
        if thin:
            warn(
                f"the shape is thinner than a cell in about {thin} cells (the level set's slope "
                "there is below half of its usual one); refine the grid, or thicken the shape",
                stacklevel=2,
            )


def count_thin_cells(grid: Grid, phi: Tensor) -> int:
    """Cells near the wall in which the level set has a ridge: fluid or solid thinner than a cell.

    A signed distance has slope one; across a thin part it rises and falls within a cell, and the
    plane fitted to the corners is flat.
    """
    center, slopes = phi, []
    for axis in range(grid.dim):
        n = grid.shape[axis]
        center = 0.5 * (center.narrow(axis, 0, n) + center.narrow(axis, 1, n))
    for axis in range(grid.dim):
        slope = phi
        for a in range(grid.dim):
            low, high = slope.narrow(a, 0, grid.shape[a]), slope.narrow(a, 1, grid.shape[a])
            slope = (high - low) / grid.spacing[a] if a == axis else 0.5 * (high + low)
        slopes.append(slope)
    norm = torch.stack(slopes).square().sum(0).sqrt()
    usual = norm[norm > 0].median() if bool((norm > 0).any()) else norm.new_ones(())
    near = center.abs() < 0.5 * min(grid.spacing) * usual
    return int((near & (norm < 0.5 * usual)).sum())
