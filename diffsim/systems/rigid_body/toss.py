"""Tossed bodies: flight, impact of the first corner, flight; and the height at which they rest.

Plain: gravity, Coulomb friction, restitution, level ground. A body whose moments of inertia are
equal turns about a fixed axis in flight, others by Euler's equations.

The impact is one impulse. With K = 1/m - [r] I^-1 [r] (the corner's change of velocity per impulse,
times m here), the impulse p leaves the corner at the normal velocity -e v_n, and sticks if it may:
p lies in the friction cone |p_t| <= mu p_n. Else it lies on the cone, along the tangential impulse
that sticking would take (Newton's restitution with Coulomb's cone; that projection stands for the
slip during the impact).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.listing import numbers_added
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_product,
    rotate_by_quaternion,
    skew,
)
from diffsim.data.study import Run
from diffsim.systems.rigid_body.layout import PoseLayout, TossMotion
from diffsim.systems.rigid_body.windows import CORNERS, TURN, TWIST

SHORTEST = 1e-9  # [s] of a contact: instant
TOSS = "toss"  # the kind of system, and its table
REFERENCE_SPEED = 1.0  # [m/s] where the slopes of restitution and friction do nothing


@cache
def added() -> tuple[str, ...]:
    """Numbers that causes alone change; all are 0 in the plain model."""
    return numbers_added(TOSS, {})


@dataclass(frozen=True, eq=False)
class Mass:
    """What is known of the body's mass beside the edges of a box."""

    # moments of inertia per mass, (3,) [m^2]; None: those of a box of even density
    inertia: tuple[float, float, float] | None = None
    is_even: bool = True  # whether the three moments are equal
    has_corners: bool = True  # whether it is a box, which may touch the ground


@dataclass(frozen=True, eq=False)
class Tosses:
    """Several tosses side by side, padded to the longest."""

    time_s: Tensor  # (num_tosses, length) from 0; padded by its last frame
    corner: Tensor  # (num_tosses, 3) the one that hits first, entries 1 or -1
    touch_s: Tensor  # (num_tosses, 1) when it is near the ground
    turn: Tensor  # (num_tosses, 4) first quaternion, scalar part first
    hits: Tensor  # (num_tosses, 1) 1 where the record goes on through the impact, else 0
    face: Tensor  # (num_tosses, 3) 1 for the axis of the body that is upright at rest, else 0
    measured: Tensor  # (num_tosses, length, num_channels), NaN in the padding
    start: Tensor  # (num_tosses, 12) first guess: position, turn, velocity, body rates

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Tosses:
        """From recordings with what ``windows`` found of them in their ``setup``."""
        length = max(len(r.time_s) for r in runs)
        times, poses = [], []
        for run in runs:
            more = length - len(run.time_s)
            times.append(np.pad(run.time_s - run.time_s[0], (0, more), mode="edge"))
            poses.append(np.pad(run.measured, ((0, more), (0, 0)), constant_values=np.nan))
        turn = torch.tensor([[r.setup[f"_start_{c}"] for c in TURN] for r in runs]).double()
        first = torch.tensor([[r.setup[f"_start_{c}"] for c in TWIST] for r in runs]).double()
        return cls(
            torch.from_numpy(np.stack(times)),
            torch.from_numpy(CORNERS[[int(r.setup["_corner"]) for r in runs]]),
            torch.tensor([[r.setup["_touch_s"] - r.time_s[0]] for r in runs]).double(),
            turn / turn.norm(dim=-1, keepdim=True),
            torch.tensor([[r.setup["_hits"]] for r in runs]).double(),
            torch.eye(3).double()[[int(r.setup.get("_face", 2)) for r in runs]],
            torch.from_numpy(np.stack(poses)),
            torch.cat([first[:, :3], torch.zeros_like(first[:, :3]), first[:, 3:]], -1),
        )

    def only(self, index: int) -> Tosses:
        """A copy with one of the tosses."""
        return Tosses(*(getattr(self, f.name)[index : index + 1] for f in fields(self)))

    def fly(
        self,
        start: Tensor,
        values: Mapping[str, Tensor],
        terms: Mapping[str, Tensor],
        mass: Mass,
        layout: PoseLayout,
        late: Tensor | None = None,
    ) -> Tensor:
        """Channels of all tosses, (K, num_tosses, length, num_channels).

        Args:
            start: Start states of K points, (K, num_tosses, 12).
            values: restitution, friction, gravity [m/s^2], ground [m] and edge (or edge_x,
                edge_y, edge_z) [m], (K,) or ().
            terms: What is added to the numbers ``added()``, (K,) or ().
            mass: What is known of the body's mass.
            layout: What the channels show.
            late: How late all channels are, (K,) or () [s]; None: not at all.
        """
        k = len(start)
        get = {name: _expand_term(terms, name, k) for name in added()}
        tilt = _stack_axes(get, "gravity_x", "gravity_y", "lift")
        slope = _stack_axes(get, "ground_slope_x", "ground_slope_y")
        center = _stack_axes(get, "center_x", "center_y", "center_z")
        value = {n: v.expand(k)[:, None] for n, v in values.items()}  # (K, 1)
        stretch = 1.0 + get["clock_scale"]
        time = self.time_s * stretch  # (K, R, n)
        x0, turn, v0, rates = start.split(3, -1)
        q0 = quaternion_product(self.turn, quaternion_from_rotation_vector(turn))
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        gravity = tilt + value["gravity"][..., None] * down
        middle = v0 + 0.5 * gravity * time[..., -1:]
        drag = get["drag"] + get["quadratic_drag"] * middle.norm(dim=-1, keepdim=True)
        if late is not None:
            time = time - late.expand(k)[:, None, None]
        spin = get["spin_drag"]
        bigger = 1.0 + get["half_width"]
        edges = [value["edge" if "edge" in value else f"edge_{a}"] for a in "xyz"]
        half = 0.5 * torch.stack(edges, -1)  # (K, 1, 3)
        moments = _make_moments(mass, half, _stack_axes(get, "inertia_x", "inertia_y"))
        even = None if mass.is_even and not {"inertia_x", "inertia_y"} & {*terms} else moments
        per_mass = moments * (1.0 + get["inertia"])
        ground = value["ground"][..., None] + get["ground_height"]

        hit = self.touch_s * stretch
        kick = torch.zeros_like(x0)
        twist = torch.zeros_like(x0)
        if mass.has_corners and bool((self.hits > 0.0).any()):
            arm_body = self.corner * half * bigger - center

            def at(t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
                """Gap of the corner, its velocity, its arm, and the turn at times (K, R, 1)."""
                x, v = _fly_ballistic(x0, v0, gravity, drag, t)
                step, now = turned(rates, _integrate_slowing(t, spin)[..., 0], even)
                q = quaternion_product(q0, step)
                arm = rotate_by_quaternion(q, arm_body)
                rate = rotate_by_quaternion(q, now * (1.0 - spin * t))
                place, speed = x + arm, v + torch.linalg.cross(rate, arm)
                level = ground + (place[..., :2] * slope).sum(-1, True)
                return place[..., 2:] - level, speed, arm, q

            for _ in range(6):
                gap, speed, _, _ = at(hit)
                hit = hit - gap / speed[..., 2:].clamp(max=-0.1)
            _, speed, arm, q_hit = at(hit)
            e, mu = value["restitution"], value["friction"]
            e = e * torch.exp(get["restitution_slope"][..., 0] * (-speed[..., 2] - REFERENCE_SPEED))
            slip = speed[..., :2].square().sum(-1).clamp(min=1e-12).sqrt()
            mu = mu * torch.exp(get["friction_slope"][..., 0] * (slip - REFERENCE_SPEED))
            turn_hit = matrix_from_quaternion(q_hit)
            inverse = (turn_hit / per_mass[..., None, :]) @ turn_hit.mT
            kick = impulse(speed, arm, inverse, e, mu, get["rebound"][..., 0])
            spun = (inverse @ torch.linalg.cross(arm, kick)[..., None])[..., 0]
            twist = rotate_by_quaternion(quaternion_conjugate(q_hit), spun)

        since = _integrate_ramp(time - hit, get["contact_time"], get["smoothing"]) * self.hits
        since = since[..., None]
        near, fast, pull, slow = (y[..., None, :] for y in (x0, v0, gravity, drag))
        x, v = _fly_ballistic(near, fast, pull, slow, time[..., None])
        x = x + kick[..., None, :] * since
        is_after = since > 0.0
        v = torch.where(is_after, v + kick[..., None, :], v)
        # the body turns freely before and after the impact
        whole, before = _integrate_slowing(time, spin), _integrate_slowing(hit, spin)
        wide = None if even is None else even[..., None, :]
        until = torch.where(is_after[..., 0], before, whole)
        step, rate_hit = turned(rates[..., None, :], until, wide)
        gone = torch.where(is_after[..., 0], whole - before, 0.0)[..., None]
        kicked = torch.where(is_after, twist[..., None, :] * since, 0.0)
        if wide is None:
            rest = quaternion_from_rotation_vector(rate_hit * gone + kicked)
            now = rate_hit + torch.where(is_after, twist[..., None, :], 0.0)
        else:  # the mean rate since the impact, where a contact takes its time
            share = torch.where(gone.abs() < SHORTEST, SHORTEST, gone)
            rest, now = turned(rate_hit + kicked / share, gone[..., 0], wide)
        q = quaternion_product(quaternion_product(q0[..., None, :], step), rest)
        # at rest on a face, wherever that is: the slope of the ground is left out
        upright = (half * self.face).sum(-1, keepdim=True)
        rest_height = upright * bigger + ground
        x = x + rotate_by_quaternion(q, center[..., None, :])
        scale = 1.0 + get["length_scale"][..., None]
        flown = TossMotion(
            scale * x,
            q,
            scale * v,
            now * (1.0 - spin * time)[..., None],
            (scale * rest_height[..., None]).expand_as(q[..., :1]),
        )
        return layout.channels(flown, self.measured)


def _make_moments(mass: Mass, half: Tensor, unequal: Tensor) -> Tensor:
    """Moments of inertia per mass, (K, 1, 3) [m^2]."""
    if mass.inertia is not None:
        moments = torch.tensor(mass.inertia, dtype=torch.float64).expand_as(half)
    else:
        square = half**2
        moments = (square.sum(-1, keepdim=True) - square) / 3.0
    return moments * (1.0 + torch.cat([unequal, torch.zeros_like(unequal[..., :1])], -1))


def _expand_term(terms: Mapping[str, Tensor], name: str, k: int) -> Tensor:
    """(K, 1, 1) of a number, zero where no effect has changed it."""
    return terms.get(name, torch.zeros((), dtype=torch.float64)).expand(k)[:, None, None]


def _stack_axes(numbers: Mapping[str, Tensor], *names: str) -> Tensor:
    """(K, 1, n) of numbers that are parts of a vector."""
    return torch.cat([numbers[name] for name in names], -1)


def _fly_ballistic(
    x: Tensor, v: Tensor, gravity: Tensor, drag: Tensor, t: Tensor
) -> tuple[Tensor, Tensor]:
    """Place and velocity under gravity and v' = g - drag v, to first order in drag t."""
    place = x + v * (t - drag * t**2 / 2.0) + gravity * (t**2 / 2.0 - drag * t**3 / 6.0)
    return place, v * (1.0 - drag * t) + gravity * (t - drag * t**2 / 2.0)


def _integrate_slowing(t: Tensor, drag: Tensor) -> Tensor:
    """Integral of 1 - drag t."""
    return t - drag * t**2 / 2.0


def _integrate_ramp(since: Tensor, contact: Tensor, width: Tensor) -> Tensor:
    """Time since the impact that counts: integral of a step, of a ramp over ``contact`` after it,
    or of one over ``width`` about it (then the camera's smoothing, not the contact)."""
    length = (contact + width).clamp(min=SHORTEST)
    s = since + width / 2.0
    inside = s.clamp(min=0.0) ** 2 / (2.0 * length)
    return torch.where(s > length, s - length / 2.0, inside)


STEPS = 24  # over a whole flight: about a tenth of a turn each, an error of 1e-6 rad at 10 rad/s


def turned(rates: Tensor, span: Tensor, inertia: Tensor | None) -> tuple[Tensor, Tensor]:
    """Turn during ``span`` without a torque, as a quaternion, and the body rates at its end.

    Euler's equations I w' = I w x w by Runge and Kutta; the turn by Magnus' series of fourth order
    (Iserles and Norsett, 1999) for body rates.

    Args:
        rates: Body rates at first, (..., 3) [rad/s].
        span: Time, (...) [s].
        inertia: Moments of inertia about the body's axes, up to a common factor, (..., 3); None:
            all equal, in closed form.

    Returns:
        (..., 4) and (..., 3).
    """
    if inertia is None:
        return quaternion_from_rotation_vector(rates * span[..., None]), rates

    def slope(w: Tensor) -> Tensor:
        return torch.linalg.cross(inertia * w, w) / inertia

    h = span[..., None] / STEPS
    now = torch.broadcast_tensors(rates, h)[0]
    passed, slopes = [now], [slope(now)]
    for _ in range(STEPS):
        first = slopes[-1]
        second = slope(now + 0.5 * h * first)
        third = slope(now + 0.5 * h * second)
        fourth = slope(now + h * third)
        now = now + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        passed.append(now)
        slopes.append(slope(now))
    return _turn_along(torch.stack(passed), torch.stack(slopes), h), now


def _turn_along(rates: Tensor, slopes: Tensor, h: Tensor) -> Tensor:
    """Turn (..., 4) over steps ``h`` between body rates and their slopes, (STEPS + 1, ..., 3)."""
    now, then = rates[:-1], rates[1:]
    middle = 0.5 * (now + then) + h / 8.0 * (slopes[:-1] - slopes[1:])
    mean = h / 6.0 * (now + 4.0 * middle + then)
    q = quaternion_from_rotation_vector(mean + h**2 / 12.0 * torch.linalg.cross(now, then))
    while len(q) > 1:  # neighbors together: one after another takes five times as many operations
        pairs = quaternion_product(q[:-1:2], q[1::2])
        q = torch.cat([pairs, q[-1:]]) if len(q) % 2 else pairs
    return q[0]


def impulse(
    velocity: Tensor,
    arm: Tensor,
    inverse_inertia: Tensor,
    restitution: Tensor,
    friction: Tensor,
    rebound: Tensor,
) -> Tensor:
    """Impulse per mass on the corner, (..., 3) [m/s]; the plane's normal is z.

    Args:
        velocity: Velocity of the corner before the impact, (..., 3) [m/s].
        arm: Vector from the center of mass to the corner, (..., 3) [m].
        inverse_inertia: Inverse of the moment of inertia per mass, in the frame of the plane,
            (..., 3, 3) [1/m^2].
        restitution: Restitution coefficient e, (...) [-].
        friction: Friction coefficient mu, (...) [-].
        rebound: Tangential restitution of a sticking corner, (...): 0 stops it.
    """
    eye = torch.eye(3, dtype=arm.dtype)
    cross = skew(arm)
    compliance = eye - cross @ inverse_inertia @ cross
    rebound, restitution = torch.broadcast_tensors(rebound, restitution)
    wanted = -velocity * torch.stack([1.0 + rebound, 1.0 + rebound, 1.0 + restitution], -1)
    stick = torch.linalg.solve(compliance, wanted[..., None])[..., 0]
    tangential = stick[..., :2]
    length = (tangential * tangential).sum(-1).clamp(min=1e-18).sqrt()
    along = tangential / length[..., None]
    cone = torch.cat([friction[..., None] * along, torch.ones_like(along[..., :1])], -1)
    slide = wanted[..., 2] / (compliance[..., 2, :] * cone).sum(-1)
    sticks = length <= friction * stick[..., 2]
    return torch.where(sticks[..., None], stick, slide[..., None] * cone)
