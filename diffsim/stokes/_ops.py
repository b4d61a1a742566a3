"""Stokes flow and its adjoint, cut cells and fluxes, as torch custom ops.

Everything here is float64 with nodes and cells flattened, the last axis fastest. Prepared C++
objects cannot be op arguments: ops carry an integer handle of the :class:`StokesContext` that owns
them.
"""

from __future__ import annotations

import itertools
import math
import threading
import warnings
import weakref
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import ConvergenceError, ConvergenceWarning, FactorizationError

FlowSolver = core.FlowSolver
MAX_DIRECT_NODES: int = core.STOKES_MAX_DIRECT_NODES
STATS = ("num_iters", "divergence", "converged", "net_inflow", "residual")
LOADS = ("wall_velocity", "body_force", "traction")
_STRIDES = ("wall_stride", "force_stride", "traction_stride")
_handles = itertools.count(1)
contexts: weakref.WeakValueDictionary[int, StokesContext] = weakref.WeakValueDictionary()


class StokesContext:
    """Prepared systems of one grid, boundary set and discretisation.

    A system is keyed by the level set alone: neither viscosity nor boundary values nor loads enter
    the factor. The last ``num_kept`` are kept; symbolic analyses of the last patterns too.

    Args:
        cells: Number of cells per axis.
        spacing: Cell size per axis [m].
        fixed: Prescribed components, (num_nodes, dim) bool.
        open_faces: Faces of the box without condition, axis by axis, low side first.
        options: Fields of ``FlowOptions`` (csrc/kernels/stokes/flow_operator.h).
        num_kept: Factorised systems to keep.
        inspect: Called with the report and phi of every new system; may warn or raise.
    """

    def __init__(
        self,
        cells: Sequence[int],
        spacing: Sequence[float],
        *,
        fixed: Tensor,
        open_faces: Sequence[bool],
        options: dict[str, float | bool],
        num_kept: int,
        inspect: Callable[[object, Tensor], None],
    ):
        self.handle = next(_handles)
        self.dim = len(cells)
        self.num_nodes = math.prod(n + 1 for n in cells)
        self.num_cells = math.prod(cells)
        self.shape = core.make_grid_shape(tuple(cells), tuple(spacing))
        self.fixed = fixed.to(torch.uint8).contiguous()
        self.open_faces = tuple(open_faces)
        self.options = core.FlowOptions()
        for name, value in options.items():
            setattr(self.options, name, value)
        self.num_kept = num_kept
        self.inspect = inspect
        self.plan = core.StokesPlan()
        self.lock = threading.Lock()  # a system solves one thing at a time
        self._systems: list[tuple[Tensor, object]] = []  # latest last
        contexts[self.handle] = self

    def system(self, phi: Tensor, num_threads: int):
        """The factorised system of a level set, from the cache where phi is equal."""
        for i, (known, system) in enumerate(self._systems):
            if torch.equal(known, phi):
                self._systems.append(self._systems.pop(i))
                return system
        del self._systems[: max(0, len(self._systems) + 1 - self.num_kept)]  # before the new one
        phi = phi.clone()
        system, unknown, pivot = core.make_stokes_system(
            self.shape,
            phi.data_ptr(),
            self.fixed.data_ptr(),
            self.open_faces,
            self.options,
            self.plan,
            num_threads,
        )
        if system is None:
            node, axis = divmod(unknown, self.dim)
            where = f"at node {node}, axis {axis}" if unknown >= 0 else "on a coarse grid"
            raise FactorizationError(
                f"the Stokes matrix is singular or indefinite {where} (pivot {pivot:.3e}); a part "
                "of the fluid has no wall, inlet or no-slip face that holds it: remove it, "
                "prescribe a velocity, or raise penalty and ghost_penalty",
                pivot=unknown,
                value=pivot,
            )
        self.inspect(system.report, phi)
        self._systems.append((phi, system))
        return system


def context(handle: int) -> StokesContext:
    """The context behind a handle."""
    found = contexts.get(handle)
    if found is None:
        raise RuntimeError(f"Stokes handle {handle} is gone: its StokesFlow was deleted")
    return found


def _require_sizes(ctx: StokesContext, tensors: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    """Kernels read whole arrays: refuse any other size before they do."""
    for name, (tensor, shape) in tensors.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if tensor.dtype != torch.float64 or not tensor.is_contiguous():
            raise TypeError(f"{name} must be contiguous float64")


def _arrays(
    ctx: StokesContext, viscosity: float, prescribed: Tensor, loads: Sequence[Tensor]
) -> object:
    cases, block = prescribed.shape[0], (ctx.num_nodes, ctx.dim)
    arrays = core.StokesArrays()
    arrays.num_cases, arrays.viscosity = cases, viscosity
    arrays.prescribed = prescribed.data_ptr()
    for name, stride, load in zip(LOADS, _STRIDES, loads, strict=True):
        if load.numel():
            many = cases if load.shape[0] == cases else 1
            _require_sizes(ctx, {name: (load, (many, *block))})
            setattr(arrays, name, load.data_ptr())
            setattr(arrays, stride, ctx.num_nodes * ctx.dim if many > 1 else 0)
    return arrays


def _report_failure(stats: Tensor, what: str, ctx: StokesContext, system, on_failure: str) -> None:
    """Warn or raise where a case did not converge, with what its solver measures."""
    failed = stats[:, STATS.index("converged")] == 0
    if not bool(failed.any()):
        return
    first = dict(zip(STATS, stats[failed][0].tolist(), strict=True))
    if system.report.iterative and not first["residual"] <= ctx.options.rtol:
        measure, found, tolerance = "relative residual", first["residual"], ctx.options.rtol
        remedy = 'raise max_iters, loosen rtol, or choose solver="direct"'
    else:
        measure = "relative divergence"
        found, tolerance = first["divergence"], ctx.options.tolerance
        remedy = "raise max_iters or bulk_ratio, or loosen tolerance"
    message = (
        f"{what} stopped after {first['num_iters']:.0f} iterations at {measure} {found:.3e}, "
        f"needed {tolerance:.3e}; {remedy}"
    )
    if on_failure == "warn" and math.isfinite(found):
        warnings.warn(message, ConvergenceWarning, stacklevel=2)
        return
    raise ConvergenceError(
        message, residual_norm=found, tolerance=tolerance, num_iters=int(first["num_iters"])
    )


MAX_NET_INFLOW = 0.05  # of the gross flux; cut faces close only to second order in the cell size


def refuse_net_inflow(share: float) -> None:
    """Raise if more flows into a closed part of the fluid than out; share of the gross flux."""
    if share > MAX_NET_INFLOW:
        raise ValueError(
            f"a part of the fluid has no open face, but {100 * share:.0f} % more flows in than "
            "out (or out than in) through its boundary; open a face, or balance the inlets"
        )


@torch.library.custom_op("diffsim::stokes_flow", mutates_args=())
def stokes_flow(
    phi: Tensor,
    viscosity: Tensor,
    prescribed: Tensor,
    loads: list[Tensor],
    handle: int,
    num_threads: int,
    on_failure: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, pressure, fluid fraction and stats; see csrc/kernels/stokes/flow_system.h.

    Args:
        phi: Level set, (num_nodes,), > 0 in the fluid.
        viscosity: (1,) [Pa s].
        prescribed: (cases, num_nodes, dim), read at prescribed components [m/s].
        loads: Those of ``LOADS``: empty, (1, num_nodes, dim) or (cases, num_nodes, dim).
    """
    ctx = context(handle)
    cases, nodes, dim = prescribed.shape[0], ctx.num_nodes, ctx.dim
    _require_sizes(
        ctx,
        {
            "phi": (phi, (nodes,)),
            "viscosity": (viscosity, (1,)),
            "prescribed": (prescribed, (cases, nodes, dim)),
        },
    )
    velocity = phi.new_empty(cases, nodes, dim)
    pressure = phi.new_empty(cases, ctx.num_cells)
    fraction = phi.new_empty(ctx.num_cells)
    stats = phi.new_zeros(cases, len(STATS))
    arrays = _arrays(ctx, float(viscosity), prescribed, loads)
    with ctx.lock:
        system = ctx.system(phi, num_threads)
        system.fractions(fraction.data_ptr(), ctx.num_cells)
        system.solve(
            arrays, velocity.data_ptr(), pressure.data_ptr(), stats.data_ptr(), num_threads
        )
    refuse_net_inflow(float(stats[:, STATS.index("net_inflow")].max()) if cases else 0.0)
    _report_failure(stats, "Stokes solve", ctx, system, on_failure)
    return velocity, pressure, fraction, stats


@stokes_flow.register_fake
def _(phi, viscosity, prescribed, loads, handle, *args):
    ctx = context(handle)
    cases = prescribed.shape[0]
    return (
        torch.empty_like(prescribed),
        phi.new_empty(cases, ctx.num_cells),
        phi.new_empty(ctx.num_cells),
        phi.new_empty(cases, len(STATS)),
    )


@torch.library.custom_op("diffsim::stokes_flow_vjp", mutates_args=())
def stokes_flow_vjp(
    grad_velocity: Tensor,
    grad_pressure: Tensor,
    grad_fraction: Tensor,
    velocity: Tensor,
    pressure: Tensor,
    phi: Tensor,
    viscosity: Tensor,
    prescribed: Tensor,
    loads: list[Tensor],
    handle: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`stokes_flow`: gradients of phi, viscosity, prescribed and loads."""
    ctx = context(handle)
    grads = {
        "grad_velocity": grad_velocity.contiguous(),
        "grad_pressure": grad_pressure.contiguous(),
        "grad_fraction": grad_fraction.contiguous(),
    }
    likes = (velocity, pressure, pressure.new_empty(ctx.num_cells))
    _require_sizes(
        ctx, {k: (g, tuple(like.shape)) for (k, g), like in zip(grads.items(), likes, strict=True)}
    )
    _require_sizes(ctx, {"phi": (phi, (ctx.num_nodes,))})
    grad_phi, grad_viscosity = torch.zeros_like(phi), torch.zeros_like(viscosity)
    grad_prescribed = torch.empty_like(prescribed)
    grad_loads = [torch.zeros_like(load) for load in loads]
    stats = phi.new_zeros(prescribed.shape[0], len(STATS))
    with ctx.lock:
        system = ctx.system(phi, num_threads)
        system.adjoint(
            _arrays(ctx, float(viscosity), prescribed, loads),
            velocity.data_ptr(),
            pressure.data_ptr(),
            *(g.data_ptr() for g in grads.values()),
            _arrays(ctx, 0.0, grad_prescribed, grad_loads),
            grad_phi.data_ptr(),
            grad_viscosity.data_ptr(),
            stats.data_ptr(),
            num_threads,
        )
    _report_failure(stats, "adjoint of the Stokes solve", ctx, system, on_failure)
    return [grad_phi, grad_viscosity, grad_prescribed, *grad_loads]


@stokes_flow_vjp.register_fake
def _(gv, gp, gf, velocity, pressure, phi, viscosity, prescribed, loads, *args):
    return [torch.empty_like(t) for t in (phi, viscosity, prescribed, *loads)]


def _flow_setup(ctx, inputs, output):
    phi, viscosity, prescribed, loads, ctx.handle, ctx.num_threads, ctx.on_failure = inputs
    velocity, pressure, _fraction, stats = output
    ctx.save_for_backward(velocity, pressure, phi, viscosity, prescribed, *loads)
    ctx.owner = context(ctx.handle)  # the graph keeps the prepared systems
    ctx.mark_non_differentiable(stats)


def _flow_backward(ctx, grad_velocity, grad_pressure, grad_fraction, _grad_stats):
    # One solve with the forward's factor serves all inputs; csrc/kernels/stokes/flow_system.cpp.
    velocity, pressure, phi, viscosity, prescribed, *loads = ctx.saved_tensors
    grads = stokes_flow_vjp(
        grad_velocity, grad_pressure, grad_fraction, velocity, pressure, phi, viscosity, prescribed,
        loads, ctx.handle, ctx.num_threads, ctx.on_failure,
    )  # fmt: skip
    return *grads[:3], list(grads[3:]), None, None, None


stokes_flow.register_autograd(_flow_backward, setup_context=_flow_setup)


def _grid(cells: list[int], spacing: list[float], phi: Tensor) -> object:
    nodes = math.prod(n + 1 for n in cells)
    if tuple(phi.shape) != (nodes,) or phi.dtype != torch.float64 or not phi.is_contiguous():
        raise ValueError(f"phi must be contiguous float64 of shape ({nodes},)")
    return core.make_grid_shape(tuple(cells), tuple(spacing))


@torch.library.custom_op("diffsim::stokes_cut_cells", mutates_args=())
def cut_cells(
    phi: Tensor, cells: list[int], spacing: list[float], num_threads: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Fluid volume, interface area and normal of all cells; csrc/kernels/stokes/cut_cells.h."""
    shape = _grid(cells, spacing, phi)
    volume = phi.new_empty(math.prod(cells))
    area, normal = torch.empty_like(volume), volume.new_empty(volume.numel(), len(cells))
    core.cut_cells(
        shape, phi.data_ptr(), volume.data_ptr(), area.data_ptr(), normal.data_ptr(), num_threads
    )
    return volume, area, normal


@cut_cells.register_fake
def _(phi, cells, spacing, num_threads):
    count = math.prod(cells)
    return phi.new_empty(count), phi.new_empty(count), phi.new_empty(count, len(cells))


@torch.library.custom_op("diffsim::stokes_cut_cells_vjp", mutates_args=())
def cut_cells_vjp(
    grads: list[Tensor], phi: Tensor, cells: list[int], spacing: list[float], num_threads: int
) -> Tensor:
    """Adjoint of :func:`cut_cells`; ``grads`` of volume, area, normal."""
    shape = _grid(cells, spacing, phi)
    count = math.prod(cells)
    volume, area, normal = (g.contiguous() for g in grads)
    if volume.shape != (count,) or area.shape != (count,) or normal.shape != (count, len(cells)):
        raise ValueError("gradients of cut cells have wrong shapes")
    grad_phi = torch.empty_like(phi)
    core.cut_cells_vjp(
        shape,
        phi.data_ptr(),
        volume.data_ptr(),
        area.data_ptr(),
        normal.data_ptr(),
        grad_phi.data_ptr(),
        num_threads,
    )
    return grad_phi


@cut_cells_vjp.register_fake
def _(grads, phi, *args):
    return torch.empty_like(phi)


def _cut_setup(ctx, inputs, output):
    phi, ctx.cells, ctx.spacing, ctx.num_threads = inputs
    ctx.save_for_backward(phi)


def _cut_backward(ctx, *grads):
    (phi,) = ctx.saved_tensors
    grad = cut_cells_vjp(list(grads), phi, ctx.cells, ctx.spacing, ctx.num_threads)
    return grad, None, None, None


cut_cells.register_autograd(_cut_backward, setup_context=_cut_setup)


@torch.library.custom_op("diffsim::stokes_plane_flux", mutates_args=())
def plane_flux(
    phi: Tensor, velocity: Tensor, cells: list[int], spacing: list[float], axis: int, index: int
) -> Tensor:
    """Volume flow through the fluid part of a grid plane, (cases,); cut_cells.h."""
    shape = _grid(cells, spacing, phi)
    if velocity.shape[1:] != (phi.numel(), len(cells)) or not velocity.is_contiguous():
        raise ValueError("velocity must be contiguous (cases, num_nodes, dim)")
    if not (0 <= axis < len(cells) and 0 <= index <= cells[axis]):
        raise ValueError(f"no grid plane {index} on axis {axis}")
    flux = phi.new_empty(velocity.shape[0])
    core.plane_flux(
        shape, phi.data_ptr(), velocity.data_ptr(), len(flux), axis, index, flux.data_ptr()
    )
    return flux


@plane_flux.register_fake
def _(phi, velocity, *args):
    return phi.new_empty(velocity.shape[0])


@torch.library.custom_op("diffsim::stokes_plane_flux_vjp", mutates_args=())
def plane_flux_vjp(
    grad_flux: Tensor,
    phi: Tensor,
    velocity: Tensor,
    cells: list[int],
    spacing: list[float],
    axis: int,
    index: int,
) -> tuple[Tensor, Tensor]:
    """Adjoint of :func:`plane_flux`."""
    shape = _grid(cells, spacing, phi)
    grad_flux = grad_flux.contiguous()
    grad_phi, grad_velocity = torch.empty_like(phi), torch.empty_like(velocity)
    core.plane_flux_vjp(
        shape,
        phi.data_ptr(),
        velocity.data_ptr(),
        velocity.shape[0],
        axis,
        index,
        grad_flux.data_ptr(),
        grad_phi.data_ptr(),
        grad_velocity.data_ptr(),
    )
    return grad_phi, grad_velocity


@plane_flux_vjp.register_fake
def _(grad_flux, phi, velocity, *args):
    return torch.empty_like(phi), torch.empty_like(velocity)


def _flux_setup(ctx, inputs, output):
    phi, velocity, ctx.cells, ctx.spacing, ctx.axis, ctx.index = inputs
    ctx.save_for_backward(phi, velocity)


def _flux_backward(ctx, grad_flux):
    phi, velocity = ctx.saved_tensors
    grads = plane_flux_vjp(grad_flux, phi, velocity, ctx.cells, ctx.spacing, ctx.axis, ctx.index)
    return *grads, None, None, None, None


plane_flux.register_autograd(_flux_backward, setup_context=_flux_setup)
