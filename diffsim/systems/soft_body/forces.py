"""Causes around a soft body: fluid, weight, dry friction."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.mesh import HexMesh, TetMesh, surface_triangles
from diffsim.soft import added_mass
from diffsim.systems.soft_body.kept import OfScene, ratio
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene


def drag_nodes(
    scene: SoftScene,
    size: Tensor,
    run: Run,
    *,
    shares: Callable[[SoftScene], Tensor],
    quadratic: bool,
) -> SoftScene:
    """Drag every node by its share of the body.

    Args:
        shares: Area or volume of each node of a scene, (num_nodes,) [m^2] or [m^3].
        quadratic: Whether drag grows with the square of the speed.
    """
    own = shares(scene)
    return scene.with_hook(lambda: _Drag(own, size[0], quadratic=quadratic))


def areas_of(scene: SoftScene) -> Tensor:
    """Share of the surface at rest that belongs to each node, (num_nodes,) [m^2]."""
    return node_areas(scene.body.mesh)


class _Drag(Force):
    leading_axes, of_state, reads = True, True, ()

    def __init__(self, shares: Tensor, coefficient: Tensor, *, quadratic: bool):
        self._quadratic = quadratic
        self._shares = -coefficient * shares[:, None]

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        v = moment.v - scene.current
        if self._quadratic:
            # the square root has no derivative at zero, where the product has one: zero
            square = (v * v).sum(-1, keepdim=True)
            speed = torch.where(square > 0.0, torch.where(square > 0.0, square, 1.0).sqrt(), 0.0)
            v = speed * v
        return self._shares * v

    def factor_of(self, other: Force) -> Tensor | None:
        """Drags of one law are alike but for their coefficients."""
        if not isinstance(other, _Drag) or other._quadratic != self._quadratic:
            return None
        return ratio(self._shares, other._shares)


def node_areas(mesh: HexMesh | TetMesh) -> Tensor:
    """Share of the surface at rest that belongs to each node, (num_nodes,) [m^2]."""
    faces = surface_triangles(mesh).faces
    a, b, c = mesh.x_rest[faces].unbind(1)
    area = 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1)
    areas = torch.zeros(mesh.num_nodes, dtype=torch.float64)
    return areas.index_add(0, faces.flatten(), (area / 3.0).repeat_interleave(3))


def add_fluid_mass(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Inertia of ``size`` times the displaced fluid."""
    mass = added_mass(scene.body.mesh, size[0], scene.fluid_density)
    return scene.with_parameter("added_mass", scene.number("added_mass") + mass)


def change_weight(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """More gravity along gravity, by ``size`` [m/s^2]."""
    gravity = scene.number("gravity")
    down, _, _ = _find_gravity_axes(gravity)
    return scene.with_parameter("gravity", gravity + size[0] * down)


def tilt_gravity(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Gravity across its direction, (2,) [m/s^2]."""
    gravity = scene.number("gravity")
    _, first, second = _find_gravity_axes(gravity)
    return scene.with_parameter("gravity", gravity + size[0] * first + size[1] * second)


def _find_gravity_axes(gravity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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


def move_fluid(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """The fluid moves: every drag acts on v - size.

    Not smooth: the drag of :class:`diffsim.soft.Hydrodynamics` jumps where a face turns edge-on,
    as faces along the motion do as soon as there is a current across.
    """
    return scene.changed(current=scene.current + size)


def rub_nodes(scene: SoftScene, size: Tensor, run: Run, *, slip_speed: float) -> SoftScene:
    """Coulomb friction -size tanh(v / slip_speed) per axis, slip_speed in [m/s]."""
    return scene.with_hook(lambda: _DryFriction(size[0], slip_speed))


class _DryFriction(Force):
    leading_axes, of_state, reads = True, True, ()

    def __init__(self, size: Tensor, slip_speed: float):
        self._size, self._slip_speed = size, slip_speed
        self._shares = OfScene(_share_friction)
        self._scaled = OfScene(lambda scene: -size * self._shares(scene)[:, None])

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        speed = self._shares(scene) @ moment.v
        return self._scaled(scene) * torch.tanh(speed / self._slip_speed)[..., None, :]

    def factor_of(self, other: Force) -> Tensor | None:
        """Frictions are alike but for their sizes."""
        if not isinstance(other, _DryFriction) or other._slip_speed != self._slip_speed:
            return None
        return ratio(self._size, other._size)


def _share_friction(scene: SoftScene) -> Tensor:
    """(num_nodes,) of dry friction, summing to 1."""
    if scene.friction_shares is not None:
        return scene.friction_shares
    return scene.body.nodal_volume / scene.body.nodal_volume.sum()
