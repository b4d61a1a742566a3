"""Causes around a soft body: fluid, weight, dry friction."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.mesh import HexMesh, TetMesh, surface_triangles
from diffsim.soft import added_mass
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene


class _DragEffect(Effect):
    """Drag of every node by what of the surface it stands for."""

    quadratic: ClassVar[bool]

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        shares = self.shares(scene)
        return scene.with_force(lambda: _Drag(shares, size[0], quadratic=self.quadratic))

    def shares(self, scene: SoftScene) -> Tensor:
        """(num_vertices,) areas [m^2]."""
        return node_areas(scene.body.mesh)


class LinearDrag(_DragEffect):
    """Force per surface area -size (v - current)."""

    name, family, kind, unit, typical = "linear_drag", "damping", "force", "N s/m^3", 5.0
    signed, quadratic = False, False
    also_looks_like = ("mass-proportional damping", "quadratic drag at one amplitude")


class QuadraticDrag(_DragEffect):
    """Force per surface area -size |v - current| (v - current); size is density C_d / 2."""

    name, family, kind, unit, typical = "quadratic_drag", "damping", "force", "kg/m^3", 50.0
    signed, quadratic = False, True
    also_looks_like = ("linear drag at one amplitude",)


class _Drag(Force):
    leading_axes, reads = True, ()

    def __init__(self, shares: Tensor, coefficient: Tensor, *, quadratic: bool):
        self._coefficient, self._quadratic = coefficient, quadratic
        self._shares = shares[:, None]

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        v = moment.v - scene.current
        if self._quadratic:
            # the square root has no derivative at zero, where the product has one: zero
            square = (v * v).sum(-1, keepdim=True)
            speed = torch.where(square > 0.0, torch.where(square > 0.0, square, 1.0).sqrt(), 0.0)
            v = speed * v
        return -self._coefficient * self._shares * v


def node_areas(mesh: HexMesh | TetMesh) -> Tensor:
    """Share of the surface at rest that belongs to each node, (num_vertices,) [m^2]."""
    faces = surface_triangles(mesh).faces
    a, b, c = mesh.x_rest[faces].unbind(1)
    area = 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1)
    areas = torch.zeros(mesh.num_vertices, dtype=torch.float64)
    return areas.index_add(0, faces.flatten(), (area / 3.0).repeat_interleave(3))


class AddedMass(Effect):
    """Inertia of size times the displaced fluid, the same in all directions."""

    name, family, kind, unit, typical = "added_mass", "inertia", "force", "-", 0.5
    signed = False
    also_looks_like = ("density", "Young's modulus with weight and drag jointly")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        mass = added_mass(scene.body.mesh, size[0], scene.fluid_density)
        return scene.with_parameter("added_mass", scene.parameter("added_mass") + mass)


class Weight(Effect):
    """More or less gravity along gravity, as buoyancy is; inertia unchanged."""

    name, family, kind, unit, typical = "weight", "gravity", "environment", "m/s^2", 0.5
    also_looks_like = ("buoyancy", "density", "sag of the clamp")

    def needs(self, study: Study) -> str | None:
        return None

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        gravity = scene.parameter("gravity")
        down, _, _ = _gravity_axes(gravity)
        return scene.with_parameter("gravity", gravity + size[0] * down)


class Tilt(Effect):
    """Gravity across its nominal direction, along the world axes nearest to horizontal."""

    name, family, kind, unit, typical = "tilt", "gravity", "environment", "m/s^2", 0.3
    components = ("first", "second")
    also_looks_like = ("current", "a bent rest shape")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        gravity = scene.parameter("gravity")
        _, first, second = _gravity_axes(gravity)
        return scene.with_parameter("gravity", gravity + size[0] * first + size[1] * second)


def _gravity_axes(gravity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors along gravity (-z if there is none) and across it, without gradient."""
    g = gravity.detach()
    length = g.norm()
    z = torch.tensor([0.0, 0.0, -1.0], dtype=g.dtype)
    down = g / length if float(length) > 0.0 else z
    x = torch.zeros_like(down)
    x[int(down.abs().argmin())] = 1.0
    first = x - (x @ down) * down
    first = first / first.norm()
    return down, first, torch.linalg.cross(down, first)


class Current(Effect):
    """The fluid moves: every drag acts on v - size.

    Not smooth: the drag of :class:`diffsim.soft.Hydrodynamics` jumps where a face turns edge-on,
    as faces along the motion do as soon as there is a current across.
    """

    name, family, kind, unit, typical = "current", "flow", "environment", "m/s", 0.05
    components = ("x", "y", "z")
    smooth = False
    also_looks_like = ("tilt",)

    def needs(self, study: Study) -> str | None:
        if str(study.metadata.get("medium", "")) != "water":
            return 'a fluid that drags (metadata "medium: water")'
        return None

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.changed(current=scene.current + size)


class DryFriction(Effect):
    """Coulomb friction -size tanh(v / v_s) where the body slides, per axis.

    Class attributes:
        slip_speed: v_s [m/s].
    """

    name, family, kind, unit, typical = "dry_friction", "damping", "force", "N", 0.01
    signed = False
    slip_speed: ClassVar[float] = 1e-2
    also_looks_like = ("linear drag at small speed", "friction where a weight hangs")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.with_force(lambda: _DryFriction(size[0], self.slip_speed))


class _DryFriction(Force):
    leading_axes, reads = True, ()

    def __init__(self, size: Tensor, slip_speed: float):
        self._size, self._slip_speed = size, slip_speed

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        shares = scene.friction_shares
        if shares is None:
            shares = scene.body.nodal_volume / scene.body.nodal_volume.sum()
        speed = shares @ moment.v
        return -self._size * shares[:, None] * torch.tanh(speed / self._slip_speed)[..., None, :]


FORCES: tuple[Callable[[], Effect], ...] = (
    LinearDrag,
    QuadraticDrag,
    AddedMass,
    Weight,
    Tilt,
    Current,
    DryFriction,
)
