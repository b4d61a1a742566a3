"""The video of two balls as channels in pixels: balls, camera, and what the tracker makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.balls import rigid
from diffsim.systems.balls.camera import HEIGHT_PX, projected
from diffsim.systems.balls.rigid import Ball, Laws

#: What effects change, with its value in the plain model.
PLAIN = {
    "table_friction": 0.0,
    "rolling_resistance": 0.0,
    "tilt_x": 0.0,
    "tilt_y": 0.0,
    "air_drag": 0.0,
    "inertia": 0.52,  # shell of rubber and felt, 25 to 33 mm
    "ball_friction": 0.0,
    "mass_ratio": 1.0,
    "hop": 0.0,
    "radial": 0.0,
    "center_u": 0.0,
    "center_v": 0.0,
    "clock": 0.0,
    "readout": 0.0,
    "merge": 0.0,
    "lit_u": 0.0,
    "lit_v": 0.0,
}
MERGE_LENGTH = 0.004  # [m] gap over which two regions stop touching


@dataclass(frozen=True, eq=False)
class BallScene:
    """A part of the video, and the corners clicked in it.

    Attributes:
        values: Base parameters and ``PLAIN``, (...,) each.
        time: Times of the samples, (T,) [s].
        rotation: (3, 3) of the camera before its small turn.
        corners: (T, 3) places of the clicked corners [m], one per sample.
    """

    values: Mapping[str, Tensor]
    time: Tensor
    rotation: Tensor
    corners: Tensor

    def with_added(self, name: str, size: Tensor) -> BallScene:
        """A copy with one number larger by ``size`` (...,)."""
        return replace(self, values={**self.values, name: self.values[name] + size})

    def simulate(self) -> Tensor:
        """(..., T, 6): u, v of the resting ball, of the coming one, and of the corner [px]."""
        time = (self.time * (1.0 + self.values["clock"][..., None])).expand(*self._batch, -1)
        pixels, _ = self._seen(time)
        late = self.values["readout"][..., None]
        # each row of the picture is read a little later: one fixed-point step is ample
        rows = [pixels[..., v] / HEIGHT_PX for v in (1, 3)]
        first, _ = self._seen(time + late * rows[0])
        second, _ = self._seen(time + late * rows[1])
        both = torch.cat([first[..., :2], second[..., 2:]], -1)
        clicks = self._projected(self.corners.expand(*self._batch, -1, 3))
        return torch.cat([both, clicks], -1)

    @property
    def _batch(self) -> tuple[int, ...]:
        return tuple(self.values["focal"].shape)

    def _seen(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """(..., T, 4) pixels of the centers as tracked."""
        resting, coming, height = self._motion(time)
        radius = 0.5 * self._of("diameter")
        pixels, towards = [], coming - resting
        gap = torch.sqrt((towards**2).sum(-1)) - 2.0 * radius
        touching = self._of("merge") * torch.exp(-((gap / MERGE_LENGTH) ** 2))
        for place, up in ((resting, torch.zeros_like(height)), (coming, height)):
            z = (radius + up)[..., None]
            pixels.append(self._projected(torch.cat([place, z.expand_as(place[..., :1])], -1)))
        apart = pixels[1] - pixels[0]
        pull = touching[..., None] * apart / torch.sqrt((apart**2).sum(-1, keepdim=True))
        lit = torch.stack([self._of("lit_u"), self._of("lit_v")], -1)
        out = []
        for place, sign in ((resting, 1.0), (coming, -1.0)):
            center = pixels[0 if sign > 0 else 1]
            size = self._of("focal") * radius / self._depth(place, radius)
            out.append(center + sign * pull + size[..., None] * lit)
        return torch.cat(out, -1), gap

    def _motion(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Places (..., T, 2) of both balls, height of the coming one above the table (..., T)."""
        laws, late_laws = self._laws(), self._laws(over_time=True)
        still = torch.zeros_like(self._vector("x0", "y0"))
        resting = Ball(self._vector("x0", "y0"), still, still)
        coming = Ball(
            self._vector("x1", "y1"), self._vector("vx1", "vy1"), self._vector("wx1", "wy1")
        )
        start = rigid.time_of_impact(resting, coming, self.values["diameter"], laws)
        struck, came, lift = rigid.impact(
            rigid.moved(resting, start, laws), rigid.moved(coming, start, laws), laws, self.values
        )
        after = (time - start[..., None]).clamp(min=0.0)
        before = torch.minimum(time, start[..., None].expand_as(time))
        is_after = (time > start[..., None])[..., None]
        places = [
            torch.where(
                is_after,
                rigid.moved(_over_time(later), after, late_laws).place,
                rigid.moved(_over_time(first), before, late_laws).place,
            )
            for first, later in ((resting, struck), (coming, came))
        ]
        up = (lift + self.values["hop"])[..., None]
        height = (up * after - 0.5 * rigid.GRAVITY * after**2).clamp(min=0.0)
        return places[0], places[1], height

    def _laws(self, *, over_time: bool = False) -> Laws:
        get = self._of if over_time else self.values.__getitem__
        return Laws(
            get("table_friction"),
            get("rolling_resistance"),
            torch.stack([get("tilt_x"), get("tilt_y")], -1),
            get("air_drag"),
            get("inertia"),
        )

    def _projected(self, place: Tensor) -> Tensor:
        """(..., T, 2) pixels of places (..., T, 3) [m]."""
        return projected(self.values, self.rotation, place)

    def _depth(self, place: Tensor, radius: Tensor) -> Tensor:
        """(..., T) distance along the optical axis, the small turn left out."""
        full = torch.cat([place, radius[..., None].expand_as(place[..., :1])], -1)
        along = full @ self.rotation[2] + self._of("shift_z")
        return along.abs()

    def _of(self, name: str) -> Tensor:
        return self.values[name][..., None]

    def _vector(self, x: str, y: str) -> Tensor:
        return torch.stack([self.values[x], self.values[y]], -1)


def ball_scene(values: Mapping[str, Tensor], run: Run, rotation: np.ndarray) -> BallScene:
    """The scene of a run, with the corners' places in its command."""
    shape = values["focal"].shape
    plain = {n: torch.full(shape, v, dtype=torch.float64) for n, v in PLAIN.items()}
    corners = np.column_stack([run.command[f"corner_{a}_m"] for a in "xyz"])
    time = torch.from_numpy(np.asarray(run.time_s, dtype=np.float64))
    return BallScene(
        {**plain, **values}, time, torch.from_numpy(rotation), torch.from_numpy(corners)
    )


def _over_time(ball: Ball) -> Ball:
    return Ball(*(v[..., None, :] for v in (ball.place, ball.velocity, ball.rolling)))
