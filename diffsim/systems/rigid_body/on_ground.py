"""Rigid balls on the ground: sliding, rolling and one impact with friction, in closed form.

A ball's spin about a horizontal axis is given as the velocity w of the rolling that it belongs to
(spin z x w / r), that about the vertical as the speed of its equator. While it slips, friction acts
against v - w, whose direction stays; small extra accelerations (table's tilt, losses) are held over
each phase. Sources: Marlow, "The physics of pocket billiards", 1995, for the phases; impulses with
Coulomb friction as in Alciatore, "Pool and billiards physics", TP A.5 and A.14.

All numbers may carry batch axes in front; vectors are (..., 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.numbers import values_of
from diffsim.core.values import dot

_TINY = 1e-9
_MOST_STEPS = 12  # of Newton's method: five are needed, more where balls hardly meet
_SETTLED_S = 1e-12  # its last step; the next one would be its square: rounding


@dataclass(frozen=True, eq=False)
class Ball:
    """One ball: place and velocity of its center, spin as the velocity of rolling [m, m/s]."""

    place: Tensor
    velocity: Tensor
    rolling: Tensor


@dataclass(frozen=True, eq=False)
class Laws:
    """Parameters of the motion on the ground."""

    table_friction: Tensor  # Coulomb coefficient while a ball slips [-]
    rolling_resistance: Tensor  # deceleration over gravity [-]
    tilt: Tensor  # (..., 2) slope of the table, downhill positive [rad]
    air_drag: Tensor  # deceleration over speed squared [1/m]
    inertia: Tensor  # moment of inertia over mass and squared radius, I / (m r^2) [-]
    gravity: Tensor  # strength of gravity [m/s^2]


def moved(ball: Ball, time: Tensor, laws: Laws) -> Ball:
    """The ball after ``time`` [s] (...,): slipping until it rolls, then rolling."""
    slip = ball.velocity - ball.rolling
    speed_of_slip = _compute_length(slip)
    push = laws.table_friction * laws.gravity
    rate = push * (1.0 + 1.0 / laws.inertia)  # at which the slip falls
    slipping = torch.minimum(time, speed_of_slip / rate.clamp(min=_TINY))
    direction = slip / speed_of_slip[..., None]
    downhill = laws.gravity[..., None] * laws.tilt
    sliding = _advance(
        ball, slipping, -push[..., None] * direction + downhill + _compute_deceleration(ball, laws)
    )
    turned = ball.rolling + (push / laws.inertia * slipping)[..., None] * direction
    left = time - slipping
    downhill = downhill / (1.0 + laws.inertia)[..., None]
    rolled = _advance(sliding, left, downhill + _compute_deceleration(sliding, laws))
    return Ball(
        rolled.place, rolled.velocity, torch.where((left > 0)[..., None], rolled.velocity, turned)
    )


def time_of_impact(resting: Ball, coming: Ball, diameter: Tensor, laws: Laws) -> Tensor:
    """When the centers are one diameter apart [s], by Newton's method until it rests."""
    time = torch.zeros_like(diameter)
    for _ in range(_MOST_STEPS):
        time = time.detach()  # the last step alone carries the derivative, by a slope that is held
        a, b = moved(resting, time, laws), moved(coming, time, laws)
        apart = b.place - a.place
        distance = _compute_length(apart)
        closing = ((b.velocity - a.velocity) * apart).sum(-1) / distance
        slope = closing.detach().clamp(max=-0.05)
        before, time = time, (time - (distance - diameter) / slope).clamp(0.0, 1.0)
        if bool((values_of(time - before).abs() <= _SETTLED_S).all()):
            break
    return time


def impact(
    resting: Ball, coming: Ball, laws: Laws, values: Mapping[str, Tensor]
) -> tuple[Ball, Ball, Tensor]:
    """Both balls after the impact, and the upward velocity of the one that came [m/s].

    Friction between the balls acts against the slip of their surfaces, sideways and up or down; it
    presses the struck ball onto the table, whose own friction acts at once.

    Args:
        resting, coming: States of the resting and of the coming ball at the impact.
        laws: Parameters of the motion on the ground.
        values: "restitution", "ball_friction", "mass_ratio" (struck over coming), "sidespin"
            [m/s].
    """
    normal = resting.place - coming.place
    normal = normal / _compute_length(normal)[..., None]
    across = torch.stack([-normal[..., 1], normal[..., 0]], -1)
    relative = coming.velocity - resting.velocity
    mass = values["mass_ratio"]
    share = 1.0 / (1.0 + 1.0 / mass)  # reduced mass over that of the coming ball
    blow = (1.0 + values["restitution"]) * dot(relative, normal) * share
    sideways = dot(relative, across) + values["sidespin"]
    upwards = -dot(coming.rolling + resting.rolling, normal)
    surface = torch.sqrt(sideways**2 + upwards**2 + _TINY**2)
    sticking = surface * share / (1.0 + 1.0 / laws.inertia)
    rubbing = _smooth_minimum(values["ball_friction"] * blow, sticking) / surface
    along, lift = -rubbing * sideways, -rubbing * upwards
    push = blow[..., None] * normal - along[..., None] * across
    spun = (lift / laws.inertia)[..., None] * normal
    came = Ball(coming.place, coming.velocity - push, coming.rolling - spun)
    struck = Ball(
        resting.place,
        resting.velocity + push / mass[..., None],
        resting.rolling - spun / mass[..., None],
    )
    return _rub_on_table(struck, lift.clamp(min=0.0) / mass, laws), came, lift.clamp(min=0.0)


def _rub_on_table(ball: Ball, blow: Tensor, laws: Laws) -> Ball:
    """Friction of a blow onto the table (over the mass, m/s); it cannot reverse the slip."""
    slip = ball.velocity - ball.rolling
    size = _compute_length(slip)
    rub = _smooth_minimum(laws.table_friction * blow, size / (1.0 + 1.0 / laws.inertia))
    step = (rub / size)[..., None] * slip
    return Ball(ball.place, ball.velocity - step, ball.rolling + step / laws.inertia[..., None])


def _advance(ball: Ball, time: Tensor, acceleration: Tensor) -> Ball:
    t = time[..., None]
    return Ball(
        ball.place + t * ball.velocity + 0.5 * t**2 * acceleration,
        ball.velocity + t * acceleration,
        ball.rolling,
    )


def _compute_deceleration(ball: Ball, laws: Laws) -> Tensor:
    """Deceleration by rolling resistance and air, none at rest."""
    speed = torch.sqrt((ball.velocity**2).sum(-1) + 1e-6)
    drag = laws.rolling_resistance * laws.gravity / speed + laws.air_drag * speed
    return -drag[..., None] * ball.velocity


def _smooth_minimum(a: Tensor, b: Tensor) -> Tensor:
    """The smaller of two forces, without a kink: 16 % less where they are equal."""
    return a / (1.0 + (a / b.clamp(min=_TINY)) ** 4) ** 0.25


def _compute_length(vector: Tensor) -> Tensor:
    return torch.sqrt((vector**2).sum(-1) + _TINY**2)
