"""Agile flight to waypoints: a loss of airframe and controller together, with its gradient."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.airframe import Airframe
from diffsim.copter.dynamics.flight import Feedback, Flight, fly
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.dynamics.hover import hover
from diffsim.copter.dynamics.linearize import linearize
from diffsim.copter.dynamics.lqr import lqr
from diffsim.copter.vehicle.effects import FlightEffects, MotorLag
from diffsim.core.arrays import Array
from diffsim.core.check import require
from diffsim.core.torch_names import on_constants
from diffsim.core.values import as_array

# What the controller's numbers weigh, and the states of 12 that share each.
WEIGHTS: dict[str, tuple[int, ...]] = {
    "x, y": (0, 1),
    "z": (2,),
    "roll, pitch": (3, 4),
    "yaw": (5,),
    "u, v": (6, 7),
    "w": (8,),
    "p, q": (9, 10),
    "r": (11,),
}
_DECADES = (-2.0, 3.0)  # of a weight, at 0 and 1
_NEAR = 0.05  # [m], below which a distance counts as its square
_OVERLAP = 200.0  # price of an overlap, per m^2 over radius^2
_GAIN_SPAN = 1.0  # what a free entry of the gain may add, in shares of the largest of its column


@dataclass(frozen=True, kw_only=True)
class WaypointTask:
    """Waypoints in all directions, at rest at the start, one after the other by the clock.

    Attributes:
        airframe: Space of the designs.
        num_episodes: Flights, each with waypoints of its own.
        num_waypoints: Per flight.
        seconds: For each waypoint [s].
        distance: From one waypoint to the next [m].
        seed: Of the waypoints.
        dt: Control period [s].
        motor_time_constant: Lag of thrust behind its command [s].
        free_gain: Whether the controller's numbers include every entry of the feedback gain.
        flies: How vehicles fly: ``fly``, or that of a diagnosed copter, whose members are one, or
            as many as episodes. The controller is that of the vehicle as designed.
    """

    airframe: Airframe = field(default_factory=Airframe)
    num_episodes: int = 24
    num_waypoints: int = 2
    seconds: float = 1.5
    distance: float = 2.0
    seed: int = 0
    dt: float = 0.01
    motor_time_constant: float = 0.04
    free_gain: bool = False
    flies: Callable[..., Flight] = fly

    @property
    def num_design(self) -> int:
        """Numbers of the airframe, the first of a point."""
        return self.airframe.num_parameters

    @property
    def num_parameters(self) -> int:
        """Numbers of a point: airframe, weights of the LQR, entries of the gain if free."""
        entries = 2 * self.airframe.num_pairs * 12 if self.free_gain else 0
        return self.num_design + len(WEIGHTS) + entries

    @property
    def start(self) -> Tensor:
        """The conventional airframe under an LQR of middle weights, (num_parameters,)."""
        rest = self.num_parameters - self.num_design
        return torch.cat(
            [self.airframe.conventional, torch.full((rest,), 0.5, dtype=torch.float64)]
        )

    @cached_property
    @on_constants()
    def references(self) -> Tensor:
        """Waypoints at every control step, (num_episodes, steps, 3) [m]."""
        rng = np.random.default_rng(self.seed)
        way = rng.standard_normal((self.num_episodes, self.num_waypoints, 3))
        way *= self.distance / np.linalg.norm(way, axis=-1, keepdims=True)
        places = torch.from_numpy(np.cumsum(way, axis=1))
        return places.repeat_interleave(round(self.seconds / self.dt), dim=1)

    def fly(self, x: Tensor) -> Flight:
        """All flights of a point, (num_parameters,) in [0, 1]. Gradient: x.

        Raises:
            HoverError: the design does not hover.
            RiccatiError, FlightError: it cannot be controlled, or left the finite numbers.
        """
        vehicle = self.airframe.vehicle(x[: self.num_design])
        trim = hover(vehicle, on_infeasible="raise")
        model = linearize(vehicle, trim.thrusts, trim.attitude)
        low, high = _DECADES
        logs = low + (high - low) * x[self.num_design : self.num_design + len(WEIGHTS)]
        column = {state: k for k, states in enumerate(WEIGHTS.values()) for state in states}
        q = 10.0 ** logs[[column[state] for state in range(12)]]
        gain = lqr(model.A, model.B, torch.diag(q), torch.eye(vehicle.num_rotors, dtype=q.dtype)).K
        if self.free_gain:
            free = x[self.num_design + len(WEIGHTS) :].view_as(gain)
            span = _GAIN_SPAN * gain.abs().amax(0)
            gain = gain + span * (2.0 * free - 1.0)
        steps = self.references.shape[1]
        turned = torch.cat([trim.attitude, trim.attitude.new_zeros(7)])
        reference = torch.cat([self.references, turned.expand(self.num_episodes, steps, 9)], dim=-1)
        lag = torch.full((vehicle.num_rotors,), self.motor_time_constant, dtype=q.dtype)
        level = torch.cat([trim.attitude, trim.attitude.new_zeros(1)])
        begin = FlightState.at_rest(torch.zeros(1, 3, dtype=q.dtype), level[None])
        return self.flies(
            vehicle,
            begin,
            trim.thrusts.expand(1, steps, -1),
            dt=self.dt,
            feedback=Feedback(gain=gain, reference=reference),
            effects=FlightEffects(motor_lag=MotorLag(time_constants=lag)),
        )

    def distances(self, flight: Flight) -> Tensor:
        """Distance from the waypoint at every control step, (num_episodes, steps) [m]."""
        away = flight.state.position[:, 1:] - self.references
        return (away.square().sum(-1) + _NEAR**2).sqrt() - _NEAR

    def loss(self, x: Tensor) -> Tensor:
        """Mean distance from the waypoint [m], and the price of streams that overlap. Gradient: x.

        Raises:
            As ``fly``.
        """
        overlap = self.airframe.gaps(x[: self.num_design]).clamp_max(0.0)
        price = _OVERLAP * (overlap / self.airframe.parts.radius).square().sum()
        return self.distances(self.fly(x)).mean() + price

    def value(self, x: Array) -> float:
        """The loss at a point, (num_parameters,)."""
        with torch.no_grad():
            return float(self.loss(self._point(x)))

    def value_and_gradient(self, x: Array) -> tuple[float, Array]:
        """The loss and its gradient, (num_parameters,)."""
        leaf = self._point(x).clone().requires_grad_()
        loss = self.loss(leaf)
        (gradient,) = torch.autograd.grad(loss, leaf)
        return float(loss.detach()), gradient.numpy()

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of points."""
        return np.zeros(self.num_parameters), np.ones(self.num_parameters)

    def random_start(self, seed: int) -> Array:
        """A point drawn between the bounds; entries of the gain stay as LQR has them."""
        x = np.random.default_rng(seed).uniform(size=self.num_parameters)
        x[self.num_design + len(WEIGHTS) :] = 0.5
        return x

    def smallest_gap(self, x: Array) -> float:
        """Least room between streams, and between streams and cage [m]."""
        with torch.no_grad():
            return float(self.airframe.gaps(self._point(x)[: self.num_design]).min())

    def _point(self, x: Array) -> Tensor:
        given = as_array("x", x)
        return require("x", given.detach().double(), (self.num_parameters,))

    def weights(self, x: Array) -> dict[str, float]:
        """Weights of the LQR by the names of what they weigh."""
        low, high = _DECADES
        return {
            name: math.pow(10.0, low + (high - low) * x[self.num_design + k])
            for k, name in enumerate(WEIGHTS)
        }
