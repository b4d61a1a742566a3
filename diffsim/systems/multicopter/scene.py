"""A multicopter under recorded commands in one run, ready to be simulated."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from diffsim.systems.multicopter.flight import SENSORS, CopterFlight, amount, vector
from diffsim.systems.multicopter.flying import Flyer
from diffsim.systems.multicopter.shooting import MAX_STEPS, Shooting


@dataclass(frozen=True, kw_only=True, eq=False)
class CopterScene(CopterFlight):
    """A flight whose prediction is simulated, initial states of its windows fitted away."""

    def simulate(self) -> Tensor:
        """Predicted channels of one point, (num_samples, num_channels)."""
        return self.simulate_many(1, self.settled())[0]

    def settled(self, max_steps: int = MAX_STEPS) -> Shooting:
        """Best initial states of one point and their tangents there, found within some steps."""
        return self.windows.settled(lambda starts: Flyer(self, len(starts))(starts), max_steps)

    def simulate_many(self, points: int, shooting: Shooting) -> Tensor:
        """Predicted channels with the best initial states.

        Args:
            points: Number of points that the scene's leading axes stand for.
            shooting: Fit of the initial states, of a point near all of them.

        Returns:
            (points, num_samples, num_channels).
        """
        return shooting.profile(Flyer(self, points))[:, : self.commands.shape[1]]


__all__ = ["SENSORS", "CopterScene", "amount", "vector"]
