"""Causes that act for a limited time: at a place, on an input or definition, in a sensor.

Where they lie in time are base parameters, shared by all forms at all places: ``event_onset``,
``event_width``, ``event_period``. They matter only while an event is in the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffsim.core.figures import figure
from diffsim.core.units import after_number
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect, Locator
from diffsim.identify.locate import Course, Proposal
from diffsim.identify.model import SimModel
from diffsim.systems.description import Quantity
from diffsim.systems.ode.applying import entering
from diffsim.systems.ode.event_forms import ONSET, PERIOD, SAID, TIMINGS, WIDTH, placed, shape_of
from diffsim.systems.ode.keys import Events
from diffsim.systems.ode.library import SHARE_OF_USUAL, Library
from diffsim.systems.ode.network import named
from diffsim.systems.ode.scene import OdeScene

Array = np.ndarray
#: (scene, values on the grid (..., num_times)) -> the scene with them added
Entry = Callable[[OdeScene, Tensor], OdeScene]
STEP_SHARE = 0.05  # of a knot: longest difference step of a time
SENSOR_SHARE = 0.05  # of what a channel shows: a shift of its readings without surprise
FEWEST_KNOTS = 3.0  # a width that can be read off them, half of a period


@dataclass(frozen=True, eq=False)
class _Way:
    """Where an event enters."""

    name: str  # name of the place, input, definition or channel
    kind: str  # kind of cause
    unit: str  # unit of the size
    typical: float  # size that would be no surprise
    # function of a name that no other cause has: what adds values to a scene there
    entry: Callable[[str], Entry]
    # other ways in which the same record follows: name, unit, and size per size here
    alike: tuple[tuple[str, str, float], ...] = ()


def runs_of(events: Events, study: Study) -> tuple[Run, ...]:
    """Runs in which events are looked for."""
    return tuple(run for run in study.runs if _is_meant(events, run))


def _is_meant(events: Events, run: Run) -> bool:
    return all(str(run.setup.get(k)) == str(v) for k, v in events.where.items())


def knots_of(events: Events, study: Study) -> Array:
    """Times of knots over the runs to fit, (K,) [s]."""
    meant = runs_of(events, study) or study.runs  # on recordings without it an event is inert
    meant = tuple(r for r in meant if r.use == "fit") or meant
    first, last = min(r.time_s[0] for r in meant), max(r.time_s[-1] for r in meant)
    longest = max(float(r.time_s[-1] - r.time_s[0]) for r in meant)
    step = max(longest / events.knots, float(np.median(np.diff(meant[0].time_s))))
    return first + step * np.arange(math.ceil((last - first) / step) + 1)


def timings(events: Events, study: Study) -> dict[str, Quantity]:
    """Base parameters that say where events lie in time."""
    knots = knots_of(events, study)
    span, step = float(np.ptp(knots)), float(knots[1] - knots[0])
    wanted = {timing for form in events.forms for timing in TIMINGS[form]}
    sample = min(float(np.median(np.diff(run.time_s))) for run in study.runs)
    # bounds must not depend on how long recordings are: a saved event stays where it lies
    values = {
        ONSET: (knots[0] + 0.5 * span, 0.5 * span, -math.inf),
        WIDTH: (0.1 * span, 0.25 * span, 2.0 * sample),
        PERIOD: (0.1 * span, 0.25 * span, 4.0 * sample),
    }
    # a longer period moves the last pulse by as many times more as there are pulses
    shortest = 2.0 * FEWEST_KNOTS * step
    steps = {PERIOD: STEP_SHARE * step * shortest / span}
    return {
        f"{events.name}_{timing}": Quantity(
            value=max(value, low),
            sd=sd,
            lower=low,
            unit="s",
            step=steps.get(timing, STEP_SHARE * step),
        )
        for timing, (value, sd, low) in values.items()
        if timing in wanted
    }


def event_effects(library: Library) -> tuple[Effect, ...]:
    """Every form at every place that is asked; places that no record tells apart are one."""
    return tuple(e for one in library.system.motion.events for e in _list_of_one(library, one))


def _list_of_one(library: Library, events: Events) -> Iterator[Effect]:
    knots = knots_of(events, library.study)
    ways = [_find_way(library, events, name) for name in events.at]
    for way in _drop_alike(ways, library.model, library.study.runs[0]):
        course = _make_curve(events, way, knots)
        for form in events.forms:
            yield _make_effect(events, way, form, course, knots)


def _drop_alike(ways: Sequence[_Way], model: SimModel, run: Run) -> list[_Way]:
    """Ways whose responses differ; those that only differ by a factor are said with the first."""
    plain = model.scene(run, model.at_prior())
    assert isinstance(plain, OdeScene)
    half = (torch.arange(len(plain.grid.times)) > len(plain.grid.times) // 2).double()
    out: list[tuple[_Way, Array]] = []
    with torch.no_grad():
        base = plain.simulate().numpy()
        scale = base.std(axis=0) + 1e-300
        for way in ways:
            moved = way.entry("trial")(plain, way.typical * half).simulate().numpy()
            change = ((moved - base) / scale).ravel()
            twin = next((k for k, (_, c) in enumerate(out) if _is_alike(change, c)), None)
            if twin is None:
                out.append((way, change))
                continue
            first, response = out[twin]
            factor = float(change @ response / (change @ change)) * way.typical / first.typical
            alike = (*first.alike, (way.name, way.unit, factor))
            out[twin] = replace(first, alike=alike), response
    return [way for way, _ in out]


def _is_alike(a: Array, b: Array) -> bool:
    lengths = float(np.linalg.norm(a) * np.linalg.norm(b))
    return lengths > 0.0 and abs(float(a @ b)) > (1.0 - 1e-6) * lengths  # the same but for a factor


def _find_way(library: Library, events: Events, name: str) -> _Way:
    """Where an event may enter, by the name of a place, input, definition or channel."""
    place = next(((p, s) for p, s in library.places if p.name == name), None)
    if place is not None:
        size = SHARE_OF_USUAL * place[1].force
        return _Way(name, "force", place[0].unit, size, partial(_enter, library, "force", name))
    if name in library.usual:
        size = SHARE_OF_USUAL * library.usual[name]
        return _Way(name, "actuator", "command", size, partial(_enter, library, "input", name))
    index = [c.name for c in library.study.channels].index(name)
    unit, spread = library.study.channels[index].unit, library.scales.of_channels((name,))["spread"]

    def read(own: str) -> Entry:
        return lambda scene, values: scene.with_reading(
            (index,), lambda y, grid: y + values[..., None, :]
        )

    return _Way(name, "sensor", unit, SENSOR_SHARE * spread, read)


def _enter(library: Library, kind: str, target: str, own: str) -> Entry:
    # each cause has an input of its own: of one name, the last would stand for all
    change = replace(entering(library.system, kind, target, named(own)), inputs={own: False})
    return lambda scene, values: scene.with_further_inputs({own: values}, change)


def _make_effect(events: Events, way: _Way, form: str, course: Effect, knots: Array) -> Effect:
    names = {timing: f"{events.name}_{timing}" for timing in TIMINGS[form]}
    name = f"{form}_{events.name}_at_{way.name}"
    add = way.entry(f"course of {name}")
    return Effect(
        name=name,
        form=SAID[form],
        family=events.name,
        kind=way.kind,
        unit=way.unit,
        typical=way.typical,
        also_looks_like=("anything else of that course in time",),
        apply=partial(_apply_event, events=events, form=form, names=names, add=add),
        says=partial(_say_event, form=form, names=names, way=way),
        locate=Locator(
            course=course,
            times=knots,
            acts_in=partial(_is_meant, events),
            propose=partial(_propose_places, form=form, names=names, usual=way.typical),
        ),
    )


def _apply_event(
    scene: OdeScene,
    size: Tensor,
    run: Run,
    *,
    events: Events,
    form: str,
    names: Mapping[str, str],
    add: Entry,
) -> OdeScene:
    if not _is_meant(events, run):
        return scene
    times = scene.grid.times
    edge = float(times.diff().median())
    timing = {timing: scene.numbers[name] for timing, name in names.items()}
    return add(scene, size[..., :1] * shape_of(form, times, timing, edge))


def _propose_places(
    course: Course, *, form: str, names: Mapping[str, str], usual: float
) -> list[Proposal]:
    return [
        Proposal(sizes=np.array([size]), parameters={names[k]: v for k, v in timing.items()})
        for size, timing in placed(form, course, 10.0 * usual)
    ]


def _say_event(
    size: float, values: Mapping[str, float], *, form: str, names: Mapping[str, str], way: _Way
) -> str:
    """In words: how large, where, of what form, from when to when."""
    ways = [(way.name, way.unit, 1.0), *way.alike]
    much = " or ".join(
        f"{figure(size * factor)}{after_number(u)} at {name}" for name, u, factor in ways
    )
    at = {timing: values.get(name, math.nan) for timing, name in names.items()}
    since = f"from {at[ONSET]:.3f} s"
    if form == "step":
        return f"a step of {much} {since}"
    until = f"{since} to {at[ONSET] + at[WIDTH]:.3f} s"
    if form == "train":
        return f"pulses of {much}, {at[WIDTH]:.3g} s each {at[PERIOD]:.3g} s, {since}"
    if form == "burst":
        return f"a sine of {much} and {at[PERIOD]:.3g} s {until}"
    return f"a {form.replace('_', ' ')} of {much} {until}"


def _make_curve(events: Events, way: _Way, knots: Array) -> Effect:
    """Values at the knots, straight lines between them."""
    name = f"course_of_{events.name}_at_{way.name}"
    first, step = float(knots[0]), float(knots[1] - knots[0])
    return Effect(
        name=name,
        family="unknown",
        kind=way.kind,
        unit=way.unit,
        typical=way.typical,
        components=tuple(f"knot_{k}" for k in range(len(knots))),
        apply=partial(_apply_curve, add=way.entry(name), first=first, step=step),
    )


def _apply_curve(
    scene: OdeScene, size: Tensor, run: Run, *, add: Entry, first: float, step: float
) -> OdeScene:
    place = ((scene.grid.times - first) / step).clamp(0.0, size.shape[-1] - 1.0)
    left = place.floor().long().clamp(max=size.shape[-1] - 2)
    share = place - left
    return add(scene, size[..., left] * (1.0 - share) + size[..., left + 1] * share)
