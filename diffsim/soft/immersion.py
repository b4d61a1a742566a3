"""What surrounding water does to a body at rest or accelerating: buoyancy and added mass."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require, require_range
from diffsim.core.checked import checked
from diffsim.mesh import HexMesh, TetMesh, nodal_volume
from diffsim.soft.hydrodynamics import Hydrodynamics
from diffsim.soft.parameters import Value, as_tensor


@checked
def added_mass(
    source: HexMesh | TetMesh | Hydrodynamics, coefficient: Value, density: Value | None = None
) -> Tensor:
    """Inertia of the water that moves with a body: coefficient x density x nodal volume.

    Give it to ``Masses(added_mass=...)`` or ``body.physics(added_mass=...)``: it is inert but
    does not weigh. One scalar per node, so the same in all directions, whereas a plate drags more
    water along broadside than edge-on: take the coefficient of the motion that matters. Potential
    flow: 1/2 for a sphere, 1 for a long cylinder moving across its axis; for a plate of thickness t
    and width w moving broadside pi w / (4 t).

    Args:
        source: The mesh, or the hydrodynamics made for it.
        coefficient: Added mass over displaced mass, scalar or (num_nodes,) [-], >= 0.
        density: Density of the water, scalar [kg/m^3]; None: that of the hydrodynamics.

    Returns:
        (num_nodes,) [kg]. Gradients: coefficient, density.
    """
    if isinstance(source, Hydrodynamics):
        mesh = source.mesh
        rho = source.density if density is None else as_tensor("density", density)
    else:
        mesh = source
        if density is None:
            raise ValueError("density must be given with a mesh, got None; water has 1000 kg/m^3")
        rho = as_tensor("density", density)
    volume = nodal_volume(mesh)
    factor = as_tensor("coefficient", coefficient)
    if factor.ndim:
        require("coefficient", factor, (volume.shape[0],))
    else:
        require("coefficient", factor, ())
    require("density", rho, ())
    if not torch.compiler.is_compiling():
        require_range("coefficient", factor, at_least=0.0)
        require_range("density", rho, above=0.0, hint="unit is kg/m^3")
    return factor * rho * volume


@checked
def buoyancy(
    volume: HexMesh | TetMesh | Tensor,
    density: Value = 1000.0,
    gravity: Value = (0.0, 0.0, -9.81),
) -> Tensor:
    """Archimedes' force on a body wholly under water: -density x nodal volume x gravity.

    The volume is that at rest; a body that changes its volume is not followed.

    Args:
        volume: The mesh, or nodal volumes (num_nodes,) [m^3].
        density: Density of the water, scalar [kg/m^3].
        gravity: Acceleration of free fall, (3,) [m/s^2].

    Returns:
        Nodal forces, (num_nodes, 3) [N], for ``external_force``. Gradients: nodal volumes,
        density, gravity.
    """
    nodal = volume if isinstance(volume, Tensor) else nodal_volume(volume)
    nodal = require("volume", nodal, ("num_nodes",))
    rho = require("density", as_tensor("density", density), ())
    pull = require("gravity", as_tensor("gravity", gravity), (3,))
    if not torch.compiler.is_compiling():
        require_range("density", rho, at_least=0.0, hint="unit is kg/m^3")
    return -(rho * nodal)[:, None] * pull
