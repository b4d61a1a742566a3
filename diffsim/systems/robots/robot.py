"""A soft robot: a body with muscles, what surrounds it, what it senses, and what steers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.contact import Obstacle
from diffsim.soft.step import step_in_water


@dataclass(frozen=True, eq=False, kw_only=True)
class SoftRobot:
    """A soft robot with its body, drive, sensors and surroundings, as examples and environments use
    it.

    Commands lie in [-1, 1]; the activation of the muscles (target stretches) is
    ``rest_activation + command @ drive``, so antagonists are rows with entries of both signs.

    Attributes:
        name: Name of the robot, such as "starfish".
        body: Mesh, material, muscles, time step.
        drive: Activation of each muscle per unit of each command, (num_commands, num_muscles) [-].
        command_names: Name of each command, (num_commands,).
        sensors: Nodes whose velocity is sensed, (num_sensors,) int64.
        forward: Unit vector along which it should move, (3,).
        water: Drag and thrust of the water around the robot; None: the robot is in air.
        obstacles: Obstacles that the robot stands on.
        upright_axis: Axis of the robot, x, y or z (0-2), that must not tip over; None: no axis.
        shares: Share of each node in the volume at rest, (num_nodes, 1) [-].
    """

    name: str
    body: soft.SoftBody
    drive: Tensor
    command_names: tuple[str, ...]
    sensors: Tensor
    forward: Tensor
    water: soft.Hydrodynamics | None = None
    obstacles: tuple[Obstacle, ...] = ()
    upright_axis: int | None = None
    shares: Tensor = field(init=False)

    def __post_init__(self) -> None:
        want = (len(self.command_names), len(self.body.muscles.rest_activation))
        if tuple(self.drive.shape) != want:
            raise ValueError(
                f"drive must have shape {want} (commands, muscles), got {tuple(self.drive.shape)}"
            )
        volume = self.body.nodal_volume
        object.__setattr__(self, "shares", (volume / volume.sum())[:, None])

    @property
    def num_dofs(self) -> int:
        """Degrees of freedom, fixed ones included."""
        return 3 * self.body.mesh.num_nodes

    def activation(self, command: Tensor) -> Tensor:
        """Muscle activations (..., num_muscles) of commands (..., num_commands)."""
        return self.body.muscles.rest_activation + command @ self.drive

    def force(
        self, state: soft.State, *, water_velocity: Tensor | None = None, gain: Tensor | None = None
    ) -> Tensor | None:
        """Force of the water at a state, shape of x [N]; None in air.

        Args:
            state: x, v (..., num_nodes, 3).
            water_velocity: (..., 3) [m/s]; None: at rest.
            gain: Factor on drag and thrust, broadcastable to x; None: 1.
        """
        if self.water is None:
            return None
        force = self.water(state.x, state.v, water_velocity=water_velocity)
        return force if gain is None else gain * force

    def step(
        self,
        state: soft.State,
        command: Tensor,
        *,
        water_velocity: Tensor | None = None,
        gain: Tensor | None = None,
    ) -> soft.State:
        """One time step under a command (..., num_commands); the others as for ``force``."""
        activation, obstacles = self.activation(command), self.obstacles or None
        if self.water is None or type(self).force is not SoftRobot.force:
            force = self.force(state, water_velocity=water_velocity, gain=gain)
            return soft.step(
                self.body, state, external_force=force, activation=activation, obstacles=obstacles
            )
        return step_in_water(
            self.body,
            state,
            self.water,
            water_velocity=water_velocity,
            gain=gain,
            obstacles=obstacles,
            activation=activation,
        )

    def center(self, x: Tensor) -> Tensor:
        """Center of volume at rest weights, (..., 3) [m]."""
        return (self.shares * x).sum(-2)

    def attitude(self, x: Tensor) -> Tensor:
        """Mean deformation gradient, (..., 3, 3) [-]: least squares fit of x to the rest shape.

        Its columns are where the robot's axes point, stretched as the body is.
        """
        rest = self.body.x_rest - self.center(self.body.x_rest)
        weighted = self.shares * rest
        return x.mT @ weighted @ torch.linalg.inv(rest.T @ weighted)


def spread_nodes(points: Tensor, count: int) -> Tensor:
    """``count`` nodes that lie far from one another (farthest-point sampling), (count,) int64."""
    if count > len(points):
        raise ValueError(f"count must be at most {len(points)}, the number of nodes, got {count}")
    distance = (points - points.mean(0)).norm(dim=1)
    chosen = [int(distance.argmax())]
    nearest = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)


def antagonists(pairs: int, amplitude: float) -> Tensor:
    """Drive of commands that each contract one of two muscles and stretch the other.

    Muscles come as (first, second) of every pair; a positive command contracts the first.
    """
    drive = torch.zeros(pairs, 2 * pairs, dtype=torch.float64)
    for k in range(pairs):
        drive[k, 2 * k], drive[k, 2 * k + 1] = -amplitude, amplitude
    return drive


def fibers(where: Tensor, direction: Tensor | Sequence[float], stiffness: float) -> soft.Muscle:
    """A muscle in the elements of a mask; direction (3,) or one per element of it."""
    return soft.Muscle(
        elements=torch.nonzero(where)[:, 0], direction=direction, stiffness=stiffness
    )


def element_centers(shape: mesh.HexMesh) -> Tensor:
    """Centers of the elements, (num_elements, 3) [m]."""
    return shape.x_rest[shape.hexes].mean(1)
