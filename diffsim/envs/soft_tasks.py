"""Soft robots that swim, walk and reach."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import mesh, soft
from diffsim.core.check import require_count, require_number
from diffsim.envs.pictures import body_picture
from diffsim.envs.task import Entry, Randomizing, Task, TaskState
from diffsim.systems.robots import SoftRobot

_BODY = ("x", "v", "x_prev", "v_prev", "contact_force")
_CLOCK = ("sine", "cosine")
MIN_UPRIGHT = 0.5  # of the upright axis's share along its old direction: a tilt of 60 degrees


class SoftTask(Task):
    """A soft robot under commands to its muscles; what is rewarded, subclasses say.

    Observed are the velocities of the sensors' nodes; on a floor also the height of the center and
    the mean deformation gradient (``SoftRobot.attitude``): how the robot lies and is stretched.

    Args:
        robot: Body, muscles, surroundings.
        num_steps: Length of an episode in control steps.
        substeps: Time steps of the body per control step.
        start_speed: The episode begins with velocities linear in place, at random, as large as
            this at the farthest nodes; the center is at rest [m/s].
        current: Standard deviation of each component of the episode's current [m/s]; in water.
        clock: Frequencies of a clock [Hz], observed after all else as the sine and cosine of
            each since the episode's start. A gait is a matter of time; velocities alone do not tell
            a controller at rest when to begin a stroke.
        action_delay, randomization: As every task has them; ``muscles`` (their stroke) and,
            in water, ``water`` (drag and thrust) may be randomized, per member of a batch.

    An episode fails when the robot has an upright axis and tips over.
    """

    name = "SoftTask"

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        substeps: int = 1,
        start_speed: float = 0.0,
        current: float = 0.0,
        clock: Sequence[float] = (),
        action_delay: int = 0,
        randomization: Randomizing = None,
    ):
        self.randomizable = ("muscles",) if robot.water is None else ("muscles", "water")
        super().__init__(action_delay=action_delay, randomization=randomization)
        self.robot = robot
        self.substeps = require_count("substeps", substeps, at_least=1)
        self.dt = robot.body.dt * self.substeps
        self.max_steps = require_count("num_steps", num_steps, at_least=1)
        self.start_speed = require_number("start_speed", start_speed, at_least=0.0)
        self.current = require_number("current", current, at_least=0.0)
        if self.current and robot.water is None:
            raise ValueError(f"current must be 0: the {robot.name} is not in water")
        self.clock = _frequencies(clock)
        self.actions = tuple(Entry(name, -1.0, 1.0) for name in robot.command_names)
        self.observations = tuple(self._entries())
        clocked = 2 * len(self.clock)
        self.clock_inputs = tuple(range(len(self.observations))[-clocked:] if clocked else ())
        shape = robot.body.mesh
        surface = (
            mesh.surface_quads(shape)
            if isinstance(shape, mesh.HexMesh)
            else mesh.surface_triangles(shape)
        )
        self._faces = surface.faces
        self._extent = float((robot.body.x_rest.amax(0) - robot.body.x_rest.amin(0)).max())

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """The rest shape, stirred a little."""
        body = self.robot.body
        x = body.x_rest.expand(batch, -1, -1).clone()
        state = {"x": x, "v": torch.zeros_like(x)}
        if self.start_speed:
            away = body.x_rest - self.robot.center(body.x_rest)
            slope = torch.from_numpy(rng.standard_normal((batch, 3, 3)))
            v = away @ slope * (self.start_speed / float(away.norm(dim=1).max()))
            state["v"] = torch.where(body.fixed, torch.zeros_like(v), v)
        if self.robot.obstacles:
            state["contact_force"] = torch.zeros_like(x)
        if self.robot.water is not None:
            state["current"] = torch.from_numpy(self.current * rng.standard_normal((batch, 3)))
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One control step."""
        command = action
        if "random.muscles" in state:
            command = action * state["random.muscles"][:, None]
        gain, current = None, state.get("current")
        if "random.water" in state:
            gain = state["random.water"][:, None, None]
        now = soft.State(**{k: state[k] for k in _BODY if k in state})
        for _ in range(self.substeps):
            now = self.robot.step(now, command, water_velocity=current, gain=gain)
        out = {k: v for k, v in now._asdict().items() if v is not None and k in _BODY}
        if current is not None:
            out["current"] = current
        return out

    def observe(self, state: TaskState) -> Tensor:
        """Velocities of the sensors' nodes; on a floor also height and attitude; the clock."""
        seen = [state["v"][:, self.robot.sensors].flatten(1), *self._lying(state)]
        if len(self.clock):
            seen.append(self._hands(state))
        return torch.cat(seen, 1) if len(seen) > 1 else seen[0]

    def failed(self, state: TaskState) -> Tensor:
        """Tipped over."""
        axis = self.robot.upright_axis
        if axis is None:
            return super().failed(state)
        return self.robot.attitude(state["x"])[:, axis, axis] < MIN_UPRIGHT

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """The skin; the camera follows the center, or stands still before a robot that is fixed."""
        x, body = state["x"][index].detach(), self.robot.body
        fixed = bool(body.fixed.any())
        return body_picture(
            x,
            self._faces,
            center=self.robot.center(body.x_rest if fixed else x),
            reach=(0.8 if fixed else 0.55) * self._extent,
            ground=0.0 if self.robot.obstacles or fixed else None,
            goal=state["goal"][index] if "goal" in state else None,
        )

    def _lying(self, state: TaskState) -> list[Tensor]:
        """Height of the center (batch, 1) and mean deformation gradient (batch, 9); on a floor."""
        if not self.robot.obstacles:
            return []
        height = self.robot.center(state["x"])[:, 2:]
        return [height, self.robot.attitude(state["x"]).flatten(1)]

    def _hands(self, state: TaskState) -> Tensor:
        """Sine and cosine of each frequency of the clock, (batch, 2 len(clock))."""
        turn = 2.0 * math.pi * self.dt * state["step"].double()[:, None] * self.clock
        return torch.stack([torch.sin(turn), torch.cos(turn)], -1).flatten(1)

    def _entries(self) -> list[Entry]:
        inf = math.inf
        out = [
            Entry(f"velocity {axis} of node {int(node)}", -inf, inf, "m/s")
            for node in self.robot.sensors
            for axis in "xyz"
        ]
        if self.robot.obstacles:
            out.append(Entry("height of the center", -inf, inf, "m"))
            out += [Entry(f"deformation {r}{c}", -inf, inf) for r in "xyz" for c in "xyz"]
        return out + self._clock_entries()

    def _clock_entries(self) -> list[Entry]:
        return [
            Entry(f"{f} of a clock of {frequency:g} Hz", -1.0, 1.0)
            for frequency in self.clock.tolist()
            for f in _CLOCK
        ]


class Advance(SoftTask):
    """Move forward without drifting sideways: swim, walk or roll.

    Reward per control step: the center's mean forward speed minus ``drift_weight`` times its speed
    across, plus ``rise_weight`` times its upward speed, all over ``speed_scale`` (thesis 4.1.6: a
    weighted sum of forward and lateral velocities). Forward terms sum to the distance traveled.
    On a floor, across is horizontal.

    Args:
        robot, num_steps, **options: The same as for ``SoftTask``.
        drift_weight: Weight of the speed across [-].
        rise_weight: Weight of the upward speed [-]; 0.3 keeps the thesis's cow upright.
        speed_scale: A good speed of this robot [m/s]; only scales the reward.
    """

    name = "Advance"

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        drift_weight: float = 0.5,
        rise_weight: float = 0.0,
        speed_scale: float = 0.1,
        **options: object,
    ):
        super().__init__(robot, num_steps, **options)  # type: ignore[arg-type]
        self.drift_weight = require_number("drift_weight", drift_weight, at_least=0.0)
        self.rise_weight = require_number("rise_weight", rise_weight, at_least=0.0)
        self.speed_scale = require_number("speed_scale", speed_scale, above=0.0)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Forward, drift and, if it counts, rise."""
        moved = self.robot.center(after["x"] - before["x"])
        velocity = moved / (self.dt * self.speed_scale)
        ahead = velocity @ self.robot.forward
        across = velocity - ahead[:, None] * self.robot.forward
        if self.robot.obstacles:
            across = across[:, :2]
        # smooth where there is no drift at all
        drift = (across.square().sum(-1) + 1e-4).sqrt() - 1e-2
        terms = {"forward": ahead, "drift": -self.drift_weight * drift}
        if self.rise_weight:
            terms["rise"] = self.rise_weight * velocity[:, 2]
        return terms


class Reach(SoftTask):
    """Bring a node to a goal, drawn anew for each episode.

    Reward per control step: minus the distance over the robot's length, and minus a little effort.
    Observations are followed by the way from node to goal.

    Args:
        robot, num_steps, **options: The same as for ``SoftTask``.
        goal_low, goal_high: Corners of the box of goals, relative to the node at rest [m].
        node: Which node; None: the robot's last sensor.
        effort_weight: Weight of the mean squared command [-].
    """

    name = "Reach"

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        goal_low: Sequence[float],
        goal_high: Sequence[float],
        node: int | None = None,
        effort_weight: float = 1e-3,
        **options: object,
    ):
        super().__init__(robot, num_steps, **options)  # type: ignore[arg-type]
        self.node = int(robot.sensors[-1]) if node is None else node
        self.goal_low, self.goal_high = np.array(goal_low, float), np.array(goal_high, float)
        ordered = self.goal_low.shape == self.goal_high.shape == (3,)
        if not ordered or bool((self.goal_low > self.goal_high).any()):
            raise ValueError(
                "goal_low and goal_high must have three entries each, goal_low <= goal_high, got "
                f"{list(goal_low)} and {list(goal_high)}"
            )
        self.effort_weight = require_number("effort_weight", effort_weight, at_least=0.0)
        self.observations += tuple(
            Entry(f"goal {axis} from node {self.node}", -math.inf, math.inf, "m") for axis in "xyz"
        )

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """At rest, with a goal."""
        state = super().rest(batch, rng)
        offset = torch.from_numpy(rng.uniform(self.goal_low, self.goal_high, (batch, 3)))
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
        away = (after["goal"] - after["x"][:, self.node]) / self._extent
        distance = (away.square().sum(-1) + 1e-4).sqrt() - 1e-2
        effort = self.effort_weight * action.square().mean(-1)
        return {"distance": -distance, "effort": -effort}


def _frequencies(clock: Sequence[float]) -> Tensor:
    """(n,) [Hz], checked."""
    rates = [clock] if isinstance(clock, int | float) else list(clock)
    checked = [require_number("clock", rate, above=0.0) for rate in rates]
    return torch.tensor(checked, dtype=torch.float64)
