"""From what a caller gives a flow layer to the inputs of its solver, checked."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffsim.core.check import require, require_range
from diffsim.core.values import as_array, joined
from diffsim.stokes._ops_flow import FlowInputs
from diffsim.stokes.boundary import Boundary


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
