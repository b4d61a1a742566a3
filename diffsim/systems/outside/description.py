"""``model: {system: outside}``: keys that describe a simulator of the user's own."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from diffsim.causes.channel_groups import CLOCKS, clock_problems
from diffsim.causes.plant import Plant
from diffsim.causes.scales import HELD
from diffsim.copter.exchange.mjcf_text import whole_scene
from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked_methods
from diffsim.core.inside import inside
from diffsim.core.schema import Part
from diffsim.core.schema_paths import CODE, INSIDE, PathWords
from diffsim.core.units import in_si, in_unit
from diffsim.data.signal import looks_held
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    IN_UNIT,
    Description,
    Quantity,
    chosen_effects,
    settings_with,
)
from diffsim.systems.outside import hooks as hooks_of
from diffsim.systems.outside.environment import Environment
from diffsim.systems.outside.mjcf import version_notes
from diffsim.systems.outside.mjcf_numbers import several_axes
from diffsim.systems.outside.setup import outside_plant, outside_setup
from diffsim.systems.outside.source import MJCF, Source
from diffsim.systems.outside.starts import StartQuantity
from diffsim.systems.quantities import Time

_MAX_NAME = 255  # letters; what is longer is a text, and no file
AXES = {"ball": 3, "free": 6}  # of joints with several


def _read_quantity(given: Any) -> Any:
    """A plain number is a known quantity in the user's own unit; one with a unit, in SI.

    Where ``unit`` says what the simulator takes, all numbers are in that unit.
    """
    if not isinstance(given, Mapping):
        value, unit = in_si(given)
        return {"value": value, "unit": unit}
    own = given.get("unit")
    texts = {k: str(v) for k, v in given.items() if k in IN_UNIT and isinstance(v, str)}
    if not texts:
        return given
    if own is not None:
        read = {k: in_unit(v, str(own), difference=k == "sd") for k, v in texts.items()}
        return {**given, **read}
    units = [in_si(v)[1] for v in texts.values()]
    read = {k: in_unit(v, units[0], difference=k == "sd") for k, v in texts.items()}
    return {**given, **read, "unit": units[0]}


AnyQuantity = Annotated[Quantity, BeforeValidator(_read_quantity)]
AnyStart = Annotated[StartQuantity, BeforeValidator(_read_quantity)]


class PlaceKeys(Part):
    """A place where the simulator adds a force."""

    unit: Literal["N", "N m"] = Field(description="N for a force, N m for a moment")
    typical: float = Field(gt=0, description="Force that would be no surprise, in that unit")
    distance: float | None = Field(
        None, gt=0, description="Usual displacement from zero, m or rad; none: no springs are tried"
    )
    speed: float | None = Field(
        None, gt=0, description="Usual speed, m/s or rad/s; none: no friction or drag is tried"
    )


class HookKeys(Part):
    """What causes may act on."""

    command: dict[str, tuple[str, ...]] | None = Field(
        None,
        description="Commands of each driver, by a name of its own; they share lag, delay, ... "
        "Default: all commands are of one driver",
    )
    force: dict[str, PlaceKeys] = Field(
        {}, description="Places where predict(parameters, run, force) adds forces, by name"
    )
    output: dict[str, tuple[str, ...]] | None = Field(
        None,
        description="Channels of each instrument, by a name of its own; they share scale, delay, "
        "... Default: channels of one kind",
    )


class EnvironmentKeys(Part):
    """How a simulator with reset and step is read."""

    time_step: float | None = Field(
        None, gt=0, description="Time between two steps in s; default: the attribute dt"
    )
    observation: tuple[int, ...] = Field(
        (), description="Entry of the observation for each channel; default: in their order"
    )
    action: tuple[str, ...] = Field(
        (), description="Commands that make the action, in order; default: all commands"
    )


@checked_methods
class OutsideDescription(Description):
    """A simulator of the user's own: any function, class or Gymnasium environment."""

    takes_before = True

    system: Literal["outside"] = Field(description="outside")
    simulator: Annotated[str, PathWords("text", CODE)] = Field(
        description="FILE.py:NAME beside study.yaml, MODULE:NAME, or gym:ID. NAME is a function "
        "predict(parameters, run), or a class with such a method, or with reset and step"
    )
    options: Annotated[dict[str, Any], PathWords("mapping of names to anything", INSIDE)] = Field(
        {}, description="Keyword arguments that the class is made with, such as a model file"
    )
    parameters: dict[str, AnyQuantity] = Field(
        {}, description="What the simulator gets by name, each in the simulator's own unit"
    )
    start: dict[str, AnyStart] = Field(
        {}, description="Start values that it gets by name too; usually `per: run`"
    )
    commands_are: Literal["straight", "held"] | None = Field(
        None,
        description="Between two samples: straight lines, or held until the next sample. None: "
        "held where all commands rest and jump, which `check` says; else straight",
    )
    clocks: dict[str, Time] = Field({}, description=CLOCKS)
    hooks: HookKeys = Field(HookKeys(), description="What causes may act on")
    environment: EnvironmentKeys = Field(
        EnvironmentKeys(), description="How a simulator with reset and step is read"
    )
    workers: int = Field(
        1,
        ge=1,
        le=256,
        description="Processes that simulate side by side; of MuJoCo, its own threads",
    )

    @model_validator(mode="after")
    def _check_names_once(self) -> OutsideDescription:
        if both := set(self.parameters) & set(self.start):
            raise ValueError(f"{', '.join(sorted(both))}: in parameters or in start, not in both")
        return self

    def source(self, study: Study) -> Source:
        """Where the simulator of a study is."""
        reading = Environment(**self.environment.model_dump())
        options = dict(self._list_options(study.folder))
        if self.simulator == MJCF:
            options.setdefault("held", self._are_commands_held(study))
            if study.folder is not None:
                options["folder"] = str(study.folder)
        return Source(self.simulator, study.folder, options, reading)

    def problems(self, study: Study) -> list[Problem]:
        """A simulator that is not there, hooks that no column has; nothing is run."""
        out = []
        try:
            problem = self.source(study).problem()
        except ValueError as error:  # a path that leaves its folder
            problem = str(error)
        if problem:
            out.append(Problem("error", "model", problem))
        elif self.simulator == MJCF:
            out += self._mjcf_problems(study)
        checks: list[Callable[[], object]] = [
            partial(hooks_of.command_groups, study, self.hooks.command),
            partial(hooks_of.instruments, study, self.hooks.output),
        ]
        for check in checks:
            try:
                check()
            except ValueError as error:
                out.append(Problem("error", "model", str(error)))
        out += clock_problems(study.channels, self.clocks)
        channels = [channel.name for channel in study.channels]
        for key, start in self.start.items():
            if start.first is not None and start.first not in channels:
                message = f"no channel {start.first!r}{did_you_mean(start.first, channels)}"
                out.append(Problem("error", f"model.start.{key}.first", message))
        known = {name for run in study.runs for name in run.command}
        for name in self.environment.action:
            if name not in known:
                out.append(Problem("error", "model", f"environment.action: no command {name!r}"))
        count = len(self.environment.observation)
        if count and count != len(study.channels):
            message = f"environment.observation has {count} entries for {len(study.channels)} "
            out.append(Problem("error", "model", message + "channels"))
        if self.commands_are is None and self._are_commands_held(study):
            message = "the commands rest and jump, so they are held between samples; "
            message += "give `commands_are: straight` if they are not"
            out.append(Problem("note", "model.commands_are", message))
        return out

    def _mjcf_problems(self, study: Study) -> list[Problem]:
        """Files that an MJCF lacks, and what the installed MuJoCo takes otherwise than another."""
        options = self.source(study).options
        try:
            text, _ = whole_scene(str(options.get("model", "")), study.folder)
        except (ValueError, OSError) as error:
            return [Problem("error", "model.options.model", str(error))]
        try:
            own = version("mujoco")
        except PackageNotFoundError:
            return [Problem("error", "model", "MuJoCo is not installed: pip install mujoco")]
        notes = [Problem("note", "model.options.model", note) for note in version_notes(text, own)]
        return [
            *notes,
            *(Problem("error", "model", said) for said in _free_places(text, self.hooks)),
        ]

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        held = self._are_commands_held(study)
        made = outside_setup(
            study,
            self.source(study),
            {**self.parameters, **self.start},
            places=self._list_places(),
            commands=self.hooks.command,
            outputs=self.hooks.output,
            held=held,
            clocks=self.clocks,
            workers=self.workers,
        )
        return replace(
            made,
            effects=chosen_effects(made.effects, self.effects, study, self.plant(study)),
            settings=settings_with(made.settings, self.effort),
        )

    def plant(self, study: Study) -> Plant:
        """What the simulator offers to causes of a user."""
        return outside_plant(
            study,
            (*self.parameters, *self.start),
            self._list_places(),
            command_groups=self.hooks.command,
            outputs=self.hooks.output,
            held=self._are_commands_held(study),
            clocks=self.clocks,
        )

    def _list_places(self) -> list[hooks_of.Place]:
        return [
            hooks_of.Place(name, p.unit, p.typical, p.distance, p.speed)
            for name, p in self.hooks.force.items()
        ]

    def _are_commands_held(self, study: Study) -> bool:
        if self.commands_are is not None:
            return self.commands_are == "held"
        if (kept := study.frame.get(HELD)) is not None:
            return bool(kept)
        return looks_held(study.runs, list(dict.fromkeys(c for r in study.runs for c in r.command)))

    def _list_options(self, folder: Path | None) -> Mapping[str, Any]:
        """Options; those that name a file beside the study get its folder."""
        if folder is None:
            return self.options
        opened = ("model",) if self.simulator == MJCF else ()
        return {k: _file_or_value(folder, k, v, k in opened) for k, v in self.options.items()}


def _free_places(text: str, hooks: HookKeys) -> Iterator[str]:
    """Places of forces that are joints of an MJCF with several axes, a sentence each."""
    for joint in ElementTree.fromstring(text).iter():
        kind = "free" if joint.tag == "freejoint" else joint.get("type", "")
        name = joint.get("name", "")
        if joint.tag in ("joint", "freejoint") and kind in AXES and name in hooks.force:
            yield several_axes(name, AXES[kind])


def _file_or_value(folder: Path, key: str, given: Any, is_opened: bool) -> Any:
    """The path of a file that a text names; any other text, which may be no path, as it is."""
    if not isinstance(given, str) or not 0 < len(given) <= _MAX_NAME or given[:1] in "<\n ":
        return given
    is_file = is_opened or (folder / given).is_file()
    return str(inside(folder, given, f"options.{key}")) if is_file else given
