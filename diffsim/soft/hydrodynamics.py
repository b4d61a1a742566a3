"""Drag and thrust of water on the surface of a soft body."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from diffsim.core.check import require, require_choice, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.layer import is_followed
from diffsim.core.module import Float64Module
from diffsim.core.record import warn
from diffsim.core.torch_names import has_hooks, is_in_func
from diffsim.core.values import joined
from diffsim.mesh import HexMesh, TetMesh, surface_quads, surface_triangles
from diffsim.soft._ops_water import BoundWater, water_force
from diffsim.soft.inputs import broadcast, flat
from diffsim.soft.parameters import Value, as_tensor, hold

LIMITS = ("isotropic", "component")
DRAG_COEFFICIENTS = (0.05, 0.05, 1.85, 2.05)
THRUST_COEFFICIENTS = (-0.8, -0.5, 0.1, 2.5)


class HydroForces(NamedTuple):
    """What :meth:`Hydrodynamics.evaluate` returns.

    Attributes:
        forces: Nodal forces after limiting, (..., num_nodes, 3) [N].
        limited: Nodes on which ``max_force`` acted, (..., num_nodes) bool.
    """

    forces: Tensor
    limited: Tensor


class SteadyWater(NamedTuple):
    """Water whose force depends on nothing but where a body is and how it moves."""

    bound: BoundWater  # the kernel with the water's properties
    velocity: Tensor  # of the water, (batch, 3) [m/s]
    gain: Tensor | None = None  # factor on the forces, broadcastable to them [-]; None: 1

    @classmethod
    def of(
        cls, water: Hydrodynamics, x: Tensor, water_velocity: Tensor | None, gain: Tensor | None
    ) -> SteadyWater | None:
        """The water around a body in one step.

        Args:
            water: Its drag and thrust.
            x: Positions of the batch that they are asked for, (..., num_nodes, 3) [m].
            water_velocity: As ``water`` takes it.
            gain: Factor on the forces, broadcastable to x; None: 1.

        Returns:
            None where forces are limited, a derivative by anything else may be asked for, a
            subclass or a hook may change them, or the water is around another mesh.
        """
        if torch.compiler.is_compiling() or type(water) is not Hydrodynamics or has_hooks(water):
            return None
        velocity = water.water_velocity if water_velocity is None else water_velocity
        gains = () if gain is None else (gain,)
        others = (velocity, *water.parameters(), *water.buffers(), *gains)
        is_own = x.shape[-2] == water.mesh.num_nodes  # its call says what is wrong
        if water.max_force is not None or is_followed(others) or not is_own:
            return None
        velocity = require("water_velocity", velocity, ("...", 3))
        velocity = flat(broadcast("water_velocity", velocity, (*x.shape[:-2], 3)), 1)
        if gain is not None:
            gain = torch.as_tensor(gain, dtype=torch.float64)  # a number may be one, too
        return cls(water._bind(), velocity, gain)

    def tensors(self) -> list[Tensor]:
        """What may be asked for a derivative, or change."""
        return [self.velocity, *(() if self.gain is None else (self.gain,))]

    def force(self, x: Tensor, v: Tensor) -> Tensor:
        """Forces, shape of x (..., num_nodes, 3) [N]."""
        force = self.bound.force(flat(x), flat(v), self.velocity).reshape(x.shape)
        return force if self.gain is None else self.gain * force

    def adjoint(self, x: Tensor, v: Tensor, grad_force: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of x and v from that of the forces."""
        if self.gain is not None:
            grad_force = self.gain * grad_force
        grads = self.bound.adjoint(flat(x), flat(v), self.velocity, flat(grad_force))
        return grads[0].reshape(x.shape), grads[1].reshape(x.shape)


class Hydrodynamics(Float64Module):
    """Drag and thrust on the surface of a mesh (thesis eqs. 5.3, 5.4).

    Each boundary face (hexahedra: quad, tetrahedra: triangle) that the water meets carries

        f_d = 1/2 rho A C_d(alpha) |v_rel| v_rel,   f_t = -1/2 rho A C_t(alpha) |v_rel|^2 n,

    shared equally by its vertices: A area, n outward unit normal, v_rel the water's velocity minus
    the mean of the vertices', alpha = asin(-n.v_rel / |v_rel|) in (0, pi/2] the angle of attack
    (pi/2: head-on). Faces with n.v_rel >= 0 carry none.

    The coefficients are cubic Bezier curves B(P, t) = (1-t)^3 P0 + 3 (1-t)^2 t P1 + 3 (1-t) t^2 P2
    + t^3 P3 in the ordinates of four control points, evenly spaced in t as in the published code:

    * C_d(alpha) = B(drag_coefficients, 2 alpha / pi): P0 is the edge-on, P3 the head-on value;
    * C_t(alpha) = B(thrust_coefficients, 1/2 + alpha / pi): the curve spans alpha in
      [-pi/2, pi/2], only its half alpha > 0 is used, and P3 is the head-on value.

    Smooth but for three places, where the gradient is one-sided or zero: a face turning edge-on
    (the force jumps by 1/2 rho A |v|^2 (C_d(0) v_rel/|v_rel| - C_t(0) n), unless ``fade_angle``
    lets it rise: s^3 (10 - 15 s + 6 s^2) times the published, s = alpha / fade_angle), flow exactly
    head-on (alpha has a kink; the gradient's part through alpha is 0 there) and the force limit.
    At v_rel = 0 the force and its gradient are 0. Not modeled: water that remembers (wakes), one
    face sheltering another, shear on faces seen edge-on; for the water's inertia see
    :func:`~diffsim.soft.added_mass`.

    The force is held over a step (explicit), which is stable while
    dt rho A (C_d + C_t) |v_rel| / mass of the face's nodes stays below about 1; light bodies need
    small steps or their added mass.

    Args:
        mesh: The mesh whose boundary meets the water.
        density: Density of the water, scalar [kg/m^3], > 0.
        water_velocity: Velocity of the water, (3,) or with batch axes (..., 3) [m/s]; replaceable
            in each call.
        drag_coefficients: Ordinates of C_d, (4,) [-]. Numbers become an ``nn.Parameter``, a tensor
            is used as it is.
        thrust_coefficients: Ordinates of C_t, (4,) [-]. Defaults of both: Min et al. 2019.
        fade_angle: Angle of attack below which the force fades to zero, twice continuously
            differentiable [rad], in [0, pi/2]; 0: it jumps, as published.
        max_force: Greatest force on a node [N]; None: no limit. It guards explicit stepping.
        limit: ``isotropic`` scales the node's force vector to that length; ``component`` clamps
            each component as published, which depends on the frame and turns the force.
        warn: Whether to warn, once per object, when the limit first acts.

    Example::

        hydro = Hydrodynamics(body.mesh)
        rollout(body, state, n, external_force=lambda k, s: hydro(s.x, s.v))

    Reference: Min et al. 2019, "SoftCon"; Du et al. 2021 (DiffPD and "Underwater Soft Robot
    Modeling").
    """

    faces: Tensor
    density: Tensor
    water_velocity: Tensor
    drag_coefficients: Tensor
    thrust_coefficients: Tensor

    def __init__(
        self,
        mesh: HexMesh | TetMesh,
        *,
        density: Value = 1000.0,
        water_velocity: Value = (0.0, 0.0, 0.0),
        drag_coefficients: Value = DRAG_COEFFICIENTS,
        thrust_coefficients: Value = THRUST_COEFFICIENTS,
        fade_angle: float = 0.0,
        max_force: float | None = None,
        limit: str = "isotropic",
        warn: bool = True,
    ):
        super().__init__()
        if not isinstance(mesh, (HexMesh, TetMesh)):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        self.mesh = mesh
        surface = surface_quads(mesh) if isinstance(mesh, HexMesh) else surface_triangles(mesh)
        self.register_buffer("faces", surface.faces, persistent=False)
        hold(self, "density", density)
        hold(self, "water_velocity", water_velocity)
        hold(self, "drag_coefficients", _make_trainable("drag_coefficients", drag_coefficients))
        hold(
            self, "thrust_coefficients", _make_trainable("thrust_coefficients", thrust_coefficients)
        )
        self.fade_angle = require_number(
            "fade_angle", fade_angle, at_least=0.0, at_most=0.5 * math.pi, hint="unit is rad"
        )
        self.max_force = max_force
        if max_force is not None:
            self.max_force = require_number("max_force", max_force, above=0.0, hint="unit is N")
        self.limit = require_choice("limit", limit, LIMITS)
        self.warn = bool(warn)
        self._warned = False
        self._known: tuple[Tensor, ...] = ()  # parameters that were checked
        self._bound: BoundWater | None = None  # with those
        self._check_parameters()

    @checked(x=("...", 3), v=("...", 3), water_velocity=("...", 3))
    def forward(self, x: Tensor, v: Tensor, *, water_velocity: Tensor | None = None) -> Tensor:
        """Nodal forces.

        Args:
            x: Positions, (..., num_nodes, 3) [m].
            v: Velocities, same shape [m/s].
            water_velocity: Velocity of the water, (..., 3) [m/s], broadcast over batch axes;
                None: the module's.

        Returns:
            Forces, shape of x [N]. Gradients: x, v, water_velocity, density, both coefficients.
        """
        return self._evaluate(x, v, water_velocity).forces

    @checked(x=("...", 3), v=("...", 3), water_velocity=("...", 3))
    def evaluate(
        self, x: Tensor, v: Tensor, *, water_velocity: Tensor | None = None
    ) -> HydroForces:
        """Forces as in :meth:`forward`, and the nodes on which the limit acted."""
        return self._evaluate(x, v, water_velocity)

    def _evaluate(self, x: Tensor, v: Tensor, water_velocity: Tensor | None) -> HydroForces:
        x = require("x", x, ("...", self.mesh.num_nodes, 3), finite=False)
        v = require("v", v, tuple(x.shape), finite=False)
        self._check_parameters()
        water = self.water_velocity
        if water_velocity is not None:
            water = require("water_velocity", water_velocity, ("...", 3), finite=False)
        water = broadcast("water_velocity", water, (*x.shape[:-2], 3))
        forces = water_force(
            flat(x),
            flat(v),
            flat(water, 1),
            self.density,
            self.drag_coefficients.contiguous(),
            self.thrust_coefficients.contiguous(),
            self.faces,
            fade_angle=self.fade_angle,
        ).reshape(x.shape)
        return self._limit_forces(forces)

    @checked
    def drag_coefficient(self, alpha: Tensor) -> Tensor:
        """C_d at angles of attack [rad] in [0, pi/2], any shape."""
        return _bezier(self.drag_coefficients, alpha / (0.5 * math.pi))

    @checked
    def thrust_coefficient(self, alpha: Tensor) -> Tensor:
        """C_t at angles of attack [rad] in [-pi/2, pi/2], any shape."""
        return _bezier(self.thrust_coefficients, alpha / math.pi + 0.5)

    def extra_repr(self) -> str:
        """What ``print(hydro)`` shows."""
        limit = "no limit" if self.max_force is None else f"{self.limit} limit {self.max_force:g} N"
        return f"{self.faces.shape[0]} faces, density {self.density.item():g} kg/m^3, {limit}"

    def _check_parameters(self) -> None:
        values = (
            self.density, self.water_velocity, self.drag_coefficients, self.thrust_coefficients
        )  # fmt: skip
        has_numbers = not (torch.compiler.is_compiling() or is_in_func())
        if has_numbers and self._known:
            pairs = zip(self._known, values, strict=True)
            if all(v.is_cpu and torch.equal(known, v) for known, v in pairs):
                return
        require("density", self.density, ())
        require("water_velocity", self.water_velocity, ("...", 3))
        require("drag_coefficients", self.drag_coefficients, (4,))
        require("thrust_coefficients", self.thrust_coefficients, (4,))
        if not torch.compiler.is_compiling():
            require_range("density", self.density, above=0.0, hint="unit is kg/m^3")
        if has_numbers:  # numbers may change in place behind every counter, so copies are kept
            self._known = tuple(
                v.detach().clone(memory_format=torch.contiguous_format) for v in values
            )
            self._bound = None

    def _bind(self) -> BoundWater:
        """The kernel with the parameters as they are now."""
        self._check_parameters()
        if self._bound is None or self._bound.fade_angle != self.fade_angle:
            density, _, drag, thrust = self._known
            self._bound = BoundWater(
                self.faces,
                self.mesh.num_nodes,
                self.fade_angle,
                density=density,
                drag=drag,
                thrust=thrust,
            )
        return self._bound

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_bound": None}  # it holds addresses, which no copy has

    def _limit_forces(self, forces: Tensor) -> HydroForces:
        if self.max_force is None:
            nodes = torch.zeros(forces.shape[:-1], dtype=torch.bool)
            return HydroForces(forces, nodes)
        if self.limit == "component":
            limited = (forces.abs() > self.max_force).any(-1)
            result = forces.clamp(-self.max_force, self.max_force)
        else:
            length = torch.linalg.vector_norm(forces, dim=-1)
            limited = length > self.max_force
            scale = self.max_force / torch.where(limited, length, self.max_force)
            result = torch.where(limited[..., None], scale[..., None] * forces, forces)
        if self.warn and not self._warned and not torch.compiler.is_compiling():
            self._warn_once(forces.detach(), limited)
        return HydroForces(result, limited)

    def _warn_once(self, forces: Tensor, limited: Tensor) -> None:
        count = int(limited.sum())
        if not count:
            return
        self._warned = True
        warn(
            f"hydrodynamic forces on {count} of {limited.numel()} nodes were limited to max_force "
            f"= {self.max_force:g} N ({self.limit}); the largest would be "
            f"{float(forces.norm(dim=-1).max()):.4g} N. Said once; evaluate() tells which nodes, "
            "warn=False silences",
            RuntimeWarning,
            stacklevel=4,
        )


def _make_trainable(name: str, value: Value) -> Tensor:
    value = joined(value)
    return value if isinstance(value, Tensor) else nn.Parameter(as_tensor(name, value))


def _bezier(ordinates: Tensor, t: Tensor) -> Tensor:
    """Cubic Bezier curve through ordinates (4,) at t in [0, 1]."""
    p0, p1, p2, p3 = ordinates
    s = 1.0 - t
    return s**3 * p0 + 3.0 * s**2 * t * p1 + 3.0 * s * t**2 * p2 + t**3 * p3
