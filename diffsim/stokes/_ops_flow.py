"""Stokes flow, its adjoint and its tangent as torch custom ops.

Everything is float64 with nodes and cells flattened, the last axis fastest. Ops take flat tensors;
:class:`FlowInputs` and :class:`FlowOutputs` name them, and their fields are in the order in which
the ops take and return them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Op, array
from diffsim.stokes._ended import STATS, finish
from diffsim.stokes._ops_cut import require_squares
from diffsim.stokes._systems import StokesContext, context
from diffsim.stokes.boundary import refuse_net_inflow

FlowSolver = core.FlowSolver
MAX_DIRECT_NODES: int = core.STOKES_MAX_DIRECT_NODES
LOADS = ("wall_velocity", "body_force", "traction")


class FlowInputs(NamedTuple):
    """What drives a flow, and through which shape; also the gradients of these."""

    phi: Tensor  # level set, (num_nodes,), > 0 in the fluid
    viscosity: Tensor  # viscosity, (1,) [Pa s]
    prescribed: Tensor  # velocities, (cases, num_nodes, dim), read at prescribed components [m/s]
    # velocity of the embedded wall, (1 or cases, num_nodes, dim) [m/s]; empty at rest
    wall_velocity: Tensor
    body_force: Tensor  # per volume, the same shapes [N/m^dim]; empty without
    traction: Tensor  # on open faces, the same shapes [N/m^(dim-1)]; empty without

    @property
    def loads(self) -> dict[str, Tensor]:
        """Wall velocity, body force and traction by name."""
        return {name: getattr(self, name) for name in LOADS}


class FlowOutputs(NamedTuple):
    """A solved flow."""

    velocity: Tensor  # velocity at each node, (cases, num_nodes, dim) [m/s]
    pressure: Tensor  # pressure of each cell, (cases, num_cells) [Pa]
    fraction: Tensor  # fluid share of every cell, (num_cells,) [-]
    stats: Tensor  # ``STATS`` of every case, (cases, len(STATS)); no gradient


def _context(options: Mapping[str, Any]) -> StokesContext:
    return context(options["handle"])


def _sizes(call: Call) -> dict[str, int]:
    ctx = _context(call.options)
    return {"num_nodes": ctx.num_nodes, "num_cells": ctx.num_cells, "dim": ctx.dim}


def _by_name(call: Call, prefix: str = "") -> FlowInputs:
    return FlowInputs(**{name: call[prefix + name] for name in FlowInputs._fields})


def _finish(call: Call, stats: Tensor, what: str, system: Any) -> None:
    finish(stats, what, _context(call.options), system.report.iterative, call.sizes["on_failure"])


def _solve(call: Call) -> None:
    ctx, num_threads = _context(call.options), call.sizes["num_threads"]
    require_squares(call["phi"])
    arrays = _arrays(ctx, _by_name(call), float(call["viscosity"]))
    with ctx.lock:
        system = ctx.system(call["phi"], num_threads)
        system.fractions(call["fraction"].data_ptr(), ctx.num_cells)
        places = call.addresses("velocity", "pressure", "stats")
        system.solve(inputs=arrays, **places, num_threads=num_threads)
    net_inflow = call["stats"][:, STATS.index("net_inflow")]
    refuse_net_inflow(float(net_inflow.max()) if len(net_inflow) else 0.0)
    _finish(call, call["stats"], "Stokes solve", system)


def _solve_again(call: Call, name: str, **own: Any) -> None:
    """One more solve with the forward's factor; csrc/kernels/stokes/flow_system.cpp."""
    ctx, num_threads = _context(call.options), call.sizes["num_threads"]
    stats = torch.zeros(call.sizes["cases"], len(STATS), dtype=torch.float64)
    with ctx.lock:
        system = ctx.system(call["phi"], num_threads)
        getattr(system, name)(
            inputs=_arrays(ctx, _by_name(call), float(call["viscosity"])),
            **call.addresses("velocity", "pressure"),
            **own,
            stats=stats.data_ptr(),
            num_threads=num_threads,
        )
    _finish(call, stats, f"{name} of the Stokes solve", system)


def _adjoint(call: Call) -> None:
    grads = _arrays(_context(call.options), _by_name(call, "grad_"), 0.0)
    names = (*RESULTS, "phi", "viscosity")
    _solve_again(call, "adjoint", grads=grads, **call.addresses(*(f"grad_{n}" for n in names)))


# The same system along the direction of the inputs.
def _tangent(call: Call) -> None:
    along = _arrays(_context(call.options), _by_name(call, "d_"), float(call["d_viscosity"]))
    names = ("phi", *RESULTS)
    _solve_again(call, "tangent", directions=along, **call.addresses(*(f"d_{n}" for n in names)))


LOAD = array("cases?", "num_nodes", "dim", optional=True)
RESULTS = ("velocity", "pressure", "fraction")
stokes_flow = Op(  # csrc/kernels/stokes/flow_system.h
    "stokes_flow",
    inputs={
        "phi": array("num_nodes"),
        "viscosity": array(1),
        "prescribed": array("cases", "num_nodes", "dim"),
        **dict.fromkeys(LOADS, LOAD),
    },
    outputs={
        "velocity": array("cases", "num_nodes", "dim"),
        "pressure": array("cases", "num_cells"),
        "fraction": array("num_cells"),
        "stats": array("cases", len(STATS), smooth=False, zeroed=True),
    },
    options="int handle, int num_threads, str on_failure",
    sizes=_sizes,
    owner=_context,  # the graph keeps the prepared systems
    reads=("velocity", "pressure", *FlowInputs._fields),
    kernel=_solve,
    adjoint=_adjoint,
    tangent=_tangent,
)


def solve(inputs: FlowInputs, *, handle: int, num_threads: int, on_failure: str) -> FlowOutputs:
    """The flow of a level set by the prepared systems behind a handle."""
    return FlowOutputs(*stokes_flow(*inputs, handle, num_threads, on_failure))


def _arrays(ctx: StokesContext, inputs: FlowInputs, viscosity: float) -> object:
    """Addresses of the prescribed velocities and the loads, or of their gradients."""
    cases = inputs.prescribed.shape[0]
    arrays = core.StokesArrays()
    arrays.num_cases, arrays.viscosity = cases, viscosity
    arrays.prescribed = inputs.prescribed.data_ptr()
    for name, load in inputs.loads.items():
        if load.numel():
            many = cases if load.shape[0] == cases else 1
            setattr(arrays, name, load.data_ptr())
            setattr(arrays, f"{name}_stride", ctx.num_nodes * ctx.dim if many > 1 else 0)
    return arrays
