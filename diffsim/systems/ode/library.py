"""What the candidate causes of a system are made from: its names and usual magnitudes.

Sizes that would be no surprise follow from one simulation of the plain model, so that nobody has to
state how large a friction could be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch

from diffsim.causes.scales import CommandScale, Scales
from diffsim.core.arrays import Array
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.model import SimModel
from diffsim.systems.ode.described import FormulaSystem, model_of
from diffsim.systems.ode.differences import differences, key_of
from diffsim.systems.ode.keys import Law, Place, Store
from diffsim.systems.ode.network import product
from diffsim.systems.ode.scene import OdeScene

RESTS = 1e-3  # of what a channel shows: less is no motion
SHARE_OF_USUAL = 0.1  # of a usual magnitude: what a cause may be without surprise
USUAL = "usual"  # of inputs and definitions, among the magnitudes of the plain model
RUNAWAY_MAGNITUDES = 1e80  # of a magnitude: a model that runs away


@dataclass(frozen=True)
class PlaceScale:
    """Usual magnitudes at a place in the plain model, over the runs to fit."""

    force: float  # rms of inertia times rate of the velocity [unit of the force]
    inertia: float  # inertia at the start [unit of the inertia]
    position: float  # rms distance of the position from its start
    velocity: float  # rms velocity
    # low, high: least and greatest position
    low: float
    high: float
    # below, above: how far these are from the start; never zero
    below: float
    above: float


@dataclass(frozen=True)
class StoreScale:
    """Usual magnitudes of a store in the plain model, over the runs to fit."""

    level: float  # rms level
    rate: float  # rms rate of the level [1/s]
    high: float  # greatest level
    area: float = 1.0  # rms of what a flow is divided by


@dataclass(frozen=True, eq=False)
class Library:
    """A described system with its usual magnitudes: what its causes are made from."""

    system: FormulaSystem  # the description with its formulas parsed
    model: SimModel  # its plain model
    scales: Scales  # usual magnitudes of inputs, channels, places, stores, definitions and laws

    @property
    def study(self) -> Study:
        """Study with the recordings."""
        return self.system.study

    @cached_property
    def places(self) -> tuple[tuple[Place, PlaceScale], ...]:
        """Where forces may act, each with its usual magnitudes."""
        plain = self.scales.plain
        return tuple((p, PlaceScale(**plain[p.name])) for p in self.system.motion.places)

    @cached_property
    def stores(self) -> tuple[tuple[Store, StoreScale], ...]:
        """What fills and empties, each with its usual magnitudes."""
        plain = self.scales.plain
        return tuple((s, StoreScale(**plain[s.name])) for s in self.system.motion.stores)

    @property
    def usual(self) -> Mapping[str, float]:
        """Rms of each input, definition and difference in one, by its name."""
        return self.scales.plain[USUAL]


def library_of(system: FormulaSystem) -> Library:
    """A system with magnitudes from one simulation of each run to fit, with the best guess of all.

    A study with a ``frame`` has them from there.
    """
    model = model_of(system)
    return Library(system, model, _find_scales(system, model))


def law_key(law: Law) -> str:
    """What the magnitudes of a law are called among those of the plain model."""
    return f"law {law.name}"


def _find_scales(system: FormulaSystem, model: SimModel) -> Scales:
    study, motion, laws = system.study, system.motion, system.keys.laws
    if (kept := Scales.kept_in(study)) is not None:
        kept.require_plain("place", [place.name for place in motion.places])
        kept.require_plain("store", [store.name for store in motion.stores])
        kept.require_plain("magnitudes of", [law_key(law) for law in laws])
        return kept
    recorded = Scales.of_runs(study)
    if not (motion.states or laws):
        return recorded
    network, between = system.network, dict[str, Expression]()
    if motion.states:
        named = (*network.inputs, *network.definitions)
        between = {n: parse_expression(n, system.known) for n in named}
        between |= {key_of(n): found.formula for n, found in differences(network).items()}
    read = network.with_readings(
        {**_read_inside(system), **{f"usual {n}": formula for n, formula in between.items()}}
    )
    columns: dict[str, list[Array]] = {}
    inputs: dict[str, CommandScale] = {}
    begins_moving = False
    for run in study.fit_runs or study.runs:
        scene = model.scene(run, model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            readings, _ = scene.solved(read)
        for name, column in zip(read.readings, readings.unbind(-1), strict=True):
            columns.setdefault(name, []).append(column.numpy())
        if motion.states:
            inputs |= {name: _widen_scale(inputs.get(name), scene, name) for name in scene.inputs}
            begins_moving = begins_moving or _moves_at_first(scene, recorded.channels)
    usual = {USUAL: {name: _compute_rms(columns[f"usual {name}"]) for name in between}}
    plain: dict[str, dict[str, float]] = {
        **{p.name: asdict(_measure_place(p, columns)) for p in motion.places},
        **{s.name: asdict(_measure_store(s, columns)) for s in motion.stores},
        **(usual if motion.states else {}),
        **{law_key(law): _measure_law(law, columns) for law in laws},
    }
    if not motion.states:
        return replace(recorded, plain=plain)
    return replace(recorded, commands=inputs, plain=plain, facts={"begins_moving": begins_moving})


def _widen_scale(known: CommandScale | None, scene: OdeScene, name: str) -> CommandScale:
    """What an input does in a run and in those before."""
    u = scene.inputs[name].detach()
    low, high = float(u.min()), float(u.max())
    steps = scene.grid.times.diff()
    rates = (u.diff(dim=-1).abs() / steps).numpy()
    rate = float(np.quantile(rates, 0.9)) if len(steps) else 0.0
    if known is None:
        return CommandScale(low, high, rate)
    ends = min(low, known.low), max(high, known.high)
    return CommandScale(*ends, max(rate, known.rate))


def _moves_at_first(scene: OdeScene, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the plain model would not rest if its inputs stayed as they were before the run."""
    scene = scene.with_command(tuple(scene.inputs), lambda u, grid: u[..., :1].expand_as(u))
    with torch.no_grad():
        seen = scene.simulate()
    moved = seen.amax(-2) - seen.amin(-2)
    return any(
        not float(m) <= RESTS * (high - low)
        for m, (low, high) in zip(moved, ranges.values(), strict=True)
    )


def _read_inside(system: FormulaSystem) -> dict[str, Expression]:
    """Readings of the magnitudes inside: of places, stores and laws."""
    out, rates = dict[str, Expression](), system.network.rates
    read = partial(parse_expression, known=system.known)
    for place in system.motion.places:
        inertia = read(place.inertia)
        out[f"{place.name} force"] = product(rates[place.velocity], inertia)
        out[f"{place.name} inertia"] = inertia
        out[f"{place.name} position"] = read(place.position)
        out[f"{place.name} velocity"] = read(place.velocity)
    for store in system.motion.stores:
        out[f"{store.name} level"] = read(store.level)
        out[f"{store.name} rate"] = rates[store.level]
        out[f"{store.name} area"] = read(store.area)
    for law in system.keys.laws:
        out[f"{law_key(law)} x"], out[f"{law_key(law)} y"] = read(law.of), read(law.name)
    return out


def _join_finite(parts: Sequence[Array]) -> Array:
    values = np.concatenate(parts)
    return np.asarray(values[np.isfinite(values)])


def _compute_rms(parts: Sequence[Array]) -> float:
    """Rms; 1 where that is no number or zero; at most ``RUNAWAY_MAGNITUDES``.

    Its cube is a number, too.
    """
    values = _join_finite(parts)
    with np.errstate(over="ignore"):
        found = float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
    return min(found, RUNAWAY_MAGNITUDES) if np.isfinite(found) and found > 0.0 else 1.0


def _measure_place(place: Place, columns: Mapping[str, list[Array]]) -> PlaceScale:
    path = columns[f"{place.name} position"]
    away = _join_finite([p - p[0] for p in path])
    usual = _compute_rms([away])
    return PlaceScale(
        force=_compute_rms(columns[f"{place.name} force"]),
        inertia=_compute_rms([i[:1] for i in columns[f"{place.name} inertia"]]),
        position=usual,
        velocity=_compute_rms(columns[f"{place.name} velocity"]),
        low=float(_join_finite(path).min(initial=0.0)),
        high=float(_join_finite(path).max(initial=0.0)),
        below=max(-float(away.min(initial=0.0)), 0.1 * usual),
        above=max(float(away.max(initial=0.0)), 0.1 * usual),
    )


def _measure_store(store: Store, columns: Mapping[str, list[Array]]) -> StoreScale:
    levels = columns[f"{store.name} level"]
    return StoreScale(
        _compute_rms(levels),
        _compute_rms(columns[f"{store.name} rate"]),
        float(_join_finite(levels).max(initial=0.0)),
        _compute_rms(columns[f"{store.name} area"]),
    )


def _measure_law(law: Law, columns: Mapping[str, list[Array]]) -> dict[str, float]:
    """Rms of x and y, greatest y."""
    x, y = columns[f"{law_key(law)} x"], columns[f"{law_key(law)} y"]
    most = float(_join_finite(y).max(initial=-math.inf))
    return {"x": _compute_rms(x), "y": _compute_rms(y), "most": most}
