"""The same two balls as soft bodies: thesis 4.1.6, "A Real-to-Sim Experiment".

Each ball is an icosphere of 320 facets joined to its center by 320 tetrahedra (489 degrees of
freedom, Table 4.2). The table is exact complementarity contact with Coulomb friction; the balls
push and rub each other through their centers (:func:`diffsim.contact.ball_force`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.data.study import Run
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.rigid_body.camera import HEIGHT_PX, WIDTH_PX, plain_camera, projected

#: What the motion depends on; the other parameters are the camera's.
MOTION = (
    *("x0", "y0", "x1", "y1", "vx1", "vy1", "wx1", "wy1"),
    *("pair_stiffness", "ball_friction", "table_friction", "youngs_modulus"),
)


class SoftBalls:
    """Two equal balls on a table, prepared for many simulations.

    Args:
        radius: Radius of both balls [m].
        mass: Mass of one ball [kg].
        steps: Per frame; 3 at 60 frames per second is the thesis's 5.6 ms.
        subdivisions: Subdivisions of the icosahedron: 2 gives 320 tetrahedra, 3 gives 1280.
        frame_s: Time between two frames of the video [s].
    """

    def __init__(
        self,
        radius: float,
        mass: float,
        *,
        steps: int = 3,
        subdivisions: int = 2,
        frame_s: float = 1.0 / 60.0,
    ):
        self.radius, self.steps, self.frame_s = radius, steps, frame_s
        self.ball = ball_mesh(radius, subdivisions)
        n = self.ball.num_nodes
        apart = torch.tensor([4.0 * radius, 0.0, 0.0], dtype=torch.float64)
        both = mesh.TetMesh(
            torch.cat([self.ball.x_rest, self.ball.x_rest + apart]),
            torch.cat([self.ball.elements, self.ball.elements + n]),
        )
        self.nodes = torch.arange(2 * n).reshape(2, n)
        volume = float(mesh.nodal_volume(self.ball).sum())
        self.body = soft.SoftBody(
            both,
            dt=frame_s / steps,
            youngs_modulus=1e6,
            poissons_ratio=0.3,
            density=mass / volume,
            solver=soft.SolverOptions(method="newton_cholesky"),  # quickest at this size
        )
        # tetrahedra from the facets to the center leave three quarters of the mass on the surface:
        # I / (m r^2) = 0.5, near a tennis ball's 0.52
        self.lowest = float(self.ball.x_rest[:, 2].min())

    def centers(self, values: Mapping[str, Tensor], num_frames: int) -> Tensor:
        """Mean places of both balls' nodes at every frame, (num_frames, 2, 3) [m]."""
        return self.rollout(values, num_frames)[:, self.nodes].mean(2)

    def rollout(self, values: Mapping[str, Tensor], num_frames: int) -> Tensor:
        """Nodes at every frame, (num_frames, num_nodes, 3) [m].

        Args:
            values: ``MOTION``, (); spins are given as velocities of rolling [m/s].
            num_frames: Number of frames; the first is the start.
        """
        state = self.start(values)
        if num_frames < 2:
            return state.x[None]
        physics = self.body.physics(youngs_modulus=values["youngs_modulus"])
        motion = soft.rollout(
            self.body,
            state,
            (num_frames - 1) * self.steps,
            external_force=lambda _, now: self._compute_pair_force(values, now),
            obstacles=contact.floor(friction=values["table_friction"]),
            physics=physics,
        )
        return motion.x[:: self.steps]

    def start(self, values: Mapping[str, Tensor]) -> soft.State:
        """Ball 0 at rest, ball 1 coming in, both with their lowest node on the table."""
        zero = torch.zeros((), dtype=torch.float64)
        x = self.ball.x_rest
        places = [torch.stack([values[f"x{k}"], values[f"y{k}"], zero - self.lowest]) for k in "01"]
        spin = torch.stack([-values["wy1"], values["wx1"], zero]) / self.radius
        glide = torch.stack([values["vx1"], values["vy1"], zero])
        coming = glide + torch.linalg.cross(spin.expand_as(x), x)
        return soft.State(
            torch.cat([x + place for place in places]), torch.cat([torch.zeros_like(x), coming])
        )

    def _compute_pair_force(self, values: Mapping[str, Tensor], now: soft.State) -> Tensor:
        with torch.no_grad():
            a, b = now.x[self.nodes].mean(1)
            if float((a - b).norm()) > 2.0 * self.radius:
                return torch.zeros_like(now.x)
        return contact.ball_force(
            now.x,
            now.v,
            self.nodes,
            radius=self.radius,
            stiffness=values["pair_stiffness"],
            friction=values["ball_friction"],
        )


def ball_mesh(radius: float, subdivisions: int) -> mesh.TetMesh:
    """An icosphere and its center, one tetrahedron per facet."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    points = torch.from_numpy(np.array(sphere.vertices))
    faces = torch.from_numpy(np.array(sphere.faces, dtype=np.int64))
    center = torch.full((len(faces), 1), len(points))
    points = torch.cat([points, torch.zeros(1, 3, dtype=torch.float64)])
    return mesh.TetMesh(points, torch.cat([faces[:, [0, 2, 1]], center], 1))


@dataclass(frozen=True, eq=False)
class SoftBallScene:
    """A part of the video, and the corners clicked in it."""

    values: Mapping[str, Tensor]  # ``MOTION``, the camera's numbers, () each
    frames: Tensor  # (T,) int64, samples as frames since the start
    rotation: Tensor  # (3, 3) of the camera before its small turn
    corners: Tensor  # (T, 3) places of the clicked corners [m], one per sample
    balls: SoftBalls  # simulator of both balls

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> SoftBallScene:
        """A copy in which one number is f(number)."""
        return replace(self, values={**self.values, name: change(self.values[name])})

    def simulate(self) -> Tensor:
        """(T, 6): u, v of the resting ball, of the coming one, and of the corner [px]."""
        return self.seen(self.motion())

    def motion(self) -> Tensor:
        """Centers at every frame up to the last sample, (num_frames, 2, 3) [m]."""
        return self.balls.centers(self.values, int(self.frames.max()) + 1)

    def seen(self, motion: Tensor) -> Tensor:
        """Pixels of a motion in the camera, (T, 6) [px]."""
        shown = motion[self.frames]
        places = [shown[:, 0], shown[:, 1], self.corners]
        return torch.cat([projected(self.values, self.rotation, p) for p in places], -1)


class SoftBallModel(SimModel):
    """Two soft balls in one camera; scenes that differ in the camera alone share their motion.

    Args:
        base: ``MOTION`` and the camera's parameters.
        rotation: (3, 3) of the camera before its small turn.
        balls: Simulator of both balls.
        size_px: Width and height of the picture.

    Attributes:
        report: Called after every simulated motion, for a progress bar.
    """

    def __init__(
        self,
        base: Sequence[Parameter],
        rotation: Tensor,
        balls: SoftBalls,
        size_px: Sequence[float] = (WIDTH_PX, HEIGHT_PX),
    ):
        self.balls, self.rotation, self.plain = balls, rotation, plain_camera(size_px)
        self.report: Callable[[], object] = lambda: None
        super().__init__(self._build_scene, base, "two soft balls, exact table, pinhole camera")

    def simulate_scenes(self, scenes: Sequence[SoftBallScene]) -> list[Tensor]:
        """Predictions of several scenes of one run."""
        motions: dict[tuple[float, ...], Tensor] = {}
        out = []
        for scene in scenes:
            key = tuple(float(scene.values[n]) for n in MOTION)
            if key not in motions:
                motions[key] = scene.motion()
                self.report()
            out.append(scene.seen(motions[key]))
        return out

    def values_at(self, x: np.ndarray) -> dict[str, Tensor]:
        """All numbers of a scene at standardized coordinates (n,)."""
        fitted_values = {
            p.name: p.value_at(torch.tensor(float(q), dtype=torch.float64))
            for p, q in zip(self.base, x, strict=True)
        }
        return {**self.plain, **fitted_values}

    def _build_scene(
        self, values: Mapping[str, Tensor], run: Run, numerics: Numerics
    ) -> SoftBallScene:
        if numerics != Numerics():
            raise ValueError(f"soft balls have no finer numerics, got {numerics}")
        frames = np.asarray(run.time_s) / self.balls.frame_s
        whole = np.rint(frames).astype(np.int64)
        if np.abs(frames - whole).max() > 0.02:
            worst = float(run.time_s[np.abs(frames - whole).argmax()])
            raise ValueError(
                f"run {run.name}: time_s {worst:g} is no whole number of frames of "
                f"{self.balls.frame_s:g} s; make SoftBalls with the video's frame_s"
            )
        corners = np.column_stack([run.command[f"corner_{a}_m"] for a in "xyz"])
        return SoftBallScene(
            {**self.plain, **values},
            torch.from_numpy(whole),
            self.rotation,
            torch.from_numpy(corners),
            self.balls,
        )
