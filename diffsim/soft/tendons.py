"""Tendons: cables through a soft body, pulled to a commanded length."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require, require_constant, require_number
from diffsim.core.checked import checked
from diffsim.core.module import Float64Module
from diffsim.core.numbers import values_of
from diffsim.core.torch_names import on_constants
from diffsim.core.values import as_array
from diffsim.mesh import HexMesh, TetMesh, element_volumes, shape_gradients
from diffsim.soft.muscles import Muscle
from diffsim.soft.routing import route


class Tendon(Float64Module):
    """A cable along a polyline, bonded to the body, with the energy

        E = EA/2 sum_e L_e max(0, s_e - a)^2,   s_e = |F m_e|,   a = commanded / rest length,

    over the pieces of length L_e and direction m_e that lie in elements e: a length muscle (thesis
    eq. 5.5 in the form of Min et al. 2019) that never pushes. Its fibers have the stiffness
    w_e = EA L_e / V_e, so that the cable's does not depend on the mesh. Bonded means that each
    piece has its own stretch and tension and may be slack on its own; it does not slide in a
    sheath. In a hexahedron the fiber acts at all Gauss points, that is about the element's center
    line: the arm of a bending tendon is that of the elements it crosses, so lead it through their
    centers.

    Give ``tendon.muscle`` to the body; its stiffness in ``fiber_stiffness`` is then EA [N]::

        tendon = Tendon(mesh, path, axial_stiffness=40.0)
        body = SoftBody(mesh, muscles=[tendon.muscle], ...)
        step(body, state, activation=tendon.activation(length)[None])

    Args:
        mesh: The body's mesh, hexahedral or tetrahedral.
        path: Corners of the polyline in the rest shape, (k, 3), k >= 2 [m].
        axial_stiffness: EA, force per unit strain [N], > 0.
        slack: A cable, slack where the command is longer than it is; False: a rod, which then
            pushes.

    Attributes:
        rest_length: Length of the path [m].
        muscle: The :class:`~diffsim.soft.Muscle` for ``SoftBody(muscles=...)``.
        elements: Elements of the pieces, (num_pieces,) int64, along the path.
        piece_length: L_e, (num_pieces,) [m], summing to ``rest_length``.
    """

    elements: Tensor
    piece_length: Tensor
    _nodes: Tensor
    _along: Tensor
    _share: Tensor

    def __init__(
        self,
        mesh: HexMesh | TetMesh,
        path: Tensor | Sequence[Sequence[float]],
        *,
        axial_stiffness: float,
        slack: bool = True,
    ):
        super().__init__()
        if not isinstance(mesh, (HexMesh, TetMesh)):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        self.axial_stiffness = require_number(
            "axial_stiffness", axial_stiffness, above=0.0, hint="unit is N"
        )
        require_constant("path", path)
        corners = require("path", as_array("path", path, torch.float64), ("k", 3))
        if corners.shape[0] < 2:
            raise ValueError(f"path must have at least two corners, got {corners.shape[0]}")
        if bool((corners.diff(dim=0).norm(dim=1) == 0).any()):
            raise ValueError("path must not repeat a corner: every segment needs a length")
        self.slack = bool(slack)
        with on_constants():
            self._lay(mesh, values_of(corners))

    def _lay(self, mesh: HexMesh | TetMesh, corners: Tensor) -> None:
        """Find the pieces of the path, and what their stretch depends on."""
        found = route(mesh, corners.numpy())
        elements = torch.from_numpy(found.elements)
        length = torch.from_numpy(found.length)
        direction = torch.from_numpy(found.direction)
        self.rest_length = float(length.sum())
        self.muscle = Muscle(
            elements=elements,
            direction=direction,
            stiffness=self.axial_stiffness,
            kind="tendon" if self.slack else "length",
            weights=length / element_volumes(mesh)[elements],
            is_cable=True,
        )
        shape = shape_gradients(mesh)
        rows = shape.class_idx[elements]
        weight = shape.weight[rows]
        self._num_nodes = mesh.num_nodes
        self.register_buffer("elements", elements, persistent=False)
        self.register_buffer("piece_length", length, persistent=False)
        self.register_buffer("_nodes", mesh.elements[elements], persistent=False)
        # F m = sum_a x_a (grad_a . m) at each quadrature point; and the points' shares
        along = torch.einsum("fqac,fc->fqa", shape.grad[rows], direction)
        self.register_buffer("_along", along, persistent=False)
        self.register_buffer("_share", weight / weight.sum(1, keepdim=True), persistent=False)

    @checked
    def activation(self, length_command: Tensor | float, x_rest: Tensor | None = None) -> Tensor:
        """a = commanded length / rest length.

        Args:
            length_command: Any shape [m].
            x_rest: Rest shape in place of the mesh's, (num_nodes, 3) [m], as
                ``body.physics(x_rest=...)`` takes it; None: the mesh's.

        Returns:
            a, shape of the command [-]. Gradients: length_command, x_rest.
        """
        rest = self.rest_length if x_rest is None else self.length(x_rest)
        return torch.as_tensor(length_command, dtype=torch.float64) / rest

    @checked(x=("...", 3))
    def stretch(self, x: Tensor) -> Tensor:
        """s_e of each piece at x (..., num_nodes, 3) [m], (..., num_pieces). Gradient: x."""
        x = require("x", x, ("...", self._num_nodes, 3))
        lines = torch.einsum("fqa,...fac->...fqc", self._along, x[..., self._nodes, :])
        return (lines.norm(dim=-1) * self._share).sum(-1)

    def length(self, x: Tensor) -> Tensor:
        """Current length sum L_e s_e, as the energy sees it.

        Args:
            x: Positions, (..., num_nodes, 3) [m].

        Returns:
            (...) [m]. Gradient: x.
        """
        return (self.stretch(x) * self.piece_length).sum(-1)

    @checked
    def tension(
        self,
        x: Tensor,
        activation: Tensor | float,
        axial_stiffness: Tensor | None = None,
        x_rest: Tensor | None = None,
    ) -> Tensor:
        """Tension of each piece, EA (s_e - a); negative: it pushes (without ``slack``).

        Its mean, weighted by ``piece_length``, is the force that the motor feels.

        Args:
            x: Positions, (..., num_nodes, 3) [m].
            activation: a, broadcastable to the batch axes (...) [-].
            axial_stiffness: EA instead of the tendon's own, scalar [N].
            x_rest: Rest shape in place of the mesh's, (num_nodes, 3) [m]; None: the mesh's.

        Returns:
            (..., num_pieces) [N]. Gradients: x, activation, axial_stiffness, x_rest.
        """
        a = torch.as_tensor(activation, dtype=torch.float64)
        stretch = self.stretch(x)
        if x_rest is not None:
            stretch = stretch / self.stretch(x_rest)
        strain = stretch - a[..., None]
        if self.muscle.kind != "length":
            strain = strain.clamp(min=0.0)
        return (self.axial_stiffness if axial_stiffness is None else axial_stiffness) * strain

    def extra_repr(self) -> str:
        """What ``print(tendon)`` shows."""
        return (
            f"{self.rest_length:g} m in {self.elements.numel()} pieces, "
            f"EA = {self.axial_stiffness:g} N"
        )
