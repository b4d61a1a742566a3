"""Sensor noise of environments; differentiable rollouts see the plain observation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array
from diffsim.core.check import require_number

Array32 = NDArray[np.float32]


class ObservationNoise:
    """White noise on observations.

    Args:
        noise: Standard deviation, in units of the observation: one for all, or (n,).
        size: Number of observations.
    """

    def __init__(self, noise: float | Array, size: int):
        hint = f"give one standard deviation, or one for each of the {size} observations"
        try:
            given = np.asarray(noise, dtype=np.float64)
        except (TypeError, ValueError):
            raise TypeError(f"sensor_noise must be numbers, got {noise!r}; {hint}") from None
        if given.shape not in ((), (1,), (size,)):
            raise ValueError(f"sensor_noise must have shape ({size},), got {given.shape}; {hint}")
        for extreme in (given.min(), given.max()):  # NaN is both
            require_number("sensor_noise", float(extreme), at_least=0.0)
        self.sd = np.broadcast_to(given, (size,))

    def __call__(self, observation: Array, rng: np.random.Generator) -> Array32:
        """Noisy observation(s), (..., n) float32."""
        if self.sd.any():
            observation = observation + self.sd * rng.standard_normal(observation.shape)
        return observation.astype(np.float32)
