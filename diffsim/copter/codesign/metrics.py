"""What a multicopter can be designed for (thesis 3.4.3), and non-negative mixes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.optional import optional

# All are minimized; {name: what it is, in relative units}.
METRICS = {
    "payload": "largest thrust over its limit at the start's weight, eq. 3.13",
    "current": "sum of currents in hover over that of the start, eq. 3.14",
    "max_current": "largest current of a motor over that of the start, eq. 3.15",
    "size": "length of rods over that of the start, eq. 3.16",
    "flight_time": "-size: room for larger propellers, eq. 3.17",
    "cost": "over that of the start, eq. 3.18",
    "mass": "over that of the start, eq. 3.19",
    "authority": "-(multiple of torques 1, 1, 0.1 N m, all signs, left while carrying `load`)",
    "one_rotor_out": "payload metric after the worst failure of a rotor, yaw given up",
    "response": "time to turn by `response_angle` about roll or pitch and stop, over 1 s",
}
EPIGRAPH = ("payload", "max_current", "authority", "one_rotor_out", "response")
ALTERNATING = ("payload", "current", "max_current", "size", "flight_time", "cost", "mass")
_OF_CURRENT = ("current", "max_current")


@checked
@dataclass(frozen=True)
class CurrentModel:
    """Current of a motor against its thrust, I = scale u^exponent (thesis eq. 3.14).

    Attributes:
        scale: (n_rotors,) [A / N^exponent], > 0.
        exponent: (n_rotors,), >= 1 (the metric would not be convex below).
    """

    scale: Array
    exponent: Array

    def __post_init__(self) -> None:
        for name in ("scale", "exponent"):
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), float)))
        if self.scale.shape != self.exponent.shape:
            raise ValueError(
                f"scale and exponent of currents need one value per rotor each, got "
                f"{self.scale.shape} and {self.exponent.shape}"
            )
        if not (np.isfinite(self.scale).all() and (self.scale > 0.0).all()):
            raise ValueError(f"scale of currents must be above 0, got {self.scale.tolist()}")
        if not (np.isfinite(self.exponent).all() and (self.exponent >= 1.0).all()):
            raise ValueError(f"exponent of currents must be >= 1, got {self.exponent.tolist()}")

    @checked
    def current(self, thrusts: Array) -> Array:
        """Currents at thrusts u, (..., n_rotors) [N] -> [A]."""
        return self.scale * np.maximum(thrusts, 0.0) ** self.exponent


def parse_objective(
    objective: str | Mapping[str, float], *, known: Sequence[str] = tuple(METRICS)
) -> dict[str, float]:
    """Weights by metric of ``"payload"`` or ``{"payload": 1.0, "size": 0.2}``.

    Raises:
        ValueError: unknown metric (the closest names are offered), negative weight, no metric.
    """
    mix = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    for name in mix:
        require_choice("metric", name, known)
        require_number(f"weight of {name}", mix[name], at_least=0.0)
    mix = {name: float(weight) for name, weight in mix.items() if weight > 0.0}
    if not mix:
        raise ValueError(
            f"objective must name a metric with a weight above 0, one of {list(known)}"
        )
    return mix


def require_currents(
    weights: Mapping[str, float], currents: CurrentModel | None, num_rotors: int
) -> CurrentModel | None:
    """The model of currents, one value per rotor, where a metric needs it.

    Raises:
        ValueError: it is missing or of another number of rotors.
    """
    needing = [name for name in _OF_CURRENT if name in weights]
    if currents is None:
        if needing:
            raise ValueError(
                f"metric {needing[0]!r} needs currents=CurrentModel(scale, exponent) of the rotors"
            )
        return None
    if len(currents.scale) not in (1, num_rotors):
        raise ValueError(f"currents has {len(currents.scale)} rotors, the design {num_rotors}")
    full = np.ones(num_rotors)
    return CurrentModel(currents.scale * full, currents.exponent * full)


def require_cvxpy() -> ModuleType:
    """cvxpy, or how to get it.

    Raises:
        ImportError: it is not installed.
    """
    return optional("cvxpy", purpose="the alternation or the bound of a co-design")
