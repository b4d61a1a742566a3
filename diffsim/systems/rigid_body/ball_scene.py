"""Balls in one run as channels: their motion, what a camera sees, what a tracker makes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import delays_of
from diffsim.causes.scene import Scene
from diffsim.systems.rigid_body import on_ground
from diffsim.systems.rigid_body.bouncing import Bounces, ThrownBall, bounced
from diffsim.systems.rigid_body.camera import projected
from diffsim.systems.rigid_body.on_ground import Ball, Laws

MERGE_LENGTH = 0.004  # [m] gap over which two regions stop touching


@dataclass(frozen=True)
class BallBody:
    """One ball as the scene knows it; keys are names of the scene's values."""

    name: str  # name of the ball, before its place and velocity in the values: "coming_vx"
    begins: str  # "flying", "on_ground" or "at_rest"
    diameter: str
    # restitution, friction: keys of its contact with the ground; None: it flies for ever
    restitution: str | None
    friction: str | None
    inertia: float  # I / (m r^2) [-]


@dataclass(frozen=True)
class Pair:
    """Two balls that meet once, on the ground."""

    bodies: tuple[int, int]  # indices of the ball that is struck and of the one that comes
    # restitution, friction: keys of their contact
    restitution: str
    friction: str
    mass_ratio: float  # mass of the struck ball over that of the other [-]


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """The camera, but for what is fitted of it."""

    rotation: Tensor  # (3, 3) before its small turn
    height_px: float  # height of the picture
    plain: Mapping[str, Tensor]  # its numbers without distortion
    # (T, 3) places of clicked points [m] where the run holds them, else None
    corners: Tensor | None = None


@dataclass(frozen=True, eq=False)
class BallStage:
    """What all runs of a study have in common."""

    bodies: Sequence[BallBody]
    pair: Pair | None  # two of them that meet; None: none do
    # kind of measure, ball and component of each channel; "click" for clicked points
    rows: Sequence[tuple[str, int, int]]
    frame: Tensor  # (3, 3) from the world, z up, to the recorded frame
    eye: PinholeCamera | None  # camera; None: no channel is in pixels


@dataclass(frozen=True, eq=False)
class BallPaths:
    """Centers of all balls over time: places and velocities (K, T, 3) by ball [m, m/s]."""

    places: Sequence[Tensor]
    velocities: Sequence[Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class BallScene(Scene):
    """One run of the balls, or the points clicked in the camera's picture.

    Its numbers are quantities, start of the balls, camera, and what causes add to.
    """

    stage: BallStage  # what all runs have in common

    def simulate(self) -> Tensor:
        """(..., T, num_channels)."""
        wide = self.wide()
        out = wide._show_channels(None)
        for channels, delay in delays_of(self.instruments.clocks).items():
            places = torch.tensor(channels)
            out = out.index_copy(-1, places, wide._show_channels(delay)[..., places])
        return self.instruments.read(out if self._lead else out[0], self.grid)

    def wide(self) -> BallScene:
        """A copy whose values have one axis, (K,) each."""
        lead = self._lead or (1,)
        return replace(self, numbers={n: v.expand(lead) for n, v in self.numbers.items()})

    @property
    def _lead(self) -> tuple[int, ...]:
        """Axis of points of values and clocks; () where they are at one point."""
        sizes = (*self.numbers.values(), *(delay for _, delay in self.instruments.clocks))
        return np.broadcast_shapes(*(size.shape for size in sizes))

    def _show_channels(self, late: Tensor | None) -> Tensor:
        """(K, T, num_channels) as they are ``late`` (K,) or () [s] before."""
        time = self.grid.times * (1.0 + self._get_value("clock_scale"))
        if late is not None:
            time = time - late[..., None]
        shown = self._show_clicks(time)
        paths = self.paths(time)
        scale = 1.0 + self._get_value("length_scale")[..., None]
        for kind, b, _ in self.stage.rows:
            if (kind, b) in shown or b >= len(paths.places):
                continue
            if kind == "pixels":
                shown[kind, b] = self._show_pixels(time, paths, b)
            else:
                path = paths.places if kind == "position" else paths.velocities
                shown[kind, b] = scale * (path[b] @ self.stage.frame.mT)
        zero = torch.zeros_like(time)
        rows = [shown[k, b][..., i] if (k, b) in shown else zero for k, b, i in self.stage.rows]
        return torch.stack(rows, -1)

    def _show_clicks(self, time: Tensor) -> dict[tuple[str, int], Tensor]:
        """Pixels of the points that the run holds, (K, T, 2)."""
        eye = self.stage.eye
        if eye is None or eye.corners is None:
            return {}
        corners = eye.corners.expand(len(time), -1, 3)
        return {("click", 0): projected(self.numbers, eye.rotation, corners)}

    def _show_pixels(self, time: Tensor, paths: BallPaths, b: int) -> Tensor:
        """(K, T, 2) of one ball; each row of the picture is read a little later."""
        assert self.stage.eye is not None
        first = self._project_centers(paths)[b]
        if not bool((self.numbers["readout"] != 0.0).any()) and not self._needs_grad("readout"):
            return first
        # one fixed-point step is ample
        late = self._get_value("readout") * first[..., 1] / self.stage.eye.height_px
        return self._project_centers(self.paths(time + late))[b]

    def _needs_grad(self, name: str) -> bool:
        return self.numbers[name].requires_grad

    def _project_centers(self, paths: BallPaths) -> list[Tensor]:
        """(K, T, 2) pixels of the centers as tracked."""
        eye, pair = self.stage.eye, self.stage.pair
        assert eye is not None
        pixels = [projected(self.numbers, eye.rotation, p) for p in paths.places]
        pulls = [torch.zeros_like(p) for p in pixels]
        if pair is not None:
            i, j = pair.bodies
            towards = (paths.places[j] - paths.places[i])[..., :2]
            gap = torch.sqrt((towards**2).sum(-1)) - self._compute_reach(pair)
            touching = self._get_value("merge") * torch.exp(-((gap / MERGE_LENGTH) ** 2))
            apart = pixels[j] - pixels[i]
            pull = touching[..., None] * apart / torch.sqrt((apart**2).sum(-1, keepdim=True))
            pulls[i], pulls[j] = pull, -pull
        lit = torch.stack([self._get_value("lit_u"), self._get_value("lit_v")], -1)
        out = []
        for body, place, center, pull in zip(
            self.stage.bodies, paths.places, pixels, pulls, strict=True
        ):
            radius = 0.5 * self._get_value(body.diameter)
            along = place[..., :2] @ eye.rotation[2, :2] + radius * eye.rotation[2, 2]
            depth = (along + self._get_value("shift_z")).abs()
            size = self._get_value("focal") * radius / depth
            out.append(center + pull + size[..., None] * lit)
        return out

    def paths(self, time: Tensor) -> BallPaths:
        """Centers of all balls at times (K, T) [s]."""
        pair = self.stage.pair
        met = {} if pair is None else self._meet_pair(pair, time)
        both = [
            met[b] if b in met else self._move_alone(body, time)
            for b, body in enumerate(self.stage.bodies)
        ]
        return BallPaths([p for p, _ in both], [v for _, v in both])

    def _move_alone(self, body: BallBody, time: Tensor) -> tuple[Tensor, Tensor]:
        v = self.numbers
        laws = self._make_laws(body)
        level = 0.5 * v[body.diameter] + v["ground"] + v["ground_height"]
        lands = body.restitution is not None
        ball = self._make_start(body)
        if body.begins != "flying":
            return self._roll_ball(ball, laws, level, time)
        up = torch.stack([v[f"{body.name}_z"], v[f"{body.name}_vz"]], -1)
        ground = Bounces(
            laws,
            v["lift"],
            level,
            v[body.restitution] if body.restitution else torch.zeros_like(level),
            v["restitution_slope"],
            v["rebound"],
            lands,
        )
        thrown = ThrownBall(
            torch.cat([ball.place, up[:, :1]], -1),
            torch.cat([ball.velocity, up[:, 1:]], -1),
            ball.rolling,
        )
        return bounced(thrown, time, ground)

    def _meet_pair(self, pair: Pair, time: Tensor) -> dict[int, tuple[Tensor, Tensor]]:
        """Two balls on the ground before and after their one impact."""
        v = self.numbers
        bodies = [self.stage.bodies[b] for b in pair.bodies]
        laws = [self._make_laws(body) for body in bodies]
        resting, coming = (self._make_start(body) for body in bodies)
        start = on_ground.time_of_impact(resting, coming, self._compute_reach(pair)[:, 0], laws[0])
        law = {
            "restitution": v[pair.restitution],
            "ball_friction": v[pair.friction] + v["ball_friction"],
            "mass_ratio": pair.mass_ratio + v["mass_ratio"],
            "sidespin": v["sidespin"],
        }
        struck, came, lift = on_ground.impact(
            on_ground.moved(resting, start, laws[0]),
            on_ground.moved(coming, start, laws[1]),
            laws[0],
            law,
        )
        since = (time - start[:, None]).clamp(min=0.0)
        # a blow of constant force: first half of it with the old velocity, then with the new one
        after = _ease_time(since, self._get_value("contact_time"))
        before = torch.minimum(time, start[:, None].expand_as(time)) + since - after
        is_after = (since > 0.0)[..., None]
        up = (lift + v["hop"])[:, None]
        height = (up * after - 0.5 * v["gravity"][:, None] * after**2).clamp(min=0.0)
        out = {}
        for b, body, law_of, first, later, rise in zip(
            pair.bodies,
            bodies,
            laws,
            (resting, coming),
            (struck, came),
            (torch.zeros_like(height), height),
            strict=True,
        ):
            level = 0.5 * v[body.diameter] + v["ground"] + v["ground_height"]
            one, speed = self._roll_ball(later, law_of, level, after)
            two, slower = self._roll_ball(first, law_of, level, before)
            met = torch.cat([later.place, level[:, None]], -1)[:, None]
            place = torch.where(is_after, one + two - met, two)
            lifted = torch.zeros_like(place)
            lifted[..., 2] = rise
            out[b] = (place + lifted, torch.where(is_after, speed, slower))
        return out

    def _roll_ball(
        self, ball: Ball, laws: Laws, level: Tensor, time: Tensor
    ) -> tuple[Tensor, Tensor]:
        wide = Ball(*(y[:, None] for y in (ball.place, ball.velocity, ball.rolling)))
        law = Laws(*(getattr(laws, n)[:, None] for n in Laws.__dataclass_fields__))
        end = on_ground.moved(wide, time, law)
        height = level[:, None, None].expand_as(end.place[..., :1])
        return (
            torch.cat([end.place, height], -1),
            torch.cat([end.velocity, torch.zeros_like(height)], -1),
        )

    def _make_start(self, body: BallBody) -> Ball:
        v, n = self.numbers, body.name
        place = torch.stack([v[f"{n}_x"], v[f"{n}_y"]], -1)
        if body.begins == "at_rest":
            return Ball(place, torch.zeros_like(place), torch.zeros_like(place))
        velocity = torch.stack([v[f"{n}_vx"], v[f"{n}_vy"]], -1)
        return Ball(place, velocity, torch.stack([v[f"{n}_roll_x"], v[f"{n}_roll_y"]], -1))

    def _make_laws(self, body: BallBody) -> Laws:
        v = self.numbers
        friction = v["table_friction"] + (v[body.friction] if body.friction else 0.0)
        return Laws(
            friction,
            v["rolling_resistance"],
            torch.stack([v["tilt_x"], v["tilt_y"]], -1),
            v["air_drag"],
            body.inertia + v["inertia"],
            v["gravity"],
        )

    def _compute_reach(self, pair: Pair) -> Tensor:
        """Distance of the centers at the impact, (K, 1) [m]."""
        both = [self._get_value(self.stage.bodies[b].diameter) for b in pair.bodies]
        return 0.5 * (both[0] + both[1])

    def _get_value(self, name: str) -> Tensor:
        return self.numbers[name][:, None]


def _ease_time(since: Tensor, duration: Tensor) -> Tensor:
    """Time that counts as after a blow which takes its time: the integral of a ramp (K, T) [s]."""
    length = duration.clamp(min=1e-9)
    return torch.where(since > length, since - 0.5 * length, since**2 / (2.0 * length))
