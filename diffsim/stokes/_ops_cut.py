"""Cut cells and fluxes through grid planes as torch custom ops.

Everything is float64 with nodes and cells flattened, the last axis fastest.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_first_order, make_layer


def _grid(cells: list[int], spacing: list[float], phi: Tensor) -> object:
    nodes = math.prod(n + 1 for n in cells)
    if tuple(phi.shape) != (nodes,) or phi.dtype != torch.float64 or not phi.is_contiguous():
        raise ValueError(f"phi must be contiguous float64 of shape ({nodes},)")
    return core.make_grid_shape(tuple(cells), tuple(spacing))


def _cut_outputs(phi: Tensor, cells: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Volume and area (num_cells,) and normal (num_cells, dim) of cut cells, to be filled."""
    count = math.prod(cells)
    return phi.new_empty(count), phi.new_empty(count), phi.new_empty(count, len(cells))


SIZES = (1e-100, 1e100)
"""Of a level set: its slopes are squared, for which float64 has no room beyond."""


def require_squares(phi: Tensor) -> None:
    """Here rather than at the boundary, so that it is checked in compiled and mapped calls, too."""
    largest = float(phi.abs().max())
    if not (largest == 0.0 or SIZES[0] <= largest <= SIZES[1]):
        raise ValueError(
            f"phi must have values between {SIZES[0]:g} and {SIZES[1]:g} in size, where float64 "
            f"has room for their squares, got at most {largest:g}; scale it, such as to a signed "
            "distance [m]: the wall stays where it is"
        )


@custom_op("diffsim::stokes_cut_cells")
def cut_cells(
    phi: Tensor, cells: list[int], spacing: list[float], num_threads: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Fluid volume, interface area and normal of all cells; csrc/kernels/stokes/cut_cells.h."""
    require_squares(phi)
    shape = _grid(cells, spacing, phi)
    volume, area, normal = _cut_outputs(phi, cells)
    core.cut_cells(
        shape=shape,
        phi=phi.data_ptr(),
        volume=volume.data_ptr(),
        area=area.data_ptr(),
        normal=normal.data_ptr(),
        num_threads=num_threads,
    )
    return volume, area, normal


@cut_cells.register_fake
def _(phi, cells, spacing, num_threads):
    return _cut_outputs(phi, cells)


@custom_op("diffsim::stokes_cut_cells_vjp")
def cut_cells_vjp(
    grad_volume: Tensor,
    grad_area: Tensor,
    grad_normal: Tensor,
    phi: Tensor,
    cells: list[int],
    spacing: list[float],
    num_threads: int,
) -> Tensor:
    """Adjoint of :func:`cut_cells`: gradient of phi."""
    shape = _grid(cells, spacing, phi)
    count = math.prod(cells)
    grad_volume, grad_area = grad_volume.contiguous(), grad_area.contiguous()
    grad_normal = grad_normal.contiguous()
    shapes = grad_volume.shape, grad_area.shape, grad_normal.shape
    if shapes != ((count,), (count,), (count, len(cells))):
        raise ValueError("gradients of cut cells have wrong shapes")
    grad_phi = torch.empty_like(phi)
    core.cut_cells_vjp(
        shape=shape,
        phi=phi.data_ptr(),
        grad_volume=grad_volume.data_ptr(),
        grad_area=grad_area.data_ptr(),
        grad_normal=grad_normal.data_ptr(),
        grad_phi=grad_phi.data_ptr(),
        num_threads=num_threads,
    )
    return grad_phi


@cut_cells_vjp.register_fake
def _(grad_volume, grad_area, grad_normal, phi, *args):
    return torch.empty_like(phi)


@custom_op("diffsim::stokes_cut_cells_jvp")
def cut_cells_jvp(
    phi: Tensor, d_phi: Tensor, cells: list[int], spacing: list[float], num_threads: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Rates of :func:`cut_cells` along a direction of phi."""
    shape = _grid(cells, spacing, phi)
    d_phi = d_phi.contiguous()
    _grid(cells, spacing, d_phi)
    volume, area, normal = _cut_outputs(phi, cells)
    core.cut_cells_jvp(
        shape=shape,
        phi=phi.data_ptr(),
        d_phi=d_phi.data_ptr(),
        d_volume=volume.data_ptr(),
        d_area=area.data_ptr(),
        d_normal=normal.data_ptr(),
        num_threads=num_threads,
    )
    return volume, area, normal


@cut_cells_jvp.register_fake
def _(phi, d_phi, cells, spacing, num_threads):
    return _cut_outputs(phi, cells)


def _cut_setup(ctx, inputs, output):
    phi, ctx.cells, ctx.spacing, ctx.num_threads = inputs
    ctx.save_for_backward(phi)


def _cut_backward(ctx, grad_volume, grad_area, grad_normal):
    (phi,) = ctx.saved_tensors
    grad_phi = cut_cells_vjp_layer(
        grad_volume=grad_volume,
        grad_area=grad_area,
        grad_normal=grad_normal,
        phi=phi,
        cells=ctx.cells,
        spacing=ctx.spacing,
        num_threads=ctx.num_threads,
    )
    return grad_phi, None, None, None


def _cut_tangent(ctx, *moved):
    (phi,) = ctx.saved_tensors
    return cut_cells_jvp_layer(
        phi=phi,
        **directions_of({"phi": phi}, moved),
        cells=ctx.cells,
        spacing=ctx.spacing,
        num_threads=ctx.num_threads,
    )


cut_cells_vjp_layer = make_first_order(cut_cells_vjp)
cut_cells_jvp_layer = make_first_order(cut_cells_jvp)
cut_cells_layer = make_layer(
    cut_cells, setup=_cut_setup, backward=_cut_backward, tangent=_cut_tangent
)


@custom_op("diffsim::stokes_plane_flux")
def plane_flux(
    phi: Tensor,
    velocity: Tensor,
    cells: list[int],
    spacing: list[float],
    axis: int,
    index: int,
) -> Tensor:
    """Volume flow through the fluid part of a grid plane, (cases,); cut_cells.h."""
    shape = _grid(cells, spacing, phi)
    if velocity.shape[1:] != (phi.numel(), len(cells)) or not velocity.is_contiguous():
        raise ValueError("velocity must be contiguous (cases, num_nodes, dim)")
    if not (0 <= axis < len(cells) and 0 <= index <= cells[axis]):
        raise ValueError(f"no grid plane {index} on axis {axis}")
    flux = phi.new_empty(velocity.shape[0])
    core.plane_flux(
        shape=shape,
        phi=phi.data_ptr(),
        velocity=velocity.data_ptr(),
        num_cases=len(flux),
        axis=axis,
        index=index,
        flux=flux.data_ptr(),
    )
    return flux


@plane_flux.register_fake
def _(phi, velocity, *args):
    return phi.new_empty(velocity.shape[0])


@custom_op("diffsim::stokes_plane_flux_vjp")
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
        shape=shape,
        phi=phi.data_ptr(),
        velocity=velocity.data_ptr(),
        num_cases=velocity.shape[0],
        axis=axis,
        index=index,
        grad_flux=grad_flux.data_ptr(),
        grad_phi=grad_phi.data_ptr(),
        grad_velocity=grad_velocity.data_ptr(),
    )
    return grad_phi, grad_velocity


@plane_flux_vjp.register_fake
def _(grad_flux, phi, velocity, *args):
    return torch.empty_like(phi), torch.empty_like(velocity)


@custom_op("diffsim::stokes_plane_flux_jvp")
def plane_flux_jvp(
    phi: Tensor,
    velocity: Tensor,
    d_phi: Tensor,
    d_velocity: Tensor,
    cells: list[int],
    spacing: list[float],
    axis: int,
    index: int,
) -> Tensor:
    """Rate of :func:`plane_flux` along a direction of phi and velocity."""
    shape = _grid(cells, spacing, phi)
    d_phi, d_velocity = d_phi.contiguous(), d_velocity.contiguous()
    _grid(cells, spacing, d_phi)
    if d_velocity.shape != velocity.shape:
        raise ValueError(f"d_velocity must have shape {tuple(velocity.shape)}")
    flux = phi.new_empty(velocity.shape[0])
    core.plane_flux_jvp(
        shape=shape,
        phi=phi.data_ptr(),
        velocity=velocity.data_ptr(),
        d_phi=d_phi.data_ptr(),
        d_velocity=d_velocity.data_ptr(),
        num_cases=len(flux),
        axis=axis,
        index=index,
        d_flux=flux.data_ptr(),
    )
    return flux


@plane_flux_jvp.register_fake
def _(phi, velocity, *args):
    return phi.new_empty(velocity.shape[0])


def _flux_setup(ctx, inputs, output):
    phi, velocity, ctx.cells, ctx.spacing, ctx.axis, ctx.index = inputs
    ctx.save_for_backward(phi, velocity)


def _flux_backward(ctx, grad_flux):
    phi, velocity = ctx.saved_tensors
    grad_phi, grad_velocity = plane_flux_vjp_layer(
        grad_flux=grad_flux,
        phi=phi,
        velocity=velocity,
        cells=ctx.cells,
        spacing=ctx.spacing,
        axis=ctx.axis,
        index=ctx.index,
    )
    return grad_phi, grad_velocity, None, None, None, None


def _flux_tangent(ctx, *moved):
    phi, velocity = ctx.saved_tensors
    return plane_flux_jvp_layer(
        phi=phi,
        velocity=velocity,
        **directions_of({"phi": phi, "velocity": velocity}, moved),
        cells=ctx.cells,
        spacing=ctx.spacing,
        axis=ctx.axis,
        index=ctx.index,
    )


plane_flux_vjp_layer = make_first_order(plane_flux_vjp)
plane_flux_jvp_layer = make_first_order(plane_flux_jvp)
plane_flux_layer = make_layer(
    plane_flux, setup=_flux_setup, backward=_flux_backward, tangent=_flux_tangent
)
