"""Keeping a simulation to the wall clock."""

from __future__ import annotations

import time
from collections.abc import Callable

from diffsim.core.check import require_number
from diffsim.core.checked import checked


class Pacer:
    """Waits until the wall clock has caught up with the simulation, and says how far it is behind.

    Args:
        speed: Simulated per wall second; 0: never wait.
        clock: Wall time [s].
        sleep: Waits that long [s].

    Attributes:
        max_lag: Largest delay behind the wall clock so far, in wall time [s].
        num_late: Steps that came late.
        num_steps: Steps so far.
    """

    @checked
    def __init__(
        self,
        speed: float = 1.0,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.speed = require_number("speed", speed, at_least=0.0)
        self._clock, self._sleep = clock, sleep
        self._start: float | None = None
        self.max_lag, self.num_late, self.num_steps = 0.0, 0, 0

    def wait(self, simulated: float) -> float:
        """Wait for the wall time of a simulated time [s]; the first call sets the zero.

        Returns:
            Delay behind the wall clock [s], 0 where it had to wait.
        """
        if self.speed == 0.0:
            return 0.0
        self.num_steps += 1
        if self._start is None:
            self._start = self._clock() - simulated / self.speed
            return 0.0
        early = self._start + simulated / self.speed - self._clock()
        if early >= 0.0:
            self._sleep(early)
            return 0.0
        self.num_late += 1
        self.max_lag = max(self.max_lag, -early)
        return -early
