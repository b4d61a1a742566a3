"""The soft-body tasks that have a name: robot, reward, and usual options such as the length.

Their data sheets are those of the environments in ``environments.yaml``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.check import require_number, require_options
from diffsim.envs.pictures import body_picture
from diffsim.envs.soft_tasks import Advance, Reach, SoftTask
from diffsim.envs.task import Entry, TaskState
from diffsim.systems import robots
from diffsim.systems.robots import SoftRobot

OBSERVED_SCALE = 0.1  # of lengths and velocities, as in the published task


class Jump(SoftTask):
    """Go forward, and be above where the episode began.

    Reward per control step: ``forward_weight`` times the center's mean forward speed [m/s], plus
    ``rise_weight`` times its height above the start's [m], minus ``effort_weight`` times the sum
    of squared commands (Xing, Luk, Oh 2025, arXiv:2412.12089, soft jumper).

    Observed are the center's position and velocity, the last commands, and all nodes from the
    center; lengths and velocities times 0.1.

    An episode begins at rest above the floor, aside, with all nodes scaled about the middle of the
    soles: a body that is not in its rest shape starts by ringing.

    Args:
        robot, num_steps, **options: The same as for ``SoftTask``.
        forward_weight, rise_weight, effort_weight: Weights above [s/m], [1/m], [-].
        drop: Greatest height of the soles above the floor at the start [m].
        aside: Greatest distance from the origin along x and along y at the start [m].
        size_spread: Greatest relative change of the size at the start [-], below 1.
    """

    name = "Jump"

    def __init__(
        self,
        robot: SoftRobot,
        num_steps: int,
        *,
        forward_weight: float = 1.0,
        rise_weight: float = 3.0,
        effort_weight: float = 1e-3,
        drop: float = 0.4,
        aside: float = 0.8,
        size_spread: float = 0.1,
        **options: Any,
    ):
        super().__init__(robot, num_steps, **options)
        self.forward_weight = require_number("forward_weight", forward_weight, at_least=0.0)
        self.rise_weight = require_number("rise_weight", rise_weight, at_least=0.0)
        self.effort_weight = require_number("effort_weight", effort_weight, at_least=0.0)
        self.drop = require_number("drop", drop, at_least=0.0)
        self.aside = require_number("aside", aside, at_least=0.0)
        self.size_spread = require_number("size_spread", size_spread, at_least=0.0, below=1.0)

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """At rest in the air, a little larger or smaller than it wants to be."""
        state = super().rest(batch, rng)
        size = 1.0 + rng.uniform(-self.size_spread, self.size_spread, (batch, 1, 1))
        aside = rng.uniform(-self.aside, self.aside, (batch, 1, 2))
        shift = np.concatenate([aside, rng.uniform(0.0, self.drop, (batch, 1, 1))], -1)
        state["x"] = torch.from_numpy(size) * state["x"] + torch.from_numpy(shift)
        state["start_height"] = self.robot.center(state["x"])[:, 2]
        state["last_command"] = torch.zeros(batch, self.num_actions, dtype=torch.float64)
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """The height to surpass stays; the command is remembered."""
        memory = {"start_height": state["start_height"], "last_command": action}
        return super().advance(state, action) | memory

    def observe(self, state: TaskState) -> Tensor:
        """Center, its velocity, last commands, nodes; the clock."""
        center = self.robot.center(state["x"])
        nodes = (state["x"] - center[:, None]).flatten(1)
        motion = torch.cat([center, self.robot.center(state["v"])], 1)
        seen = [OBSERVED_SCALE * motion, state["last_command"], OBSERVED_SCALE * nodes]
        if len(self.clock):
            seen.append(self._hands(state))
        return torch.cat(seen, 1)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Forward, rise and effort."""
        center = self.robot.center(after["x"])
        moved = center - self.robot.center(before["x"])
        rise = center[:, 2] - after["start_height"]
        return {
            "forward": self.forward_weight * (moved @ self.robot.forward) / self.dt,
            "rise": self.rise_weight * rise,
            "effort": -self.effort_weight * action.square().sum(-1),
        }

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """The skin; the camera goes along but not up."""
        x = state["x"][index].detach()
        center = self.robot.center(x)
        center[2] = 0.55 * self._extent
        return body_picture(x, self._faces, center=center, reach=0.9 * self._extent, ground=0.0)

    def _entries(self) -> list[Entry]:
        inf = math.inf
        out = [Entry(f"center {axis}, times 0.1", -inf, inf, "m") for axis in "xyz"]
        out += [
            Entry(f"velocity {axis} of the center, times 0.1", -inf, inf, "m/s") for axis in "xyz"
        ]
        out += [Entry(f"last command {k}", -1.0, 1.0) for k in range(self.num_actions)]
        out += [
            Entry(f"node {node} from the center, {axis}, times 0.1", -inf, inf, "m")
            for node in range(self.robot.body.mesh.num_nodes)
            for axis in "xyz"
        ]
        return out + self._clock_entries()


class NamedSoftTask(SoftTask):
    """A task whose robot is made of options.

    Args:
        robot: Arguments of the function that makes it; None: its defaults.
        **options: Options of the reward and of every soft task, in place of the usual ones.
    """

    make: ClassVar[Callable[..., SoftRobot]]  # function that makes the robot
    usual: ClassVar[Mapping[str, Any]]  # options where nothing else is asked for

    def __init__(self, *, robot: Mapping[str, Any] | None = None, **options: Any):
        given = dict(robot or {})
        require_options(f"robot {self.make.__name__}", given, self.make)
        super().__init__(self.make(**given), **{**self.usual, **options})


class StarfishSwim(NamedSoftTask, Advance):
    """See ``StarfishSwimEnv``."""

    name, make = "StarfishSwim", staticmethod(robots.starfish)
    usual = MappingProxyType({"num_steps": 200, "start_speed": 0.1})


class SharkSwim(NamedSoftTask, Advance):
    """See ``SharkSwimEnv``."""

    name, make = "SharkSwim", staticmethod(robots.shark)
    usual = StarfishSwim.usual


class QuadrupedWalk(NamedSoftTask, Advance):
    """See ``QuadrupedWalkEnv``."""

    name, make = "QuadrupedWalk", staticmethod(robots.quadruped)
    usual = MappingProxyType({"num_steps": 100})


class CowWalk(NamedSoftTask, Advance):
    """See ``CowWalkEnv``."""

    name, make = "CowWalk", staticmethod(robots.cow)
    usual = MappingProxyType({"num_steps": 60, "substeps": 10, "rise_weight": 0.3})


class TorusRoll(NamedSoftTask, Advance):
    """See ``TorusRollEnv``."""

    name, make = "TorusRoll", staticmethod(robots.torus)
    usual = MappingProxyType({"num_steps": 100, "substeps": 4})


class TendonReach(NamedSoftTask, Reach):
    """See ``TendonReachEnv``."""

    name, make = "TendonReach", staticmethod(robots.tendon_arm)
    usual = MappingProxyType(
        {"num_steps": 100, "goal_low": (-0.12, -0.12, -0.06), "goal_high": (0.12, 0.12, 0.02)}
    )


class SoftJumper(NamedSoftTask, Jump):
    """See ``SoftJumperEnv``."""

    name, make = "SoftJumper", staticmethod(robots.soft_jumper)
    usual = MappingProxyType({"num_steps": 300, "substeps": 2})
