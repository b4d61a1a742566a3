"""``task: SoftBody``: a task of any soft body, described by a file alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import soft
from diffsim.core.inside import inside
from diffsim.core.schema import read_part
from diffsim.core.units import in_unit
from diffsim.envs.kept import ValueOfTensors
from diffsim.envs.pictures import body_picture
from diffsim.envs.rewards import ControlStep, cosine
from diffsim.envs.soft_file_keys import Observed, SoftTaskKeys
from diffsim.envs.soft_model import FoundRobot
from diffsim.envs.task import Entry, Task, TaskState
from diffsim.identify.model_file import read_extended
from diffsim.systems.robots.robot import spread_nodes
from diffsim.systems.soft_body.robot import SCALED, DescribedRobot

WHOLE = 1e-6  # of a time step: how far a control period may be off whole time steps


class SoftBody(Task):
    """A described soft body under commands to its tendons, muscles and chambers.

    Made by ``make_task("eel.yaml")`` of a file with ``task: SoftBody``, or by
    ``make_task("SoftBody", model={...}, commands={...}, reward=[...])``. Its keys are
    :class:`~diffsim.envs.soft_file_keys.SoftTaskKeys`; ``model`` is that of a soft body's study,
    and simulated as there, but for forces of water and hung weights, see ``DescribedRobot.step``.

    An action of -1 and 1 is the lower and the upper value of a command; zero is their middle, under
    which an episode starts.

    Args:
        folder: Folder that files are relative to; None: the working folder.
        source: What messages call the keys, such as the file's path.
        **keys: Keys of the file.

    Raises:
        ValueError: a key that is wrong, with its path.
    """

    name = "SoftBody"
    length_option = "seconds"

    def __init__(self, *, folder: Path | None = None, source: str = "SoftBody", **keys: Any):
        self._made_of = (folder, source, keys)
        self.keys = given = read_part(SoftTaskKeys, keys, f"{source}: ")
        self.randomizable = ("drives", *SCALED, *(("water",) if given.model.water else ()))
        try:
            super().__init__(action_delay=given.action_delay, randomization=given.randomization)
            self.found = self._read_found(folder)
            self.robot = robot = self._make_robot(folder)
            low, high = self._command_range()
            self.dt = self._control_period()
            self._start = robot.start(0.5 * (low + high))
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        self._middle, self._reach = 0.5 * (low + high), 0.5 * (high - low)
        self.max_steps = max(1, round(given.seconds / self.dt))
        self.substeps = round(self.dt / robot.body.dt)
        self._is_held = bool(robot.body.fixed.any())
        self._observed = given.observe or self._usual_observations()
        self.clock = torch.tensor(given.clock, dtype=torch.float64)
        self._nodes = spread_nodes(robot.body.x_rest, min(given.sensors, robot.body.mesh.num_nodes))
        self.actions = tuple(Entry(name, -1.0, 1.0) for name in robot.commands)
        self.observations = tuple(self._entries())
        count = len(self.observations)
        self.clock_inputs = tuple(range(count - 2 * len(self.clock), count))
        self._bodies: ValueOfTensors[tuple[DescribedRobot, soft.Physics]] | None = None
        self._rest_center = robot.center(robot.body.x_rest)

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (*self._made_of, self.name, self.max_steps)  # drives are closures

    def _read_found(self, folder: Path | None) -> FoundRobot | None:
        """What a diagnosis found of the body; None: nothing is said of one."""
        stated, given = self.keys.extended_model, self.keys
        if stated is None:
            return None
        path = Path(stated)
        if folder is not None and isinstance(stated, str):
            path = inside(folder, stated, "extended_model")
        saved = read_extended(path)
        plain = DescribedRobot.read(given.model, folder, given.setup, saved.numerics)
        return FoundRobot.read(saved, self._made_of[2]["model"], plain, folder, given.setup)

    def _make_robot(self, folder: Path | None) -> DescribedRobot:
        if self.found is not None:
            return self.found.robot()
        return DescribedRobot.read(self.keys.model, folder, self.keys.setup)

    @classmethod
    def merged(cls, stated: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
        """See ``Task``; ``model=FILE`` is an extended model of the file's ``model``."""
        given = dict(options)
        if isinstance(given.get("model"), str | Path):
            given["extended_model"] = Path(given.pop("model")).absolute()
        return {**stated, **given}

    @classmethod
    def of_options(
        cls, options: Mapping[str, Any], folder: Path | None = None, source: str | None = None
    ) -> SoftBody:
        """See ``Task``; options are the keys of a file."""
        if "folder" in options or "source" in options:
            name = "folder" if "folder" in options else "source"
            raise ValueError(f"{source or cls.name}: no key {name!r} here")
        return cls(folder=folder, source=source or cls.name, **options)

    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """The body as its description starts it, stirred a little, with a goal."""
        robot, given = self.robot, self.keys
        x = self._start.x.expand(batch, -1, -1).clone()
        v = self._start.v.expand(batch, -1, -1).clone()
        if given.start_speed:
            away = robot.body.x_rest - self._rest_center
            slope = torch.from_numpy(rng.standard_normal((batch, 3, 3)))
            stirred = away @ slope * (given.start_speed / float(away.norm(dim=1).max()))
            v = torch.where(robot.body.fixed, v, v + stirred)
        none = torch.zeros(batch, len(self.actions), dtype=torch.float64)
        out = {"x": x, "v": v, "action": none}
        if robot.body.integrator == "bdf2":
            out |= {"x_prev": x - robot.body.dt * v, "v_prev": v.clone()}
        if robot.scene.obstacles:
            out["contact_force"] = torch.zeros_like(x)
        if robot.scene.water is not None:
            out["current"] = torch.from_numpy(given.current * rng.standard_normal((batch, 3)))
        if given.goal is not None:
            out["goal"] = torch.from_numpy(rng.uniform(*given.goal.box, (batch, 3)))
        return out

    def start(self, batch: int, rng: np.random.Generator) -> TaskState:
        """See ``Task``; sizes of a posterior are drawn here."""
        state = super().start(batch, rng)
        if self.keys.posterior and self.found is not None:
            state["random.model"] = self.found.draw(batch, rng)
        return state

    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """One control step under a held command."""
        robot, physics = self._bodies_of(state)
        command = self._command(state, action)
        wet = {"current": state.get("current"), "gain": state.get("random.water")}
        now = soft.State(**{k: state[k] for k in soft.State._fields if k in state})
        for _ in range(self.substeps):
            now = robot.step(now, command, physics, **wet)
        kept = {k: v for k, v in now._asdict().items() if v is not None and k in state}
        more = {k: state[k] for k in ("current", "goal") if k in state}
        return kept | more | {"action": action}

    def observe(self, state: TaskState) -> Tensor:
        """What the file asks for, then the clock."""
        seen = [self._observation(kind, state) for kind in self._observed]
        if len(self.clock):
            turn = 2.0 * math.pi * self.dt * state["step"].double()[:, None] * self.clock
            seen.append(torch.stack([torch.sin(turn), torch.cos(turn)], -1).flatten(1))
        return torch.cat(seen, 1)

    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Terms of the file by name."""
        goal = self.keys.goal
        robot, physics = self._bodies_of(after)
        step = ControlStep(
            robot=robot,
            dt=self.dt,
            x_before=before["x"],
            x=after["x"],
            action=after["action"],
            action_before=before["action"],
            command=self._command(after, after["action"]),
            command_before=self._command(before, before["action"]),
            physics=physics,
            goal=after.get("goal"),
            goal_markers=() if goal is None else goal.markers,
        )
        return {term.term: term.weight * term.earned(step) for term in self.keys.reward}

    def failed(self, state: TaskState) -> Tensor:
        """What ``ends`` says."""
        ends, out = self.keys.ends, super().failed(state)
        center = self.robot.center(state["x"])
        if ends.tilt is not None:
            out = out | (cosine(self.robot, state["x"], "z") < math.cos(ends.tilt))
        if ends.below is not None:
            out = out | (center[:, 2] < ends.below)
        if ends.away is not None:
            begin = self.robot.center(self._start.x)
            out = out | (torch.linalg.vector_norm(center - begin, dim=-1) > ends.away)
        return out

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """The skin; the camera follows the center, or stands still before a body that is held."""
        x = state["x"][index].detach()
        return body_picture(
            x,
            self.robot.faces(),
            center=self._rest_center if self._is_held else self.robot.center(x),
            reach=(0.8 if self._is_held else 0.55) * self.robot.length,
            ground=self._ground(),
            goal=state["goal"][index] if "goal" in state else None,
        )

    # parts of the above

    def _command_range(self) -> tuple[Tensor, Tensor]:
        """Commands at the actions -1 and 1, (num_commands,) each."""
        rows = []
        for name, unit in zip(self.robot.commands, self.robot.units, strict=True):
            try:
                low, high = (in_unit(v, unit) for v in self.keys.commands[name])
            except ValueError as error:
                raise ValueError(f"commands.{name}: {error}") from None
            if not (math.isfinite(low) and math.isfinite(high) and low != high):
                raise ValueError(
                    f"commands.{name} must be two finite numbers that differ, its values at the "
                    f"actions -1 and 1, got {low:g} and {high:g}"
                )
            rows.append((low, high))
        ends = torch.tensor(rows, dtype=torch.float64)
        return ends[:, 0], ends[:, 1]

    def _control_period(self) -> float:
        step, given = self.robot.body.dt, self.keys.control_step
        if given is None:
            return step
        count = round(given / step)
        if count < 1 or abs(given / step - count) > WHOLE * count:
            raise ValueError(
                f"control_step must be a whole number of the model's time steps, numerics.time_step"
                f" = {step:g} s, got {given:g} s; change one of them"
            )
        return count * step

    def _usual_observations(self) -> tuple[Observed, ...]:
        wanted: dict[Observed, bool] = {
            "velocities": True,
            "places": self._is_held,
            "lying": bool(self.robot.scene.obstacles),
            "goal": self.keys.goal is not None,
        }
        return tuple(kind for kind, is_wanted in wanted.items() if is_wanted)

    def _at_sensors(self, field: Tensor) -> Tensor:
        """A nodal field (batch, num_nodes, 3) at the markers, or at the sensors' nodes."""
        if self.robot.look.markers:
            return self.robot.places(field)
        return field[:, self._nodes]

    def _observation(self, kind: Observed, state: TaskState) -> Tensor:
        """(batch, n) of one kind."""
        x, robot = state["x"], self.robot
        if kind == "velocities":
            return self._at_sensors(state["v"]).flatten(1)
        if kind == "places":
            moved = x - (robot.body.x_rest if self._is_held else robot.center(x)[:, None])
            return self._at_sensors(moved).flatten(1)
        if kind == "lying":
            return torch.cat([robot.center(x)[:, 2:], robot.attitude(x).flatten(1)], 1)
        assert self.keys.goal is not None  # checked when the file was read
        return state["goal"] - robot.middle(self.keys.goal.markers, x)

    def _entries(self) -> list[Entry]:
        inf = math.inf
        points = self.robot.look.markers or tuple(f"node {int(n)}" for n in self._nodes)
        origin = "rest" if self._is_held else "the center"
        by_kind: dict[Observed, list[Entry]] = {
            "velocities": [
                Entry(f"velocity {a} of {p}", -inf, inf, "m/s") for p in points for a in "xyz"
            ],
            "places": [
                Entry(f"{p} from {origin}, {a}", -inf, inf, "m") for p in points for a in "xyz"
            ],
            "lying": [
                Entry("height of the center", -inf, inf, "m"),
                *(Entry(f"deformation {r}{c}", -inf, inf) for r in "xyz" for c in "xyz"),
            ],
            "goal": [Entry(f"way to the goal, {a}", -inf, inf, "m") for a in "xyz"],
        }
        out = [entry for kind in self._observed for entry in by_kind[kind]]
        return out + [
            Entry(f"{f} of a clock of {hertz:g} Hz", -1.0, 1.0)
            for hertz in self.clock.tolist()
            for f in ("sine", "cosine")
        ]

    def _command(self, state: TaskState, action: Tensor) -> Tensor:
        """Commands in their units, (batch, num_commands)."""
        command = self._middle + self._reach * action
        return command * state["random.drives"][:, None] if "random.drives" in state else command

    def _bodies_of(self, state: TaskState) -> tuple[DescribedRobot, soft.Physics]:
        """The bodies and their parameters; what is random stays the same within an episode."""
        factors = {n: state[f"random.{n}"] for n in SCALED if f"random.{n}" in state}
        sizes = state.get("random.model")
        tensors = [*factors.values(), *(() if sizes is None else (sizes,))]
        kept = self._bodies
        if kept is None or not kept.is_of(tensors):
            robot = self.robot
            if sizes is not None and self.found is not None:
                robot = self.found.robots(sizes)
            kept = ValueOfTensors((robot, robot.physics(factors)), tensors)
            if not any(t.requires_grad for t in tensors):
                self._bodies = kept
        return kept.value

    def _ground(self) -> float | None:
        """Height of a level wall below; None: there is none."""
        level = [w.offset for w in self.keys.model.walls if w.normal[:2] == (0.0, 0.0)]
        return level[0] if level else None


def _made_again(
    folder: Path | None, source: str, keys: dict[str, Any], name: str, max_steps: int
) -> SoftBody:
    """A task that was pickled."""
    made = SoftBody(folder=folder, source=source, **keys)
    made.name, made.max_steps = name, max_steps
    return made
