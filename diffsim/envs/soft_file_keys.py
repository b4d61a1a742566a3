"""Keys of a task file of ``task: SoftBody``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from diffsim.core.check import did_you_mean
from diffsim.core.schema import FinitePart, Names, Part
from diffsim.core.schema_numbers import Hertz, Meters, MetersPerSecond, Radians, Seconds
from diffsim.core.schema_paths import PathInside
from diffsim.envs.rewards import RewardTerm
from diffsim.systems.soft_body.body_keys import SoftBodyKeys
from diffsim.systems.soft_body.places import Point

Observed = Literal["velocities", "places", "lying", "goal"]


def _fill_in_watchers(given: Any) -> Any:
    """A robot need not be watched as a recorded body is: markers and channels may be left out."""
    return {"markers": {}, "channels": {}, **given} if isinstance(given, Mapping) else given


class Goal(Part):
    """A point that markers shall reach: fixed, or drawn for each episode."""

    markers: Names = Field(description="Which markers: one, or several, whose mean is meant")
    at: Point | None = Field(None, description="Where the goal is [m]")
    low: Point | None = Field(None, description="Instead of `at`: lowest corner of its box [m]")
    high: Point | None = Field(None, description="Instead of `at`: highest corner of its box [m]")

    @model_validator(mode="after")
    def _check_one_place(self) -> Goal:
        boxed = (self.low is not None, self.high is not None)
        if (self.at is None) != all(boxed) or any(boxed) != all(boxed):
            raise ValueError("give at, or low and high, the corners of a box")
        if any(a > b for a, b in zip(*self.box, strict=True)):
            raise ValueError(f"low must not be above high, got {self.low} and {self.high}")
        if not self.markers:
            raise ValueError("markers must name at least one marker")
        return self

    @property
    def box(self) -> tuple[Point, Point]:
        """Its lowest and highest corner [m]."""
        if self.at is not None:
            return self.at, self.at
        assert self.low is not None and self.high is not None
        return self.low, self.high


class Ends(FinitePart):
    """What ends an episode before its time; each may be left out."""

    tilt: Radians | None = Field(None, gt=0, description="z axis turned by more than this [rad]")
    below: Meters | None = Field(None, description="Center lower than this [m]")
    away: Meters | None = Field(None, gt=0, description="Center farther from its start [m]")


class SoftTaskKeys(FinitePart):
    """A soft body, what drives it, and what it is rewarded for."""

    task: Literal["SoftBody"] = Field("SoftBody", description="Kind of task")
    model: Annotated[SoftBodyKeys, BeforeValidator(_fill_in_watchers)] = Field(
        description="The body, as `model:` of a study; `markers` and `channels` may be left out"
    )
    extended_model: PathInside | Path | None = Field(
        None, description="`extended_model.yaml` of a diagnosis of `model`: its sizes and causes"
    )
    posterior: bool = Field(
        False, description="Whether each episode draws its sizes from that file's posterior"
    )
    setup: dict[str, Any] = Field({}, description="Facts that `model` asks for, as of a run")
    commands: dict[str, tuple[float | str, float | str]] = Field(
        description="Of each command its value at the actions -1 and 1, in the drive's unit"
    )
    reward: tuple[RewardTerm, ...] = Field(min_length=1, description="Terms, which are added up")
    goal: Goal | None = Field(None, description="What markers shall reach")
    ends: Ends = Field(Ends(), description="What ends an episode before its time")
    seconds: Seconds = Field(4.0, gt=0, description="Length of an episode [s]")
    control_step: Seconds | None = Field(
        None, gt=0, description="Control period [s]; default: the model's time step"
    )
    observe: tuple[Observed, ...] | None = Field(
        None,
        min_length=1,
        description="Of the markers `velocities` and `places` (of free bodies from the center, of "
        "held ones from rest); `lying`: height and mean deformation; `goal`: the way to it. "
        "Default: velocities, places of held bodies, lying among walls, the goal if there is one",
    )
    sensors: int = Field(12, ge=1, description="Nodes that are sensed where there is no marker")
    clock: tuple[Hertz, ...] = Field((), description="Frequencies whose sine, cosine are seen [Hz]")
    start_speed: MetersPerSecond = Field(
        0.0, ge=0, description="Random first velocities, linear in place, up to this [m/s]"
    )
    current: MetersPerSecond = Field(
        0.0, ge=0, description="Sd of each component of an episode's current, in water [m/s]"
    )
    action_delay: int = Field(
        0, ge=0, le=10_000, description="Control steps until a command takes effect"
    )
    randomization: dict[str, tuple[float, float]] | None = Field(
        None, description="Factors by name: drives, stiffness, density, in water water"
    )

    @model_validator(mode="after")
    def _check_names(self) -> SoftTaskKeys:
        known = self.model.commands
        for name in self.commands:
            if name not in known:
                raise ValueError(
                    f"commands: nothing in model is driven by {name!r}{did_you_mean(name, known)}; "
                    f"known: {', '.join(known) or 'none'}"
                )
        if missing := [name for name in known if name not in self.commands]:
            raise ValueError(
                f"commands: {missing[0]} is missing; give its values at -1 and 1, [low, high]"
            )
        for name in () if self.goal is None else self.goal.markers:
            if name not in self.model.markers:
                told = did_you_mean(name, self.model.markers)
                raise ValueError(
                    f"goal.markers: no marker {name!r} in model{told}; "
                    f"known: {', '.join(self.model.markers) or 'none, give model.markers'}"
                )
        return self

    @model_validator(mode="after")
    def _check_goal(self) -> SoftTaskKeys:
        if self.posterior and self.extended_model is None:
            raise ValueError("posterior needs an extended_model to draw from")
        wanting = [str(t.term) for t in self.reward if t.needs_goal]
        if self.observe is not None and "goal" in self.observe:
            wanting.append("observe")
        if wanting and self.goal is None:
            raise ValueError(f"goal is missing, which {wanting[0]} needs; give markers and a place")
        names = [t.term for t in self.reward]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"reward: the term {twice[0]} stands twice; add its weights up")
        if self.current and self.model.water is None:
            raise ValueError("current must be 0: model has no water")
        return self
