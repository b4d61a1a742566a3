"""What bounds a co-design besides its feasible set, and what its metrics are relative to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked

FREE = ("shape", "directions", "attitude")
"""What a co-design may change."""


@checked
@dataclass(frozen=True, kw_only=True)
class Limits:
    """What bounds directions, attitude and distances, besides A s <= b.

    Attributes:
        max_tilt: Largest angle of a rotor's axis from the body's up direction [rad].
        max_attitude: Largest roll or pitch of the hovering body [rad].
        clearance: Least distance between propeller discs seen from above [m]; None: not asked.
        free: What may change: any of shape, directions, attitude.
        extent: Largest change of a shape parameter, in mean arm lengths.
        nearness: Weight of half the squared distance from the start (relative shape, upright
            rotors, level body): picks one design where many are equally good.
    """

    max_tilt: float = np.pi / 6
    max_attitude: float = np.pi / 12
    clearance: float | None = None
    free: tuple[str, ...] = FREE
    extent: float = 2.0
    nearness: float = 1e-4

    def __post_init__(self) -> None:
        for name in self.free:
            require_choice("free", name, FREE)
        object.__setattr__(self, "free", tuple(self.free))
        require_number("max_tilt", float(self.max_tilt), above=0.0, below=np.pi / 2)
        require_number("max_attitude", float(self.max_attitude), above=0.0, below=np.pi / 2)
        require_number("extent", float(self.extent), above=0.0, below=1e6)
        require_number("nearness", float(self.nearness), at_least=0.0)
        if self.clearance is not None:
            require_number("clearance", float(self.clearance), at_least=0.0)


@dataclass(frozen=True)
class Scales:
    """What metrics of the start are, so that mixes are relative.

    Attributes:
        current, max_current: [A], of the start's weight shared out by the thrust limits.
        size, cost, mass: Size [m], cost [EUR] and mass [kg] of the start.
        inertia: Largest moment of inertia of the start [kg m^2], the unit of the response metric's
            target.
        response: 4 angle inertia / (m g L) [s^2]: turning by an angle and stopping at angular
            acceleration q m g L / inertia takes sqrt(response / q).
    """

    current: float
    max_current: float
    size: float
    cost: float
    mass: float
    inertia: float
    response: float
