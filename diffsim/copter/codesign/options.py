"""How a co-design is searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

from diffsim.copter.codesign.wrench import Rotors
from diffsim.core.check import require_choice, require_number


@dataclass(frozen=True)
class AlternatingOptions:
    """Of Alg. 1.

    Attributes:
        eta: Weight of the squared imbalance of force.
        mu: Weight of the squared imbalance of torque.
        units: Of the imbalances: ``SI`` (N and N m, as published) or ``relative`` (over m g and
            over m g L, L the mean arm).
        tolerance: Stop where a round improves the energy by less.
        max_rounds: Stop anyway.
    """

    eta: float = 0.3
    mu: float = 0.7
    units: str = "SI"
    tolerance: float = 1e-6
    max_rounds: int = 200

    def __post_init__(self) -> None:
        for name in ("eta", "mu", "tolerance"):
            require_number(name, float(getattr(self, name)), above=0.0)
        require_choice("units", self.units, ("SI", "relative"))
        require_number("max_rounds", self.max_rounds, at_least=1)

    def relative(self, rotors: Rotors) -> AlternatingOptions:
        """The same weights in relative units."""
        if self.units == "relative":
            return self
        unit = rotors.weight * rotors.length
        eta, mu = self.eta * rotors.weight**2, self.mu * unit**2
        return replace(self, eta=eta, mu=mu, units="relative")
