"""A simulator given in Python, ready to be diagnosed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

from torch import Tensor

from diffsim.causes.channel_groups import channels_of, clock_of
from diffsim.causes.listing import list_causes, numbers_added
from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.readings import usual_sample, with_play_start
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import HELD, SCALES, Scales
from diffsim.causes.scene import PLAY_START
from diffsim.causes.signals import Between
from diffsim.core.checked import checked
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import Parameter
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.outside.before_runs import STOOD, BeforeRuns
from diffsim.systems.outside.effects import unknown_forces
from diffsim.systems.outside.environment import Environment
from diffsim.systems.outside.hooks import Place, instruments
from diffsim.systems.outside.hooks import command_groups as group_commands
from diffsim.systems.outside.model import OutsideModel
from diffsim.systems.outside.source import Source
from diffsim.systems.outside.starts import with_first_readings
from diffsim.systems.quantities import START_IN_PLAY

OUTSIDE = "outside"  # the kind of system, and its table
LIMIT = "force_limit_of"  # row whose sizes are read as what they are the inverse of
InRun = Callable[[Mapping[str, Tensor], Run], Mapping[str, Tensor]]


@checked
def outside_setup(
    study: Study,
    simulator: Any,
    parameters: Sequence[Parameter] | Mapping[str, Quantity],
    *,
    places: Sequence[Place] = (),
    commands: Mapping[str, Sequence[str]] | None = None,
    outputs: Mapping[str, Sequence[str]] | None = None,
    held: bool = False,
    clocks: Mapping[str, Quantity] | None = None,
    environment: Environment | None = None,
    more_effects: Sequence[Effect] = (),
    settings: DiagnosisSettings | None = None,
    workers: int = 1,
) -> DiagnosisSetup:
    """Model, candidate causes and unknown forces of a simulator from outside.

    Args:
        study: Recorded runs.
        simulator: Function predict(parameters, run), an object with such a method, or one with
            ``reset`` and ``step``; or a ``Source``.
        parameters: Base parameters, or quantities by name, that the simulator gets by name. A base
            parameter "angle@run_3" reaches it as "angle" in that run.
        places: Places where predict(parameters, run, force) adds forces.
        commands: Commands of each group that goes one way; None: all commands as one group.
        outputs: Channels of each instrument; None: those of one sensor, kind, or each alone.
        held: Commands are held from sample to sample; else straight lines join the samples.
        clocks: How late sensors, kinds or single channels are, by their name.
        environment: How ``reset`` and ``step`` are read.
        more_effects: Causes of the user's own, whose scenes are ``OutsideScene``.
        settings: Effort; None: the defaults.
        workers: Processes that simulate side by side; the simulator must then be importable.

    Raises:
        ValueError: the simulator cannot be used; the message says what it lacks.
    """
    clocks = clocks or {}
    plant = outside_plant(
        study, (), places, command_groups=commands, outputs=outputs, held=held, clocks=clocks
    )
    late = {clock_of(name): channels_of(study.channels, name) for name in clocks}
    source = simulator
    if not isinstance(simulator, Source):
        label = getattr(simulator, "__qualname__", type(simulator).__qualname__)
        source = Source(label, given=simulator, environment=environment or Environment())
    behind = {PLAY_START: START_IN_PLAY, **{clock_of(n): q for n, q in clocks.items()}}
    base, in_run = _list_parameters(parameters, behind, study)
    names = plant.channel_names
    model = OutsideModel(
        source,
        base,
        in_run,
        channels=names,
        commands=tuple(plant.commands),
        known=study.commands,
        places={p.name: 1.0 if p.speed is None else p.speed for p in places},
        clocks={key: tuple(names.index(c) for c in own) for key, own in late.items()},
        workers=workers,
    )
    model.frame = {SCALES: plant.scales.saved(), HELD: held}
    plant, limits = _with_parts(plant, model)
    # a simulator that takes delays alone has them behind the first values
    if model.takes_before or not model.takes_delays:
        model.before_runs = BeforeRuns(model, study)
        model.frame = {**model.frame, STOOD: sorted(model.before_runs.stood)}
    return DiagnosisSetup(
        model=model,
        effects=(*_with_limits(_with_holds(list_causes(plant), model), limits), *more_effects),
        unknowns=unknown_forces(plant.places, study.runs),
        settings=settings or DiagnosisSettings(),
    )


def _with_parts(plant: Plant, model: OutsideModel) -> tuple[Plant, dict[str, tuple[float, str]]]:
    """The plant with the bodies that the simulator says may carry a payload, and the actuators that
    may have a limit; and what each may push with, and its unit, by the name of that cause."""
    carriers, strengths = model.carriers, dict[str, tuple[float, str]]()
    if model.strengths is not None:
        reaches = {n: plant.scales.of_commands((n,))["reach"] for n in plant.commands}
        strengths = dict(model.strengths(reaches))
    named = {"body": carriers, "actuator": strengths}
    parts = {
        kind: {spell_plainly(name): f"{kind}.{name}" for name in of}
        for kind, of in named.items()
        if of
    }
    if not parts:
        return plant, {}
    model.zeros = numbers_added(OUTSIDE, parts)
    fitted = tuple(n for n in model.zeros if any(n == p.name.split("@")[0] for p in model.base))
    plant = replace(
        plant,
        numbers=(*plant.numbers, *model.zeros),
        fitted=(*plant.fitted, *fitted),
        parts={**plant.parts, **parts},
        magnitudes={
            **plant.magnitudes,
            "carrier": fmean([c.mass for c in carriers.values()] or [1.0]),
            "carrier_moment": fmean([c.mass * c.length for c in carriers.values()] or [1.0]),
            "strength": fmean([force for force, _ in strengths.values()] or [1.0]),
        },
    )
    return plant, {f"{LIMIT}_{spell_plainly(n)}": of for n, of in strengths.items()}


def _with_holds(effects: Iterable[Effect], model: OutsideModel) -> Iterator[Effect]:
    """Causes; how soon friction takes hold is a number of theirs where it does something."""
    asked, names = model.fits_hold, {p.name.partition("@")[0] for p in model.base}
    for effect in effects:
        if any(name.startswith("hold_of_") for name in effect.shapes):
            own = [p for p in model.places if effect.name.endswith(f"_at_{spell_plainly(p)}")]
            if asked is None or not all(asked(place, names) for place in own or model.places):
                effect = replace(effect, shapes={})
        yield effect


def _with_limits(
    effects: Iterable[Effect], limits: Mapping[str, tuple[float, str]]
) -> Iterator[Effect]:
    """Causes, of which limits of actuators are of the usual size of their own, and are read as the
    force that they are. One limit of what pushes in N and in N m is none."""
    for effect in effects:
        if not effect.name.startswith(LIMIT):
            yield effect
            continue
        own = [limits[name] for name in effect.members or (effect.name,)]
        units = {unit for _, unit in own}
        if len(units) == 1:
            unit, usual = units.pop(), fmean(1.0 / force for force, _ in own)
            unit_of_size = f"1/({unit})"
            yield replace(effect, typical=usual, unit=unit_of_size, shown_unit=unit, shown_power=-1)


def outside_plant(
    study: Study,
    numbers: Sequence[str],
    places: Sequence[Place],
    *,
    command_groups: Mapping[str, Sequence[str]] | None,
    outputs: Mapping[str, Sequence[str]] | None,
    held: bool,
    clocks: Mapping[str, Quantity],
) -> Plant:
    """What a simulator from outside tells of itself.

    Args:
        study: Recorded runs.
        numbers: Names of the parameters that causes may change.
        places: Places where the simulator adds forces.
        command_groups: Commands of each group that goes one way; None: all commands as one group.
        outputs: Channels of each instrument; None: those of one sensor, kind, or each alone.
        held: Commands are held from sample to sample; else straight lines join the samples.
        clocks: How late sensors, kinds or single channels are, by their name.

    Raises:
        ValueError: a group or instrument that names what the study does not have.
    """
    scales = Scales.of(study)
    between: Between = "held" if held else "smooth"
    late = tuple(channels_of(study.channels, name) for name in clocks)
    commands = dict.fromkeys(name for run in study.runs for name in run.command)
    return Plant(
        kind=OUTSIDE,
        scales=scales,
        channels=study.channels,
        commands=dict.fromkeys(commands, between),
        ways=group_commands(study, command_groups, scales, between),
        numbers=tuple(numbers),
        places={place.name: place.of_plant for place in places},
        facts={IN_TIME: True},
        instruments=instruments(study, outputs, scales, late),
        sample_s=usual_sample(study.runs),
    )


def _list_parameters(
    given: Sequence[Parameter] | Mapping[str, Quantity],
    behind: Mapping[str, Quantity],
    study: Study,
) -> tuple[tuple[Parameter, ...], InRun]:
    """Base parameters, those of what happens behind the simulator last."""
    if isinstance(given, Mapping):
        both = BaseParameters({**given, **behind}, study.runs)
        both = both.with_priors(with_first_readings(both.base, given, study))
        return both.base, lambda v, run: both.in_run(with_play_start(v, run), run)
    own = BaseParameters(behind, study.runs)

    def in_run(values: Mapping[str, Tensor], run: Run) -> Mapping[str, Tensor]:
        return _pick_values_of_run(values, run) | own.in_run(with_play_start(values, run), run)

    return (*given, *own.base), in_run


def _pick_values_of_run(values: Mapping[str, Tensor], run: Run) -> dict[str, Tensor]:
    """Values by name in a run: "angle@run_3" is "angle" there, and nothing elsewhere."""
    shared = {name: v for name, v in values.items() if "@" not in name}
    own = {n.split("@")[0]: v for n, v in values.items() if n.endswith(f"@{run.name}")}
    return {**shared, **own}
