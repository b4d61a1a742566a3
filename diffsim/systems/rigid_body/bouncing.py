"""A ball that flies, bounces, and stays on the ground when it bounces no more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.systems.rigid_body.on_ground import Ball, Laws, moved
from diffsim.systems.rigid_body.toss import REFERENCE_SPEED

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


SETTLES = 0.03  # [m/s] of the rebound: a bounce of 0.05 mm


@dataclass(frozen=True, eq=False)
class Bounces:
    """What a ball meets in the air and where it lands, (K,) each unless said otherwise."""

    laws: Laws  # motion on the ground, and air drag, gravity and friction of bounces
    lift: Tensor  # acceleration upwards [m/s^2]
    level: Tensor  # height of the ball's center on the ground [m]
    restitution: Tensor  # at 1 m/s [-]
    restitution_slope: Tensor  # growth of its logarithm per m/s [s/m]
    rebound: Tensor  # tangential restitution of a contact that sticks [-]
    lands: bool = True  # whether there is a ground

    def acceleration(self, velocity: Tensor) -> Tensor:
        """Of a ball in flight, (K, n, 3) of velocities (K, n, 3)."""
        laws = self.laws
        fall = torch.cat(
            [laws.gravity[:, None] * laws.tilt, (self.lift - laws.gravity)[:, None]], -1
        )
        speed = torch.sqrt((velocity**2).sum(-1, keepdim=True) + 1e-12)
        return fall[:, None] - laws.air_drag[:, None, None] * speed * velocity


@dataclass(frozen=True, eq=False)
class ThrownBall:
    """A ball in flight."""

    # place, velocity: (K, 3) [m, m/s]
    place: Tensor
    velocity: Tensor
    rolling: Tensor  # (K, 2) velocity at which it would roll with its spin [m/s]


def bounced(ball: ThrownBall, time: Tensor, ground: Bounces) -> tuple[Tensor, Tensor]:
    """Place and velocity of the center, (K, T, 3) each [m, m/s].

    Args:
        ball: At time 0.
        time: (K, T) [s]; before 0 as it flew then.
    """
    end = time.detach().amax(-1)
    begun = torch.zeros_like(end)
    settled = torch.zeros_like(end, dtype=torch.bool)
    shape = (*time.shape, 3)
    place, velocity = ball.place[:, None].expand(shape), ball.velocity[:, None].expand(shape)
    if bool((time < 0.0).any()):  # of a late camera: it was in flight before, too
        before = torch.where(time < 0.0, time, 0.0)[..., None]
        pull = ground.acceleration(velocity)
        place = place + velocity * before + 0.5 * pull * before**2
        velocity = velocity + pull * before
    for _ in range(60):
        height = ball.place[:, 2] - ground.level
        fall = fall_time(height, ball.velocity[:, 2], ground.laws.gravity)
        span = span_of(fall) if ground.lands else (end + 1e-3).expand_as(fall)
        flight = BallFlight.over(ball.place, ball.velocity, ground.acceleration, span)
        now = (time >= begun[:, None])[..., None] & ~settled[:, None, None]
        there, speed = flight.at(time - begun[:, None])
        place, velocity = torch.where(now, there, place), torch.where(now, speed, velocity)
        if not ground.lands:
            return place, velocity
        landing = flight.landing(ground.level, fall)
        ball = _keep_settled(
            settled, ball, _rebound_from_ground(flight, landing, ball.rolling, ground)
        )
        begun = torch.where(settled, begun, begun + landing)
        settled = settled | (ball.velocity[:, 2] < SETTLES)
        if bool((settled | (begun > end)).all()):
            break
    return _put_on_ground(ball, time - begun[:, None], settled, ground, (place, velocity))


def _rebound_from_ground(
    flight: BallFlight, landing: Tensor, rolling: Tensor, ground: Bounces
) -> ThrownBall:
    """The ball after an impact with the ground: restitution, and Coulomb friction or sticking."""
    place, velocity = (y[:, 0] for y in flight.at(landing[:, None]))
    approach = (-velocity[:, 2]).clamp(min=0.0)
    growth = ground.restitution_slope * (approach - REFERENCE_SPEED)
    rise = ground.restitution * torch.exp(growth) * approach
    slip = velocity[:, :2] - rolling
    size = torch.sqrt((slip**2).sum(-1) + 1e-18)
    stick = (1.0 + ground.rebound) * size / (1.0 + 1.0 / ground.laws.inertia)
    rub = torch.minimum(ground.laws.table_friction * (approach + rise), stick)
    step = (rub / size)[:, None] * slip
    return ThrownBall(
        torch.cat([place[:, :2], ground.level[:, None]], -1),
        torch.cat([velocity[:, :2] - step, rise[:, None]], -1),
        rolling + step / ground.laws.inertia[:, None],
    )


def _keep_settled(settled: Tensor, old: ThrownBall, new: ThrownBall) -> ThrownBall:
    keep = settled[:, None]
    return ThrownBall(
        torch.where(keep, old.place, new.place),
        torch.where(keep, old.velocity, new.velocity),
        torch.where(keep, old.rolling, new.rolling),
    )


def _put_on_ground(
    ball: ThrownBall, since: Tensor, settled: Tensor, ground: Bounces, flown: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """The flown motion, with the rest of it on the ground where the ball has settled."""
    now = (since >= 0.0)[..., None] & settled[:, None, None]
    if not bool(now.any()):
        return flown
    laws = ground.laws
    wide = Laws(*(getattr(laws, n)[:, None] for n in Laws.__dataclass_fields__))
    start = Ball(ball.place[:, None, :2], ball.velocity[:, None, :2], ball.rolling[:, None])
    end = moved(start, since.clamp(min=0.0), wide)
    level = ground.level[:, None, None].expand_as(end.place[..., :1])
    there = torch.cat([end.place, level], -1)
    speed = torch.cat([end.velocity, torch.zeros_like(level)], -1)
    return torch.where(now, there, flown[0]), torch.where(now, speed, flown[1])
