"""Soft-body models: derivatives of predictions by tangents of the simulation, moving surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.scene import Instruments
from diffsim.core.checked import checked_methods
from diffsim.core.memo import Memo
from diffsim.identify.effect import Effect
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import NumericalEffect, Numerics
from diffsim.identify.shape import MovingShape
from diffsim.mesh import surface_triangles
from diffsim.systems.soft_body.hanging import SlackScene, slack_tangents
from diffsim.systems.soft_body.line import OwnedScene, SceneLine, simulate_together
from diffsim.systems.soft_body.quasi_static import PosedScene
from diffsim.systems.soft_body.scene import SoftScene
from diffsim.systems.soft_body.tangents import scene_tangents

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.line import DifferenceLine, ModelPoint
    from diffsim.identify.shape import MovingShape


NODE_COST = 4.0  # weighted steps of a node in a time step


def surface_of(scene: Any) -> MovingShape | None:
    """One more simulation of the scene, in which the nodes of the surface are observed.

    Args:
        scene: A run with its effects; what they change in cameras and channels is left out. Of what
            is no ``SoftScene`` nothing is seen.
    """
    if not isinstance(scene, SoftScene):
        return None
    faces = surface_triangles(scene.body.mesh).faces
    used, local = torch.unique(faces, return_inverse=True)

    def observe(x: Tensor) -> Tensor:
        return x[..., used, :].flatten(-2)

    clocks = Instruments(scene.instruments.clocks)
    bare = scene.changed(
        observe=observe, place_maps=(), output_maps=(), rest_places=None, instruments=clocks
    )
    if isinstance(bare, PosedScene):
        bare = replace(bare, kept=Memo(1))  # what is kept shows markers
    places = bare.simulate().detach().numpy()
    return MovingShape(
        triangles=local.reshape(-1, 3).numpy(),
        nodes_m=np.ascontiguousarray(places.reshape(len(places), -1, 3)),
        closed=True,
    )


@checked_methods
class SoftModel(SimModel):
    """A simulator whose ``build`` makes :class:`SoftScene`; arguments as for ``SimModel``.

    All smooth columns of a linearization come from one rollout with its tangents. Effects of size
    zero are left out wherever they are not what is differentiated: at zero they are the scene
    itself.

    Attributes:
        num_nodes: Of the mesh, for the cost of a step; 0: not stated.
        dt_s: Time step [s]; 0: one equilibrium per pose.
        num_poses: Most equilibria of a run where motions are slow.
    """

    num_nodes: int = 0
    dt_s: float = 0.0
    num_poses: int = 0
    mesh_power = 3.0
    _shape_of_scene = staticmethod(surface_of)

    def cost(self, run: Run, numerics: Numerics | None = None) -> float:
        """Weighted steps of one prediction, see :meth:`SimModel.cost`."""
        if not self.num_nodes:
            return super().cost(run, numerics)
        n = numerics or Numerics()
        steps = float(min(self.num_poses, len(run.time_s)))
        if self.dt_s > 0.0:
            steps = float(run.time_s[-1] - run.time_s[0]) / (self.dt_s * n.time_step)
        return self.run_cost + NODE_COST * self.num_nodes / n.mesh**self.mesh_power * steps

    def simulate_scenes(self, scenes: Sequence[Any]) -> list[Tensor]:
        """Predictions of several scenes of one run, at once where only commands differ."""
        return simulate_together(scenes)

    def tangents(
        self,
        run: Run,
        at: ModelPoint,
        lines: Sequence[DifferenceLine],
        numerics: Numerics | None = None,
    ) -> tuple[Tensor, Tensor] | None:
        """Prediction and its derivatives, see :meth:`SimModel.tangents`."""
        acting = {e for e, size in at.sizes.items() if bool(size.any())}
        if any(isinstance(e, NumericalEffect) for e in acting):
            return None
        plain = _PlainScenes(self, run, numerics)
        base = _build_owned_scene(plain, at, acting)
        if base is None:
            return None
        physical = [n for n in lines if not isinstance(n.effect, NumericalEffect)]
        scene_lines = []
        for line in physical:
            present = acting if line.effect is None else acting | {line.effect}
            points = [_build_owned_scene(plain, p, present) for p in line.points]
            scenes = tuple(p for p in points if p is not None)
            if len(scenes) < len(points):
                return None
            scene_lines.append(SceneLine(line.stencil, scenes, line.effect))
        slack = isinstance(base.scene, SlackScene)
        moved = slack_tangents(base, scene_lines) if slack else scene_tangents(base, scene_lines)
        if moved is None or len(physical) == len(lines):
            return moved
        here, columns = moved[0], iter(moved[1])
        blended = [
            next(columns)
            if not isinstance(n.effect, NumericalEffect)
            else self._blend(run, at, n, n.effect, here, numerics)
            for n in lines
        ]
        return here, torch.stack(blended)

    def _blend(
        self,
        run: Run,
        at: ModelPoint,
        line: DifferenceLine,
        effect: NumericalEffect,
        here: Tensor,
        numerics: Numerics | None,
    ) -> Tensor:
        """Column of a numerical cause, whose size blends two predictions."""
        sizes = {e: s for e, s in at.sizes.items() if not isinstance(e, NumericalEffect)}
        rate = sum(
            w * float(p.sizes[effect][0])
            for w, p in zip(line.stencil.weights, line.points, strict=True)
        )
        finer = (numerics or Numerics()).refined(effect.refined)
        with torch.no_grad():
            return rate * (self.predict(run, at.q, sizes, finer) - here)


class _PlainScenes:
    """Scenes of a run without effects, built once for lines that leave base parameters alone.

    Args:
        model: Simulator.
        run: Run with commands and times.
        numerics: Factors on time step, mesh and tolerance; None: the model's own.
    """

    def __init__(self, model: SoftModel, run: Run, numerics: Numerics | None):
        self.run, self.values = run, model.values
        self._model, self._numerics = model, numerics
        self._made: dict[bytes, Any] = {}

    def __call__(self, q: Tensor) -> Any:
        """The scene at standardized base parameters (num_base,)."""
        key = q.numpy().tobytes()
        if key not in self._made:
            self._made[key] = self._model.scene(self.run, q, None, self._numerics)
        return self._made[key]


def _build_owned_scene(
    plain: _PlainScenes, at: ModelPoint, present: set[Effect]
) -> OwnedScene | None:
    """The scene at a point with some of its effects; None where it is no soft scene."""
    scene = plain(at.q)
    if not isinstance(scene, SoftScene):
        return None
    owners: list[Effect | None] = [None] * len(scene.makers)
    for effect, size in at.sizes.items():
        if effect in present and not isinstance(effect, NumericalEffect):
            scene = effect.act(scene, size, plain.run, plain.values.at(at.q))
            owners += [effect] * (len(scene.makers) - len(owners))
    return OwnedScene(scene, tuple(owners))
