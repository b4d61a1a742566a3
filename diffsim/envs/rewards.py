"""What a described soft body may be rewarded for: a list of terms, each with its weight.

A term is a block of a task file; its class is its keys, and what it pays for a control step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag
from torch import Tensor

from diffsim import soft
from diffsim.core.check import require_choice
from diffsim.core.schema import Part
from diffsim.core.schema_numbers import MetersPerSecond, Watts
from diffsim.systems.soft_body.readings import AXES
from diffsim.systems.soft_body.robot import DescribedRobot

SMOOTH = 1e-2  # below this share of its unit, a distance is quadratic


@dataclass(frozen=True, eq=False)
class ControlStep:
    """One control step, as terms of a reward see it."""

    robot: DescribedRobot
    dt: float  # control period [s]
    # x_before, x: nodes at its start and end, (batch, num_nodes, 3) [m]
    x_before: Tensor
    x: Tensor
    # action, action_before: of this step and of the one before, (batch, num_actions) [-]
    action: Tensor
    action_before: Tensor
    # command, command_before: the same in their units, as they reached the drives
    command: Tensor
    command_before: Tensor
    physics: soft.Physics  # parameters of the body
    goal: Tensor | None  # what markers shall reach, (batch, 3) [m]; None: the task has none
    goal_markers: tuple[str, ...]

    def velocity(self) -> Tensor:
        """Of the center, mean of the step, (batch, 3) [m/s]."""
        return (self.robot.center(self.x) - self.robot.center(self.x_before)) / self.dt


def _read_direction(given: Any) -> Any:
    return AXES.get(given, given) if isinstance(given, str) else given


def _check_direction(given: tuple[float, float, float]) -> tuple[float, float, float]:
    if not 0.0 < math.hypot(*given) < math.inf:
        raise ValueError(f"must be a direction: x, y, z or three numbers, not all 0, got {given}")
    return given


#: x, y, z, or three numbers.
Direction = Annotated[
    tuple[float, float, float], BeforeValidator(_read_direction), AfterValidator(_check_direction)
]


class Term(Part):
    """What all terms of a reward share."""

    needs_goal: ClassVar[bool] = False
    weight: float = Field(1.0, ge=0, description="Factor on the term")

    def earned(self, step: ControlStep) -> Tensor:
        """What a control step earns without the weight, (batch,); costs are below zero."""
        raise NotImplementedError


class Speed(Term):
    """Pays for the speed of the center along a direction; sums to the distance traveled."""

    term: Literal["speed"] = Field(description="Name of the term")
    along: Direction = Field((1.0, 0.0, 0.0), description="x, y, z or a vector")
    per: MetersPerSecond = Field(0.1, gt=0, description="Speed that pays 1 per step [m/s]")

    def earned(self, step: ControlStep) -> Tensor:
        """Speed along over ``per``."""
        return step.velocity() @ _unit(self.along) / self.per


class Drift(Term):
    """Costs the speed of the center across a direction."""

    term: Literal["drift"] = Field(description="Name of the term")
    along: Direction = Field((1.0, 0.0, 0.0), description="x, y, z or a vector, which is free")
    per: MetersPerSecond = Field(0.1, gt=0, description="Speed that costs 1 per step [m/s]")

    def earned(self, step: ControlStep) -> Tensor:
        """Minus the speed across over ``per``, smooth where there is none."""
        velocity, along = step.velocity() / self.per, _unit(self.along)
        return -_smooth_norm(velocity - (velocity @ along)[:, None] * along)


class Distance(Term):
    """Costs the distance of the goal's markers from the goal, over the body's length."""

    needs_goal: ClassVar[bool] = True
    term: Literal["distance"] = Field(description="Name of the term")

    def earned(self, step: ControlStep) -> Tensor:
        """Minus the distance over the body's largest extent at rest."""
        assert step.goal is not None  # checked when the file was read
        away = step.goal - step.robot.middle(step.goal_markers, step.x)
        return -_smooth_norm(away / step.robot.length)


class Height(Term):
    """Pays for the height of the center above where it is at rest, over the body's length."""

    term: Literal["height"] = Field(description="Name of the term")

    def earned(self, step: ControlStep) -> Tensor:
        """Height over the body's largest extent at rest."""
        rest = step.robot.center(step.robot.body.x_rest)
        return (step.robot.center(step.x) - rest)[:, 2] / step.robot.length


class Upright(Term):
    """Pays for an axis of the body that points where it did at rest: the cosine of its tilt."""

    term: Literal["upright"] = Field(description="Name of the term")
    axis: Literal["x", "y", "z"] = Field("z", description="Which axis")

    def earned(self, step: ControlStep) -> Tensor:
        """Cosine of the tilt; 1 at best."""
        return cosine(step.robot, step.x, self.axis)


class Effort(Term):
    """Costs the mean squared action."""

    term: Literal["effort"] = Field(description="Name of the term")

    def earned(self, step: ControlStep) -> Tensor:
        """Minus the mean squared action."""
        return -step.action.square().mean(-1)


class Change(Term):
    """Costs the mean squared change of the action from step to step: jerks wear a drive out."""

    term: Literal["change"] = Field(description="Name of the term")

    def earned(self, step: ControlStep) -> Tensor:
        """Minus the mean squared change."""
        return -(step.action - step.action_before).square().mean(-1)


class Energy(Term):
    """Costs the power that the drives put into the body; what they get back counts nothing.

    Tendons and muscles work while their length of rest changes, at the step's start: the elastic
    energy before and after at the same shape. Chambers work while their volume changes.
    """

    term: Literal["energy"] = Field(description="Name of the term")
    per: Watts = Field(1.0, gt=0, description="Mean power that costs 1 per step [W]")

    def earned(self, step: ControlStep) -> Tensor:
        """Minus the mean power over ``per``."""
        robot, body, work = step.robot, step.robot.body, torch.zeros_like(step.x[:, 0, 0])
        now, then = (robot.activation(c) for c in (step.command, step.command_before))
        if now is not None:
            after, before = (
                body.elastic_energy(step.x_before, activation=a, physics=step.physics)
                for a in (now, then)
            )
            work = work + after - before
        if (pressure := robot.pressure(step.command)) is not None:
            grown = body.chambers.volumes(step.x) - body.chambers.volumes(step.x_before)
            work = work + (pressure * grown).sum(-1)
        return -work.clamp(min=0.0) / (step.dt * self.per)


class Alive(Term):
    """Pays 1 in every step: where episodes may fail, staying must be worth more than costs."""

    term: Literal["alive"] = Field(description="Name of the term")

    def earned(self, step: ControlStep) -> Tensor:
        """One."""
        return torch.ones_like(step.x[:, 0, 0])


TERMS: Mapping[str, type[Term]] = {
    "speed": Speed,
    "drift": Drift,
    "distance": Distance,
    "height": Height,
    "upright": Upright,
    "effort": Effort,
    "change": Change,
    "energy": Energy,
    "alive": Alive,
}


def _check_term(given: Any) -> Any:
    if isinstance(given, Term):
        return given
    if not isinstance(given, Mapping) or "term" not in given:
        raise ValueError(
            f"must be a mapping with `term`, one of {', '.join(TERMS)}, got {given!r}; such as "
            "{term: speed, weight: 1}"
        )
    require_choice("term", str(given["term"]), TERMS)
    return given


def _name_of(given: Any) -> str:
    name = given.term if isinstance(given, Term) else given["term"]  # type: ignore[attr-defined]
    return f"<{name}>"  # brackets: no key of the file


#: One term of a reward, by its name.
RewardTerm = Annotated[
    Annotated[Speed, Tag("<speed>")]
    | Annotated[Drift, Tag("<drift>")]
    | Annotated[Distance, Tag("<distance>")]
    | Annotated[Height, Tag("<height>")]
    | Annotated[Upright, Tag("<upright>")]
    | Annotated[Effort, Tag("<effort>")]
    | Annotated[Change, Tag("<change>")]
    | Annotated[Energy, Tag("<energy>")]
    | Annotated[Alive, Tag("<alive>")],
    Discriminator(_name_of),
    BeforeValidator(_check_term),
]


def cosine(robot: DescribedRobot, x: Tensor, axis: str) -> Tensor:
    """Cosine of the angle by which an axis of the body has turned, (batch,)."""
    k = "xyz".index(axis)
    points = robot.attitude(x)[..., k]
    return points[:, k] / torch.linalg.vector_norm(points, dim=-1)


def _unit(direction: tuple[float, float, float]) -> Tensor:
    vector = torch.tensor(direction, dtype=torch.float64)
    return vector / torch.linalg.vector_norm(vector)


def _smooth_norm(vector: Tensor) -> Tensor:
    return (vector.square().sum(-1) + SMOOTH**2).sqrt() - SMOOTH
