"""Numerical settings relative to those that a model uses by default."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Numerics:
    """Factors on the model's own settings.

    Attributes:
        time_step: Factor on the time step [-].
        mesh: Factor on the cell size [-].
        tolerance: Factor on the tolerances of the solvers [-].
    """

    time_step: float = 1.0
    mesh: float = 1.0
    tolerance: float = 1.0

    def refined(self, finer: Numerics) -> Numerics:
        """Product of both sets of factors."""
        return Numerics(
            self.time_step * finer.time_step,
            self.mesh * finer.mesh,
            self.tolerance * finer.tolerance,
        )


REFINEMENTS = {
    "time_step": Numerics(time_step=0.5),
    "mesh": Numerics(mesh=0.5),
    "tolerance": Numerics(tolerance=0.1),
}
"""What the numerics gate refines, one setting at a time."""
