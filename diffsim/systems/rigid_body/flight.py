"""A ball in flight: polynomials in time by collocation, and the moment at which it lands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_DEGREE = 10

_nodes = 0.5 - 0.5 * np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
_powers = np.vander(_nodes, _DEGREE + 1, increasing=True)
#: From values at the nodes to coefficients of powers, and to integrals from 0 to each node.
_COEFFICIENTS = torch.from_numpy(np.linalg.inv(_powers))
_INTEGRALS = torch.from_numpy(
    (_powers * _nodes[:, None] / np.arange(1, _DEGREE + 2)) @ np.linalg.inv(_powers)
)


@dataclass(frozen=True, eq=False)
class BallFlight:
    """Place and velocity over ``span``."""

    span: Tensor  # duration of each flight, (K,) [s]
    # place, velocity: coefficients of powers of time over span, (K, degree + 1, 3) [m, m/s]
    place: Tensor
    velocity: Tensor

    @classmethod
    def over(
        cls,
        place: Tensor,
        velocity: Tensor,
        acceleration: Callable[[Tensor], Tensor],
        span: Tensor,
    ) -> BallFlight:
        """Solve v' = a(v) from a start.

        Args:
            place, velocity: At first, (K, 3) [m, m/s].
            acceleration: Velocities (K, num_nodes, 3) -> accelerations of equal shape [m/s^2].
            span: Duration, (K,) [s].
        """
        span = span.clamp(min=1e-4)  # [s]
        wide = span[:, None, None]
        speed = velocity[:, None].expand(-1, _DEGREE + 1, -1)
        for _ in range(14):  # each takes a factor of about (drag times path) off the error
            speed = velocity[:, None] + wide * (_INTEGRALS @ acceleration(speed))
        where = place[:, None] + wide * (_INTEGRALS @ speed)
        return cls(span, _COEFFICIENTS @ where, _COEFFICIENTS @ speed)

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Place and velocity at times (K, T) since the start, (K, T, 3) each; held at the ends."""
        share = (time / self.span[:, None]).clamp(0.0, 1.0)
        powers = share[..., None] ** torch.arange(_DEGREE + 1)
        return powers @ self.place, powers @ self.velocity

    def landing(self, height: Tensor, first: Tensor) -> Tensor:
        """When the center comes down to a height, by Newton's method, (K,) [s].

        Args:
            height: Height above the ground, (K,) [m].
            first: First guess, (K,) [s].
        """
        time = first
        for _ in range(5):
            place, velocity = (y[:, 0] for y in self.at(time[:, None]))
            # at the ends of the span the polynomial is held: beyond, the slope goes on
            beyond = (time - self.span).clamp(min=0.0)
            gap = place[:, 2] + beyond * velocity[:, 2] - height
            time = (time - gap / velocity[:, 2].clamp(max=-1e-3)).clamp(min=0.0)
        return time


def fall_time(height: Tensor, speed: Tensor, gravity: Tensor) -> Tensor:
    """Duration of a flight without drag.

    Args:
        height: Above the level of landing, (K,) [m].
        speed: Upward, (K,) [m/s].
        gravity: Strength of gravity, (K,) [m/s^2].
    """
    root = (speed**2 + 2.0 * gravity * height).clamp(min=0.0) + 1e-12
    return (speed + root.sqrt()) / gravity


def span_of(fall: Tensor) -> Tensor:
    """Duration over which a flight is solved, for one that would take ``fall`` without drag."""
    return 1.1 * fall  # of a flight without drag
