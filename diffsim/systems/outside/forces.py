"""Forces that a simulator is asked to add at its places, by their law; plain numbers, no tensors.

A simulator knows its state, and calls back at each of its steps. So laws that depend on speed or
displacement are exact, whatever the integrator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.causes.ports import FADE_SHARE, OF_FORCES
from diffsim.causes.scene import LawFormula
from diffsim.core.arrays import Array
from diffsim.core.checked import checked

CONSTANT = "size"  # law of a force that depends on nothing


@dataclass(frozen=True)
class Term:
    """One force at one place."""

    place: str  # name of the place
    # formula of ``OF_FORCES``: size, position x, speed v, and w, below which dry friction fades
    law: LawFormula
    size: float  # size of the law, in the effect's unit
    scale: float = 1.0  # usual speed of the place, of which w is a hundredth
    # further numbers of the law, of simulators that have it as their own
    shapes: tuple[float, ...] = ()


@dataclass(frozen=True)
class ForceKnots:
    """A force at one place that follows straight lines between knots in time."""

    place: str  # name of the place
    start: float  # time of the first knot [s]
    spacing: float  # time between two knots [s]
    values: tuple[float, ...]  # force at the knots, (num_knots,)

    def at(self, time: float) -> float:
        """Force at a time [s], held beyond the ends."""
        last = len(self.values) - 1
        at = min(max((time - self.start) / self.spacing, 0.0), float(last))
        left = min(int(at), last - 1)
        return self.values[left] + (at - left) * (self.values[left + 1] - self.values[left])


class PlaceForces:
    """What a simulator adds at its places: call it at each step.

    Args:
        places: Names of the places, in the order of the returned forces.
        terms: Forces by law.
        knots: Forces over time.

    Attributes:
        places: Names of the places.
        terms: Forces by law that act.
        acts: Whether any force is there; if not, a simulator may skip the call.
        key: What the forces depend on.
    """

    @checked
    def __init__(
        self, places: Sequence[str], terms: Sequence[Term], knots: Sequence[ForceKnots] = ()
    ):
        self.places = tuple(places)
        self.terms = tuple(t for t in terms if t.size != 0.0)
        self._knots = tuple(k for k in knots if any(k.values))
        self.acts = bool(self.terms or self._knots)
        self.key = (self.terms, self._knots)
        acting = dict.fromkeys([*(t.place for t in self.terms), *(k.place for k in self._knots)])
        #: Places where a force acts, by their index, with the force by time, position and velocity
        self.acting = tuple((self.places.index(p), self._force_at(p)) for p in acting)

    def _force_at(self, place: str) -> Callable[[float, float, float], float]:
        """The force at a place as a function of time, position and velocity."""
        laws = [
            (t.law.on_floats(*OF_FORCES), t.size, FADE_SHARE * t.scale)
            for t in self.terms
            if t.place == place
        ]
        knots = [k for k in self._knots if k.place == place]

        def force(time: float, position: float, velocity: float) -> float:
            out = 0.0
            for law, size, width in laws:
                out += law(size, position, velocity, width)
            for k in knots:
                out += k.at(time)
            return out

        return force

    @property
    def is_over_time(self) -> bool:
        """Whether all of it is known before the simulation: straight lines over time, constants."""
        return all(getattr(t.law, "text", "") == CONSTANT for t in self.terms)

    def over(self, times: Array) -> dict[int, Array]:
        """Forces that are known before the simulation, at times [s], (num_times,) each, by the
        index of their place; of ``is_over_time``."""
        out = {i: np.zeros(len(times)) for i, _ in self.acting}
        for t in self.terms:
            out[self.places.index(t.place)] += t.size
        for k in self._knots:
            at = k.start + k.spacing * np.arange(len(k.values))
            out[self.places.index(k.place)] += np.interp(times, at, k.values)
        return out

    def without(self, terms: Sequence[Term]) -> PlaceForces:
        """The same but for forces that a simulator has itself."""
        return PlaceForces(self.places, [t for t in self.terms if t not in terms], self._knots)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.places, self.terms, self._knots)  # functions stay here

    def __call__(
        self,
        time: float,
        positions: Sequence[float] | Array,
        velocities: Sequence[float] | Array,
    ) -> Array:
        """Generalized forces at the places, (num_places,), in the units of the description.

        Args:
            time: Time on the clock of the run's ``time_s`` [s].
            positions: Position or angle of each place, in the order of ``places``.
            velocities: Their rates.
        """
        out = np.zeros(len(self.places))
        for i, force in self.acting:
            out[i] = force(time, float(positions[i]), float(velocities[i]))
        return out
