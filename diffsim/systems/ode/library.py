"""What the candidate causes of a system are made from: its names and usual magnitudes.

Sizes that would be no surprise follow from one simulation of the plain model, so that nobody has to
state how large a friction could be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.model import SimModel
from diffsim.systems.ode.keys import Place, Store
from diffsim.systems.ode.network import Network, product
from diffsim.systems.ode.scene import OdeScene

Array = NDArray[np.float64]
RESTS = 1e-3  # of what a channel shows: less is no motion
SHARE_OF_USUAL = 0.1  # of a usual magnitude: what a cause may be without surprise
MAGNITUDES = "magnitudes"  # place in a study's frame
MOST = 1e80  # of a magnitude: a model that runs away


def needs_order(study: Study) -> str | None:
    """What a study lacks for something to drift from run to run."""
    return None if len({r.order for r in study.fit_runs}) > 2 else "three runs to fit"


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


@dataclass(frozen=True, eq=False)
class Magnitudes:
    """Usual magnitudes of a plain model and of its recordings, over the runs to fit.

    Sizes of causes mean what they mean by these numbers. They are saved with extended models, so
    that a model is the same on other recordings.

    Attributes:
        places: Usual magnitudes at each place, by name.
        stores: Usual magnitudes of each store, by name.
        inputs: Greatest magnitude of each input, by name.
        usual: Rms of each input and definition, by name.
        one_sided: Inputs that are never below zero.
        ranges: Least and greatest sample of each channel, by name.
        longest: Duration of the longest run [s].
        several_runs: Whether something may drift from run to run.
        begins_moving: Whether runs begin in motion or with a jump of an input: then a record that
            is late as a whole differs from late inputs, of which nobody knows what was before.
    """

    places: Mapping[str, PlaceScale]
    stores: Mapping[str, StoreScale]
    inputs: Mapping[str, float]
    usual: Mapping[str, float]
    one_sided: frozenset[str]
    ranges: Mapping[str, tuple[float, float]]
    longest: float
    several_runs: bool
    begins_moving: bool = False

    def saved(self) -> dict[str, Any]:
        """In types that YAML has."""
        out = asdict(self)
        ranges = {name: list(ends) for name, ends in self.ranges.items()}
        return out | {"one_sided": sorted(self.one_sided), "ranges": ranges}

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Magnitudes:
        """The inverse of ``saved``."""
        return cls(
            **{
                **saved,
                "places": {k: PlaceScale(**v) for k, v in saved["places"].items()},
                "stores": {k: StoreScale(**v) for k, v in saved["stores"].items()},
                "one_sided": frozenset(saved["one_sided"]),
                "ranges": {k: (v[0], v[1]) for k, v in saved["ranges"].items()},
            }
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Library:
    """Names and magnitudes of a described system.

    Attributes:
        study: Study with the recordings.
        known: Names that formulas may use.
        held: Inputs, with whether they are held between samples.
        places: Where forces may act, each with its usual magnitudes.
        stores: What fills and empties, each with its usual magnitudes.
        scales: Usual magnitudes of everything else.
        step: Longest step of the integrator [s].
        unsure: Inputs of which nobody knows whether they are held between samples.
        assumed: Inputs that are taken to be held though some run does not show it.
        usual: Magnitudes of the plain model and of the recordings.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
    """

    study: Study
    known: tuple[str, ...]
    held: Mapping[str, bool]
    places: tuple[tuple[Place, PlaceScale], ...]
    stores: tuple[tuple[Store, StoreScale], ...]
    scales: Magnitudes
    unsure: frozenset[str] = frozenset()
    assumed: frozenset[str] = frozenset()
    clocks: frozenset[tuple[str, ...]] = frozenset()
    step: float = math.inf

    @property
    def inputs(self) -> Mapping[str, float]:
        """Greatest magnitude of each input, by its name."""
        return self.scales.inputs

    @property
    def usual(self) -> Mapping[str, float]:
        """Rms of each input and definition, by its name."""
        return self.scales.usual

    @property
    def one_sided(self) -> frozenset[str]:
        """Inputs that are never below zero."""
        return self.scales.one_sided

    @property
    def longest(self) -> float:
        """Duration of the longest run [s]."""
        return self.scales.longest

    @property
    def several_runs(self) -> bool:
        """Whether something may drift from run to run."""
        return self.scales.several_runs

    def spread(self, channel: int) -> float:
        """Range of a channel over the runs to fit [unit of the channel]."""
        return self.spread_of(self.study.channels[channel].name)

    def spread_of(self, channel: str) -> float:
        """The same by the channel's name."""
        low, high = self.scales.ranges[channel]
        return high - low


def magnitudes(
    study: Study,
    model: SimModel,
    network: Network,
    known: Sequence[str],
    places: Sequence[Place],
    stores: Sequence[Store],
) -> Magnitudes:
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
    if MAGNITUDES in study.frame:
        kept = Magnitudes.of(study.frame[MAGNITUDES])
        require_kept("place", [p.name for p in places], kept.places)
        require_kept("store", [s.name for s in stores], kept.stores)
        return kept
    between = {n: parse_expression(n, known) for n in (*network.inputs, *network.definitions)}
    inside = _inside(network, known, places, stores)
    read = network.with_readings({**inside, **{f"usual {n}": e for n, e in between.items()}})
    columns: dict[str, list[Array]] = {}
    inputs: dict[str, float] = {}
    two_sided: set[str] = set()
    ranges = {c.name: _range(study, i) for i, c in enumerate(study.channels)}
    begins_moving = False
    for run in study.fit_runs or study.runs:
        scene = model.scene(run, model.at_prior())
        assert isinstance(scene, OdeScene)
        with torch.no_grad():
            readings, _ = scene.solved(read)
        for name, column in zip(read.readings, readings.unbind(-1), strict=True):
            columns.setdefault(name, []).append(column.numpy())
        for name, u in scene.inputs.items():
            inputs[name] = max(inputs.get(name, 0.0), float(u.abs().max()))
            two_sided |= {name} if float(u.min()) < 0.0 else set()
        begins_moving = begins_moving or _moves_at_first(scene, ranges)
    return Magnitudes(
        {p.name: _place_scale(p, columns) for p in places},
        {s.name: _store_scale(s, columns) for s in stores},
        {name: most or 1.0 for name, most in inputs.items()},
        {name: _rms(columns[f"usual {name}"]) for name in between},
        frozenset(inputs) - two_sided,
        ranges,
        max(float(r.time_s[-1] - r.time_s[0]) for r in study.runs),
        len({r.order for r in study.fit_runs}) > 2,
        begins_moving,
    )


def _moves_at_first(scene: OdeScene, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the plain model would not rest if its inputs stayed as they are at first."""
    for name in scene.inputs:
        scene = scene.with_input(name, lambda u, grid: u[..., :1].expand_as(u))
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


def _range(study: Study, channel: int) -> tuple[float, float]:
    """Least and greatest sample of a channel over the runs to fit; one apart if all are alike."""
    seen = _finite([r.measured[:, channel] for r in study.fit_runs or study.runs])
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _inside(
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


def _finite(parts: Sequence[Array]) -> Array:
    values = np.concatenate(parts)
    return np.asarray(values[np.isfinite(values)])


def _rms(parts: Sequence[Array]) -> float:
    """Rms; 1 where that is no number or zero, at most ``MOST``: its cube is a number, too."""
    values = _finite(parts)
    with np.errstate(over="ignore"):
        found = float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
    return min(found, MOST) if np.isfinite(found) and found > 0.0 else 1.0


def _place_scale(place: Place, columns: Mapping[str, list[Array]]) -> PlaceScale:
    path = columns[f"{place.name} position"]
    away = _finite([p - p[0] for p in path])
    usual = _rms([away])
    return PlaceScale(
        force=_rms(columns[f"{place.name} force"]),
        inertia=_rms([i[:1] for i in columns[f"{place.name} inertia"]]),
        position=usual,
        velocity=_rms(columns[f"{place.name} velocity"]),
        low=float(_finite(path).min(initial=0.0)),
        high=float(_finite(path).max(initial=0.0)),
        below=max(-float(away.min(initial=0.0)), 0.1 * usual),
        above=max(float(away.max(initial=0.0)), 0.1 * usual),
    )


def _store_scale(store: Store, columns: Mapping[str, list[Array]]) -> StoreScale:
    levels = columns[f"{store.name} level"]
    return StoreScale(
        _rms(levels), _rms(columns[f"{store.name} rate"]), float(_finite(levels).max(initial=0.0))
    )
