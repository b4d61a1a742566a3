"""Soft robots that swim, walk and reach."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import mesh, soft
from diffsim._check import require_number
from diffsim.envs.pictures import body_picture
from diffsim.envs.task import Entry, Randomisation, Task, TaskState
from diffsim.robots import SoftRobot

_BODY = ("x", "v", "x_prev", "v_prev", "contact_force")


class SoftTask(Task):
    """A soft robot under commands to its muscles; what is rewarded, subclasses say.

    Args:
        robot: Body, muscles, surroundings.
        num_steps: Length of an episode in control steps, each one time step of the body.
        start_speed: Standard deviation of the whole body's velocity at the start [m/s].
        current: Standard deviation of each component of the episode's current [m/s]; in water.
        action_delay, randomisation: As for every task; ``muscles`` (their stroke) and, in water,
            ``water`` (drag and thrust) may be randomised, per member of a batch.
    """

    randomisable = ("muscles", "water")

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        start_speed: float = 0.0,
        current: float = 0.0,
        action_delay: int = 0,
        randomisation: Randomisation | None = None,
    ):
        super().__init__(action_delay=action_delay, randomisation=randomisation)
        self.robot, self.dt = robot, robot.body.dt
        self.max_steps = int(require_number("num_steps", num_steps, at_least=1))
        self.start_speed = require_number("start_speed", start_speed, at_least=0.0)
        self.current = require_number("current", current, at_least=0.0)
        if self.current and robot.water is None:
            raise ValueError(f"current must be 0: {robot.name} is not in water")
        self.actions = tuple(Entry(name, -1.0, 1.0) for name in robot.command_names)
        self.observations = tuple(
            Entry(f"velocity {axis} of node {int(node)}", -math.inf, math.inf, "m/s")
            for node in robot.sensors
            for axis in "xyz"
        )
        shape = robot.body.mesh
        surface = (
            mesh.surface_quads(shape)
            if isinstance(shape, mesh.HexMesh)
            else mesh.surface_triangles(shape)
        )
        self._faces = surface.faces
        self._extent = float((robot.body.x_rest.amax(0) - robot.body.x_rest.amin(0)).max())

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """The rest shape, drifting as a whole."""
        x = self.robot.body.x_rest.expand(batch, -1, -1).clone()
        drift = torch.from_numpy(self.start_speed * rng.standard_normal((batch, 1, 3)))
        state = {"x": x, "v": drift.expand_as(x).clone()}
        if self.robot.obstacles:
            state["contact_force"] = torch.zeros_like(x)
        if self.robot.water is not None:
            state["current"] = torch.from_numpy(self.current * rng.standard_normal((batch, 3)))
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One time step of the body."""
        given = {k: state[k] for k in _BODY if k in state}
        command = action * self.factor(state, "muscles")[:, None]
        gain, current = None, state.get("current")
        if "random.water" in state:
            gain = state["random.water"][:, None, None]
        after = self.robot.step(soft.State(**given), command, water_velocity=current, gain=gain)
        out = {k: v for k, v in after._asdict().items() if v is not None and k in _BODY}
        if current is not None:
            out["current"] = current
        return out

    def observe(self, state: TaskState) -> Tensor:
        """Velocities of the sensors' nodes."""
        return state["v"][:, self.robot.sensors].flatten(1)

    def velocity(self, state: TaskState) -> Tensor:
        """Of the centre, (batch, 3) [m/s]."""
        return self.robot.centre(state["v"])

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """The skin, the camera following the centre."""
        x = state["x"][index].detach()
        ground = 0.0 if self.robot.obstacles else None
        centre = self.robot.centre(x)
        return body_picture(x, self._faces, centre=centre, reach=0.6 * self._extent, ground=ground)


class Advance(SoftTask):
    """Move forward without drifting sideways: swim or walk.

    Reward per step: forward speed minus ``drift_weight`` times the speed across, both relative to
    ``speed_scale`` (thesis 4.1.6: a weighted sum of forward and lateral velocities).

    Args:
        robot, num_steps, **options: As for ``SoftTask``.
        drift_weight: Of the speed across [-].
        speed_scale: A good speed of this robot [m/s]; only scales the reward.
    """

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        drift_weight: float = 0.5,
        speed_scale: float = 0.1,
        **options: object,
    ):
        super().__init__(robot, num_steps, **options)  # type: ignore[arg-type]
        self.drift_weight = require_number("drift_weight", drift_weight, at_least=0.0)
        self.speed_scale = require_number("speed_scale", speed_scale, above=0.0)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Forward and drift."""
        velocity = self.velocity(after) / self.speed_scale
        ahead = velocity @ self.robot.forward
        across = velocity - ahead[:, None] * self.robot.forward
        # smooth where there is no drift at all
        drift = (across.square().sum(-1) + 1e-4).sqrt() - 1e-2
        return {"forward": ahead, "drift": -self.drift_weight * drift}


class Reach(SoftTask):
    """Bring a node to a goal, drawn anew for each episode.

    Reward per step: minus the distance over ``reach``; observations are followed by the way from
    node to goal.

    Args:
        robot, num_steps, **options: As for ``SoftTask``.
        node: Which node.
        reach: Goals lie within a box of half this width about the node at rest [m].
    """

    def __init__(
        self, robot: SoftRobot, num_steps: int, *, node: int, reach: float, **options: object
    ):
        super().__init__(robot, num_steps, **options)  # type: ignore[arg-type]
        self.node, self.reach = node, require_number("reach", reach, above=0.0)
        self.observations += tuple(
            Entry(f"goal {axis} from the tip", -math.inf, math.inf, "m") for axis in "xyz"
        )

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """At rest, with a goal."""
        state = super().rest(batch, rng)
        offset = torch.from_numpy(rng.uniform(-0.5, 0.5, (batch, 3))) * self.reach
        state["goal"] = self.robot.body.x_rest[self.node] + offset
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """The goal stays."""
        return super().advance(state, action) | {"goal": state["goal"]}

    def observe(self, state: TaskState) -> Tensor:
        """Velocities, then the way to the goal."""
        return torch.cat([super().observe(state), state["goal"] - state["x"][:, self.node]], -1)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Distance and effort."""
        away = (after["goal"] - after["x"][:, self.node]) / self.reach
        distance = (away.square().sum(-1) + 1e-4).sqrt() - 1e-2
        return {"distance": -distance, "effort": -1e-3 * action.square().mean(-1)}
