"""How a co-design is searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

from diffsim.copter.codesign.wrench import Rotors
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked


@checked
@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """From where, how often and by which solver a co-design is searched.

    Attributes:
        num_starts: Local solves, or starts of the alternation.
        num_spins: Best spin assignments that share the starts of the joint method.
        seed: Seed of the random starts; the first ones are the design itself.
        max_iters: Largest number of iterations of each local solve.
        solver: ``uno``, ``uno-ipm``, ``slsqp`` or ``trust-constr``; None: ``uno``, or ``uno-ipm``
            where torques or lost rotors ask for several flight cases; ``slsqp`` without Uno.
    """

    num_starts: int = 8
    num_spins: int = 4
    seed: int = 0
    max_iters: int = 300
    solver: str | None = None

    def __post_init__(self) -> None:
        require_number("num_starts", self.num_starts, at_least=1)
        require_number("num_spins", self.num_spins, at_least=1)


@checked
@dataclass(frozen=True)
class AlternatingOptions:
    """Weights and stopping rule of the alternation (thesis Alg. 1).

    Attributes:
        eta: Weight of the squared imbalance of force.
        mu: Weight of the squared imbalance of torque.
        units: Units of the imbalances: ``SI`` (N and N m, as published) or ``relative`` (over m g
            and over m g L, L the mean arm).
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

    @checked
    def relative(self, rotors: Rotors) -> AlternatingOptions:
        """The same weights in relative units."""
        if self.units == "relative":
            return self
        unit = rotors.weight * rotors.length
        eta, mu = self.eta * rotors.weight**2, self.mu * unit**2
        return replace(self, eta=eta, mu=mu, units="relative")
