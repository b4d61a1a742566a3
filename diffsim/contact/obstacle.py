"""A rigid obstacle: a shape with a pose, a motion and surface coefficients, all differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim.contact.shapes import Box, Capsule, Pair, Plane, Shape, Sphere
from diffsim.core.check import require, require_entries, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.rotation import matrix_from_rotation_vector, rotation_offset
from diffsim.core.values import Number, Vector, friction_coefficient, scalar, vector


@dataclass(frozen=True, eq=False, init=False)
class Obstacle:
    """A rigid solid that bodies cannot enter; it moves as prescribed and is not pushed.

    Every number may be a tensor with gradient. An obstacle is never changed; :meth:`after` and
    ``dataclasses.replace`` make new ones.

    Args:
        shape: A shape from ``diffsim.contact``, in its own frame.
        position: Place of the shape's origin in the world, (3,) [m].
        rotation: Rotation vector (3,) [rad], or rotation matrix world from shape (3, 3).
        velocity: Velocity of the shape's origin, world frame, (3,) [m/s].
        angular_velocity: Angular velocity, world frame, (3,) [rad/s].
        friction: Coulomb coefficient [-], >= 0; ``math.inf``: touching nodes stick, as in the
            thesis (4.1.4). One number, or (batch,), one for each member of a batch of states.
        restitution: Newton's coefficient [-], in [0, 1]; one number or (batch,).
        name: Name of the obstacle in messages.

    Attributes:
        rotation: Rotation matrix world from shape, (3, 3).
    """

    shape: Shape
    position: Tensor
    rotation: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    friction: Tensor
    restitution: Tensor
    name: str | None

    def __init__(
        self,
        shape: Shape,
        *,
        position: Vector = (0.0, 0.0, 0.0),
        rotation: Vector = (0.0, 0.0, 0.0),
        velocity: Vector = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        friction: Number = 0.0,
        restitution: Number = 0.0,
        name: str | None = None,
    ):
        if not isinstance(shape, Shape):
            raise TypeError(
                f"shape must be a diffsim.contact shape, got {type(shape).__name__}; wrap a "
                "signed-distance function as contact.Custom(sdf)"
            )
        self._set(
            shape=shape,
            position=vector("position", position),
            rotation=_rotation(rotation),
            velocity=vector("velocity", velocity),
            angular_velocity=vector("angular_velocity", angular_velocity),
            friction=friction_coefficient(friction),
            restitution=_restitution(restitution),
            name=name,
        )

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def distance_normal(self, x: Tensor) -> Pair:
        """Signed distance and outward unit normal in the world, at the present pose.

        Args:
            x: Points, (..., 3) [m].

        Returns:
            phi, (...) [m], negative inside, and the normal, (..., 3). Gradients: x, pose and the
            shape's parameters; first order.
        """
        phi, normal = self.shape.evaluate(self.to_local(require("x", x, ("...", 3))))
        return phi, normal @ self.rotation.T

    @checked(x=("...", 3))
    def to_local(self, x: Tensor) -> Tensor:
        """World points (..., 3) [m] in the shape's frame."""
        return (x - self.position) @ self.rotation

    @checked(y=("...", 3))
    def to_world(self, y: Tensor) -> Tensor:
        """Points of the shape's frame (..., 3) [m] in the world."""
        return y @ self.rotation.T + self.position

    @checked
    def after(self, dt: float) -> Obstacle:
        """The obstacle ``dt`` [s] later; velocity and angular velocity are held."""
        if not self.moves:
            return self
        turn = matrix_from_rotation_vector(self.angular_velocity * dt)
        moved = object.__new__(Obstacle)
        moved._set(**vars(self))
        moved._set(position=self.position + self.velocity * dt, rotation=turn @ self.rotation)
        return moved

    @property
    def moves(self) -> bool:
        """Whether it has a velocity, or one that gradients are wanted to; in a graph it has."""
        if torch.compiler.is_compiling():  # moving by zero changes no bit
            return True
        both = (self.velocity, self.angular_velocity)
        return any(w.requires_grad or anywhere(w != 0) for w in both)

    @checked(x=("...", 3))
    def point_velocity(self, x: Tensor) -> Tensor:
        """Velocity of the obstacle's material at world points (..., 3) [m] -> (..., 3) [m/s]."""
        w = self.angular_velocity.expand_as(x)
        return self.velocity + torch.linalg.cross(w, x - self.position)

    @checked(x=("...", 3))
    def displacement(self, x: Tensor, dt: float) -> Tensor:
        """How far the obstacle's material now at x (..., 3) [m] moves in ``dt``, (..., 3) [m]."""
        dt = require_number("dt", dt)
        turned = rotation_offset(self.angular_velocity * dt, x - self.position)
        return self.velocity * dt + turned

    @checked
    def label(self, index: int) -> str:
        """How messages call it."""
        return repr(self.name) if self.name else f"{index} ({type(self.shape).__name__})"


def _restitution(value: Number) -> Tensor:
    """() or (batch,)."""
    if isinstance(value, Tensor) and value.ndim == 1:
        require("restitution", value, ("batch",))
        return require_range("restitution", value, at_least=0.0, at_most=1.0)
    return scalar("restitution", value, at_least=0.0, at_most=1.0)


def require_obstacles(obstacles: Sequence[Obstacle] | Obstacle) -> list[Obstacle]:
    """One obstacle or several as a list; refuse anything else."""
    if not isinstance(obstacles, (Obstacle, Sequence)):
        raise TypeError(
            f"obstacles must be an Obstacle or a sequence of them, got {type(obstacles).__name__}; "
            "use contact.Obstacle(shape)"
        )
    many = [obstacles] if isinstance(obstacles, Obstacle) else list(obstacles)
    require_entries("obstacles", many, Obstacle, hint="use contact.Obstacle(shape)")
    if not many:
        raise ValueError("obstacles must hold at least one Obstacle, got none")
    return many


@checked
def floor(height: float | Tensor = 0.0, **options: Any) -> Obstacle:
    """Solid below z = height [m]; options as in :class:`Obstacle`."""
    return Obstacle(Plane((0.0, 0.0, 1.0), height), **options)


def plane(normal: Vector, offset: Number = 0.0, **options: Any) -> Obstacle:
    """Half space, see :class:`Plane`; options as in :class:`Obstacle`."""
    return Obstacle(Plane(normal, offset), **options)


def sphere(radius: Number, **options: Any) -> Obstacle:
    """Ball, see :class:`Sphere`; options as in :class:`Obstacle`."""
    return Obstacle(Sphere(radius), **options)


def capsule(start: Vector, end: Vector, radius: Number, **options: Any) -> Obstacle:
    """Capsule, see :class:`Capsule`; options as in :class:`Obstacle`."""
    return Obstacle(Capsule(start, end, radius), **options)


def box(size: Vector, **options: Any) -> Obstacle:
    """Box, see :class:`Box`; options as in :class:`Obstacle`."""
    return Obstacle(Box(size), **options)


def _rotation(value: Vector) -> Tensor:
    if isinstance(value, Tensor) and value.shape == (3, 3):
        matrix = require("rotation", value, (3, 3))
        still = matrix.detach()
        off = float(values_of(still @ still.T - torch.eye(3)).abs().max())
        turned = float(values_of(torch.linalg.det(still)).min())
        if off > 1e-6 or turned < 0:
            raise ValueError(
                "rotation must be a rotation vector (3,) or a rotation matrix (3, 3); R R' differs "
                f"from the identity by {off:.2g}, det R = {turned:.3g}"
            )
        return matrix
    return matrix_from_rotation_vector(vector("rotation", value))
