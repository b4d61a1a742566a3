"""What the candidate causes of a system are made from: its names and usual magnitudes.

Sizes that would be no surprise follow from one simulation of the plain model, so that nobody has to
state how large a friction could be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.causes.scales import CommandScale, Scales
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.model import SimModel
from diffsim.systems.ode.keys import Place, Store
from diffsim.systems.ode.network import Network, product
from diffsim.systems.ode.scene import OdeScene

Array = NDArray[np.float64]
RESTS = 1e-3  # of what a channel shows: less is no motion
SHARE_OF_USUAL = 0.1  # of a usual magnitude: what a cause may be without surprise
USUAL = "usual"  # of inputs and definitions, among the magnitudes of the plain model
MOST = 1e80  # of a magnitude: a model that runs away


@dataclass(frozen=True)
class PlaceScale:
    """Usual magnitudes at a place in the plain model, over the runs to fit.

    Attributes:
        force: Rms of inertia times rate of the velocity [unit of the force].
        inertia: Inertia at the start [unit of the inertia].
        position: Rms distance of the position from its start.
        velocity: Rms velocity.
        low, high: Least and greatest position.
        below, above: How far these are from the start; never zero.
    """

    force: float
    inertia: float
    position: float
    velocity: float
    low: float
    high: float
    below: float
    above: float


@dataclass(frozen=True)
class StoreScale:
    """Usual magnitudes of a store in the plain model, over the runs to fit.

    Attributes:
        level: Rms level.
        rate: Rms rate of the level [1/s].
        high: Greatest level.
    """

    level: float
    rate: float
    high: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Library:
    """Names and magnitudes of a described system.

    Attributes:
        study: Study with the recordings.
        known: Names that formulas may use.
        held: Inputs, with whether they are held between samples.
        places: Where forces may act, each with its usual magnitudes.
        stores: What fills and empties, each with its usual magnitudes.
        scales: Usual magnitudes of inputs, channels, places, stores and definitions.
        step: Longest step of the integrator [s].
        unsure: Inputs of which nobody knows whether they are held between samples.
        assumed: Inputs that are taken to be held though some run does not show it.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
    """

    study: Study
    known: tuple[str, ...]
    held: Mapping[str, bool]
    places: tuple[tuple[Place, PlaceScale], ...]
    stores: tuple[tuple[Store, StoreScale], ...]
    scales: Scales
    unsure: frozenset[str] = frozenset()
    assumed: frozenset[str] = frozenset()
    clocks: frozenset[tuple[str, ...]] = frozenset()
    step: float = math.inf

    @property
    def usual(self) -> Mapping[str, float]:
        """Rms of each input and definition, by its name."""
        return self.scales.plain[USUAL]


def scales_of(
    study: Study,
    model: SimModel,
    network: Network,
    known: Sequence[str],
    places: Sequence[Place],
    stores: Sequence[Store],
) -> Scales:
    """From one simulation of each run to fit, with the best guess of everything.

    A study with a ``frame`` has them from there.

    Args:
        study: Study with the recordings.
        model: Model whose scenes are :class:`OdeScene`.
        network: Its formulas.
        known: Names that formulas may use.
        places: Where forces may act.
        stores: What fills and empties.
    """
    if (kept := Scales.kept_in(study)) is not None:
        require_kept("place", [place.name for place in places], kept.plain)
        require_kept("store", [store.name for store in stores], kept.plain)
        return kept
    between = {n: parse_expression(n, known) for n in (*network.inputs, *network.definitions)}
    inside = _read_inside(network, known, places, stores)
    read = network.with_readings({**inside, **{f"usual {n}": e for n, e in between.items()}})
    columns: dict[str, list[Array]] = {}
    inputs: dict[str, CommandScale] = {}
    recorded = Scales.of_runs(study)
    begins_moving = False
    for run in study.fit_runs or study.runs:
        scene = model.scene(run, model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            readings, _ = scene.solved(read)
        for name, column in zip(read.readings, readings.unbind(-1), strict=True):
            columns.setdefault(name, []).append(column.numpy())
        inputs |= {name: _widen_scale(inputs.get(name), scene, name) for name in scene.inputs}
        begins_moving = begins_moving or _moves_at_first(scene, recorded.channels)
    plain: dict[str, dict[str, float]] = {
        **{p.name: asdict(_measure_place(p, columns)) for p in places},
        **{s.name: asdict(_measure_store(s, columns)) for s in stores},
        USUAL: {name: _compute_rms(columns[f"usual {name}"]) for name in between},
    }
    return replace(recorded, commands=inputs, plain=plain, facts={"begins_moving": begins_moving})


def _widen_scale(known: CommandScale | None, scene: OdeScene, name: str) -> CommandScale:
    """What an input does in a run and in those before."""
    u = scene.inputs[name].detach()
    low, high = float(u.min()), float(u.max())
    steps = scene.grid.times.diff()
    rate = float((u.diff(dim=-1).abs() / steps).quantile(0.9)) if len(steps) else 0.0
    if known is None:
        return CommandScale(low, high, rate)
    return CommandScale(min(low, known.low), max(high, known.high), max(rate, known.rate))


def _moves_at_first(scene: OdeScene, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the plain model would not rest if its inputs stayed as they are at first."""
    scene = scene.with_command(tuple(scene.inputs), lambda u, grid: u[..., :1].expand_as(u))
    with torch.no_grad():
        seen = scene.simulate()
    moved = seen.amax(-2) - seen.amin(-2)
    return any(
        not float(m) <= RESTS * (high - low)
        for m, (low, high) in zip(moved, ranges.values(), strict=True)
    )


def require_kept(what: str, names: Sequence[str], kept: Mapping[str, object]) -> None:
    """Require the magnitudes of everything that opens causes among those of a saved model.

    Raises:
        ValueError: what was described after the model was fitted.
    """
    if missing := [name for name in names if name not in kept]:
        raise ValueError(
            f"{what} {missing[0]} is not in the saved model, which knows "
            f"{', '.join(kept) or 'none'}; leave it out, or fit the model again"
        )


def _read_inside(
    network: Network, known: Sequence[str], places: Sequence[Place], stores: Sequence[Store]
) -> dict[str, Expression]:
    """Readings of the magnitudes inside: forces, inertias, positions, velocities, levels."""
    out = {}
    for place in places:
        inertia = parse_expression(place.inertia, known)
        out[f"{place.name} force"] = product(network.rates[place.velocity], inertia)
        out[f"{place.name} inertia"] = inertia
        out[f"{place.name} position"] = parse_expression(place.position, known)
        out[f"{place.name} velocity"] = parse_expression(place.velocity, known)
    for store in stores:
        out[f"{store.name} level"] = parse_expression(store.level, known)
        out[f"{store.name} rate"] = network.rates[store.level]
    return out


def _join_finite(parts: Sequence[Array]) -> Array:
    values = np.concatenate(parts)
    return np.asarray(values[np.isfinite(values)])


def _compute_rms(parts: Sequence[Array]) -> float:
    """Rms; 1 where that is no number or zero, at most ``MOST``: its cube is a number, too."""
    values = _join_finite(parts)
    with np.errstate(over="ignore"):
        found = float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
    return min(found, MOST) if np.isfinite(found) and found > 0.0 else 1.0


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
    )
