"""Stokes flow, its adjoint and its tangent as torch custom ops.

Everything is float64 with nodes and cells flattened, the last axis fastest. Ops take flat tensors;
:class:`FlowInputs` and :class:`FlowOutputs` name them, and their fields are in the order in which
the ops take and return them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, directions_of, make_first_order, make_layer
from diffsim.stokes._ended import STATS, finish
from diffsim.stokes._ops_cut import require_squares
from diffsim.stokes._systems import StokesContext, context
from diffsim.stokes.boundary import refuse_net_inflow

FlowSolver = core.FlowSolver
MAX_DIRECT_NODES: int = core.STOKES_MAX_DIRECT_NODES
LOADS = ("wall_velocity", "body_force", "traction")


class FlowInputs(NamedTuple):
    """What drives a flow, and through which shape; also the gradients of these.

    Attributes:
        phi: Level set, (num_nodes,), > 0 in the fluid.
        viscosity: Viscosity, (1,) [Pa s].
        prescribed: Velocities, (cases, num_nodes, dim), read at prescribed components [m/s].
        wall_velocity: Velocity of the embedded wall, (1 or cases, num_nodes, dim) [m/s]; empty
            at rest.
        body_force: Per volume, the same shapes [N/m^dim]; empty without.
        traction: On open faces, the same shapes [N/m^(dim-1)]; empty without.
    """

    phi: Tensor
    viscosity: Tensor
    prescribed: Tensor
    wall_velocity: Tensor
    body_force: Tensor
    traction: Tensor

    @property
    def loads(self) -> dict[str, Tensor]:
        """Wall velocity, body force and traction by name."""
        return {name: getattr(self, name) for name in LOADS}


class FlowOutputs(NamedTuple):
    """A solved flow.

    Attributes:
        velocity: Velocity at each node, (cases, num_nodes, dim) [m/s].
        pressure: Pressure of each cell, (cases, num_cells) [Pa].
        fraction: Fluid share of every cell, (num_cells,) [-].
        stats: ``STATS`` of every case, (cases, len(STATS)); no gradient.
    """

    velocity: Tensor
    pressure: Tensor
    fraction: Tensor
    stats: Tensor


def solve(inputs: FlowInputs, *, handle: int, num_threads: int, on_failure: str) -> FlowOutputs:
    """The flow of a level set by the prepared systems behind a handle."""
    return FlowOutputs(
        *stokes_flow_layer(
            **inputs._asdict(), handle=handle, num_threads=num_threads, on_failure=on_failure
        )
    )


@custom_op("diffsim::stokes_flow")
def stokes_flow(
    phi: Tensor,
    viscosity: Tensor,
    prescribed: Tensor,
    wall_velocity: Tensor,
    body_force: Tensor,
    traction: Tensor,
    handle: int,
    num_threads: int,
    on_failure: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``FlowOutputs`` of ``FlowInputs``; see csrc/kernels/stokes/flow_system.h."""
    inputs = FlowInputs(phi, viscosity, prescribed, wall_velocity, body_force, traction)
    ctx = context(handle)
    cases, nodes, dim = prescribed.shape[0], ctx.num_nodes, ctx.dim
    _require_size("phi", phi, (nodes,))
    require_squares(phi)
    _require_size("viscosity", viscosity, (1,))
    _require_size("prescribed", prescribed, (cases, nodes, dim))
    outputs = FlowOutputs(
        velocity=phi.new_empty(cases, nodes, dim),
        pressure=phi.new_empty(cases, ctx.num_cells),
        fraction=phi.new_empty(ctx.num_cells),
        stats=phi.new_zeros(cases, len(STATS)),
    )
    arrays = _arrays(ctx, inputs, float(viscosity))
    with ctx.lock:
        system = ctx.system(phi, num_threads)
        system.fractions(outputs.fraction.data_ptr(), ctx.num_cells)
        system.solve(
            inputs=arrays,
            velocity=outputs.velocity.data_ptr(),
            pressure=outputs.pressure.data_ptr(),
            stats=outputs.stats.data_ptr(),
            num_threads=num_threads,
        )
    net_inflow = outputs.stats[:, STATS.index("net_inflow")]
    refuse_net_inflow(float(net_inflow.max()) if cases else 0.0)
    finish(outputs.stats, "Stokes solve", ctx, system.report.iterative, on_failure)
    return outputs


@stokes_flow.register_fake
def _(phi, viscosity, prescribed, wall_velocity, body_force, traction, handle, *args):
    ctx = context(handle)
    cases = prescribed.shape[0]
    return (
        torch.empty_like(prescribed),
        phi.new_empty(cases, ctx.num_cells),
        phi.new_empty(ctx.num_cells),
        phi.new_empty(cases, len(STATS)),
    )


@custom_op("diffsim::stokes_flow_vjp")
def stokes_flow_vjp(
    grad_velocity: Tensor,
    grad_pressure: Tensor,
    grad_fraction: Tensor,
    velocity: Tensor,
    pressure: Tensor,
    phi: Tensor,
    viscosity: Tensor,
    prescribed: Tensor,
    wall_velocity: Tensor,
    body_force: Tensor,
    traction: Tensor,
    handle: int,
    num_threads: int,
    on_failure: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Adjoint of :func:`stokes_flow`: gradients of ``FlowInputs``."""
    inputs = FlowInputs(phi, viscosity, prescribed, wall_velocity, body_force, traction)
    ctx = context(handle)
    grad_velocity, grad_pressure = grad_velocity.contiguous(), grad_pressure.contiguous()
    grad_fraction = grad_fraction.contiguous()
    _require_size("grad_velocity", grad_velocity, tuple(velocity.shape))
    _require_size("grad_pressure", grad_pressure, tuple(pressure.shape))
    _require_size("grad_fraction", grad_fraction, (ctx.num_cells,))
    _require_size("phi", phi, (ctx.num_nodes,))
    grads = FlowInputs(
        phi=torch.zeros_like(phi),
        viscosity=torch.zeros_like(viscosity),
        prescribed=torch.empty_like(prescribed),
        **{name: torch.zeros_like(load) for name, load in inputs.loads.items()},
    )
    stats = phi.new_zeros(prescribed.shape[0], len(STATS))
    arrays = _arrays(ctx, inputs, float(viscosity))
    with ctx.lock:
        system = ctx.system(phi, num_threads)
        system.adjoint(
            inputs=arrays,
            velocity=velocity.data_ptr(),
            pressure=pressure.data_ptr(),
            grad_velocity=grad_velocity.data_ptr(),
            grad_pressure=grad_pressure.data_ptr(),
            grad_fraction=grad_fraction.data_ptr(),
            grads=_arrays(ctx, grads, 0.0),
            grad_phi=grads.phi.data_ptr(),
            grad_viscosity=grads.viscosity.data_ptr(),
            stats=stats.data_ptr(),
            num_threads=num_threads,
        )
    finish(stats, "adjoint of the Stokes solve", ctx, system.report.iterative, on_failure)
    return grads


@stokes_flow_vjp.register_fake
def _(grad_velocity, grad_pressure, grad_fraction, velocity, pressure, *args):
    inputs = args[: len(FlowInputs._fields)]
    return tuple(torch.empty_like(value) for value in inputs)


@custom_op("diffsim::stokes_flow_jvp")
def stokes_flow_jvp(
    velocity: Tensor,
    pressure: Tensor,
    phi: Tensor,
    viscosity: Tensor,
    prescribed: Tensor,
    wall_velocity: Tensor,
    body_force: Tensor,
    traction: Tensor,
    d_phi: Tensor,
    d_viscosity: Tensor,
    d_prescribed: Tensor,
    d_wall_velocity: Tensor,
    d_body_force: Tensor,
    d_traction: Tensor,
    handle: int,
    num_threads: int,
    on_failure: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, pressure and fraction of :func:`stokes_flow` along one direction in its inputs."""
    inputs = FlowInputs(phi, viscosity, prescribed, wall_velocity, body_force, traction)
    given = d_phi, d_viscosity, d_prescribed, d_wall_velocity, d_body_force, d_traction
    directions = FlowInputs(*(direction.contiguous() for direction in given))
    ctx = context(handle)
    for (name, value), direction in zip(inputs._asdict().items(), directions, strict=True):
        _require_size(f"d_{name}", direction, tuple(value.shape))
    _require_size("phi", phi, (ctx.num_nodes,))
    rates = torch.empty_like(velocity), torch.empty_like(pressure), phi.new_empty(ctx.num_cells)
    stats = phi.new_zeros(prescribed.shape[0], len(STATS))
    arrays = _arrays(ctx, inputs, float(viscosity))
    with ctx.lock:
        system = ctx.system(phi, num_threads)
        system.tangent(
            inputs=arrays,
            velocity=velocity.data_ptr(),
            pressure=pressure.data_ptr(),
            directions=_arrays(ctx, directions, float(directions.viscosity)),
            d_phi=directions.phi.data_ptr(),
            d_velocity=rates[0].data_ptr(),
            d_pressure=rates[1].data_ptr(),
            d_fraction=rates[2].data_ptr(),
            stats=stats.data_ptr(),
            num_threads=num_threads,
        )
    finish(stats, "tangent of the Stokes solve", ctx, system.report.iterative, on_failure)
    return rates


@stokes_flow_jvp.register_fake
def _(velocity, pressure, phi, *args):
    ctx = context(args[-3])
    return torch.empty_like(velocity), torch.empty_like(pressure), phi.new_empty(ctx.num_cells)


def _setup(ctx, inputs, output):
    count = len(FlowInputs._fields)
    ctx.handle, ctx.num_threads, ctx.on_failure = inputs[count:]
    outputs = FlowOutputs(*output)
    ctx.save_for_backward(outputs.velocity, outputs.pressure, *inputs[:count])
    ctx.owner = context(ctx.handle)  # the graph keeps the prepared systems
    ctx.mark_non_differentiable(outputs.stats)


def _backward(ctx, grad_velocity, grad_pressure, grad_fraction, _grad_stats):
    # One solve with the forward's factor serves all inputs; csrc/kernels/stokes/flow_system.cpp.
    velocity, pressure, *saved = ctx.saved_tensors
    grads = stokes_flow_vjp_layer(
        grad_velocity=grad_velocity,
        grad_pressure=grad_pressure,
        grad_fraction=grad_fraction,
        velocity=velocity,
        pressure=pressure,
        **FlowInputs(*saved)._asdict(),
        handle=ctx.handle,
        num_threads=ctx.num_threads,
        on_failure=ctx.on_failure,
    )
    return *grads, None, None, None


def _tangent(ctx, *moved):
    # The same system along the direction of the inputs; csrc/kernels/stokes/flow_system.cpp.
    velocity, pressure, *saved = ctx.saved_tensors
    inputs = FlowInputs(*saved)
    rates = stokes_flow_jvp_layer(
        velocity=velocity,
        pressure=pressure,
        **inputs._asdict(),
        **directions_of(inputs._asdict(), moved),
        handle=ctx.handle,
        num_threads=ctx.num_threads,
        on_failure=ctx.on_failure,
    )
    return *rates, None


stokes_flow_vjp_layer = make_first_order(stokes_flow_vjp)
stokes_flow_jvp_layer = make_first_order(stokes_flow_jvp)
stokes_flow_layer = make_layer(stokes_flow, setup=_setup, backward=_backward, tangent=_tangent)


def _require_size(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    """Kernels read whole arrays: refuse any other size before they do."""
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    if tensor.dtype != torch.float64 or not tensor.is_contiguous():
        raise TypeError(f"{name} must be contiguous float64")


def _arrays(ctx: StokesContext, inputs: FlowInputs, viscosity: float) -> object:
    """Addresses of the prescribed velocities and the loads, or of their gradients."""
    cases, block = inputs.prescribed.shape[0], (ctx.num_nodes, ctx.dim)
    arrays = core.StokesArrays()
    arrays.num_cases, arrays.viscosity = cases, viscosity
    arrays.prescribed = inputs.prescribed.data_ptr()
    for name, load in inputs.loads.items():
        if load.numel():
            many = cases if load.shape[0] == cases else 1
            _require_size(name, load, (many, *block))
            setattr(arrays, name, load.data_ptr())
            setattr(arrays, f"{name}_stride", ctx.num_nodes * ctx.dim if many > 1 else 0)
    return arrays
