"""A multicopter under recorded commands in one run, ready to be simulated."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from torch import Tensor

from diffsim.core.layer import may_be_differentiated
from diffsim.systems.multicopter.flight import SENSORS, CopterFlight, amount, vector
from diffsim.systems.multicopter.flying import Flyer
from diffsim.systems.multicopter.numbers import change_number
from diffsim.systems.multicopter.shooting import MAX_STEPS, FlightShooting


@dataclass(frozen=True, kw_only=True, eq=False)
class CopterScene(CopterFlight):
    """A flight whose prediction is simulated, initial states of its windows fitted away.

    Attributes:
        point: Point of the parameters, by which its initial states are known again; None: unknown.
        note: Told of every flight that a search for initial states takes, with the number of starts
            that fly side by side; None: nobody counts.
    """

    point: Hashable | None = None
    note: Callable[[int], None] | None = None

    def simulate(self) -> Tensor:
        """Predicted channels of one point, (num_samples, num_channels)."""
        shooting = self.settled()
        if may_be_differentiated():
            return self.simulate_many(1, shooting)[0]
        return shooting.at_own_point()[: self.commands.shape[1]]

    def settled(self, max_steps: int = MAX_STEPS) -> FlightShooting:
        """Best initial states of one point and their tangents there, found within some steps; those
        of the last points are kept."""
        if self.point is None:
            return self._search_starts(max_steps)
        return self.windows.known(self.point, lambda: self._search_starts(max_steps))

    def _search_starts(self, max_steps: int) -> FlightShooting:
        flyers: dict[int, Flyer] = {}

        def predict(starts: Tensor) -> Tensor:
            # one for each number of starts: its last forces are the first guess of the next flight
            points = len(starts)
            if self.note is not None:
                self.note(points)
            if points not in flyers:
                flyers[points] = Flyer(self, points, is_one=True)
            return flyers[points](starts)

        return self.windows.settled(predict, max_steps)

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> CopterScene:
        """A copy in which one of ``NUMBERS`` is f(number), its last axis that of the points."""
        return change_number(self, name, change)

    def simulate_many(self, points: int, shooting: FlightShooting) -> Tensor:
        """Predicted channels with the best initial states.

        Args:
            points: Number of points that the scene's leading axes stand for.
            shooting: Fit of the initial states, of a point near all of them.

        Returns:
            (points, num_samples, num_channels).
        """
        return shooting.profile(Flyer(self, points))[:, : self.commands.shape[1]]


__all__ = ["SENSORS", "CopterScene", "amount", "vector"]
