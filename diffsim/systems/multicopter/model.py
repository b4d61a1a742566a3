"""Flights of a multicopter, many parameter points as one batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from diffsim.causes.scales import SCALES, Scales
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.core.arrays import Array, IntArray
from diffsim.core.checked import checked, checked_methods
from diffsim.core.errors import ConvergenceError
from diffsim.core.layer import may_be_differentiated
from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy
from diffsim.identify import Parameter
from diffsim.identify.effect import Effect
from diffsim.identify.model import TOGETHER, Build, Scene, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.identify.starts import left_by_starts
from diffsim.systems.multicopter.cutting import (
    LONGEST,
    LONGEST_S,
    MIN_WINDOW_SAMPLES,
    spacing,
)
from diffsim.systems.multicopter.frames import SENSORS
from diffsim.systems.multicopter.readings import RecordedScene
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.multicopter.shooting import RIGID, FlightShooting

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.shape import MovingShape


_SIDES = 10  # of a propeller's disc
_UP = np.diag([1.0, -1.0, -1.0])  # z up from north-east-down


def figure_of(scene: CopterScene, channels: Tensor) -> MovingShape | None:
    """The vehicle at the poses that channels show.

    Args:
        scene: The run's scene: its sensors, frames and vehicle.
        channels: Measured or predicted, (num_samples, num_channels).

    Returns:
        None where position or attitude are not among the channels.
    """
    position = _pick_group(scene, channels, "position")
    rotation = _pick_rotation(scene, channels)
    if position is None or rotation is None:
        return None
    turn = _UP @ scene.frames.rotation(rotation).numpy()
    place = scene.frames.in_world(position).numpy() @ _UP
    nodes, triangles = _build_stand_in(scene.vehicle)
    return MovingShape(
        triangles=triangles, nodes_m=nodes @ turn.transpose(0, 2, 1) + place[:, None]
    )


def _pick_group(scene: RecordedScene, channels: Tensor, group: str) -> Tensor | None:
    """Readings of a group, (num_samples, width); None where one of them is not recorded."""
    if group not in scene.sensors:
        return None
    start = sum(len(SENSORS[g]) for g in scene.sensors[: scene.sensors.index(group)])
    wanted = list(range(start, start + len(SENSORS[group])))
    known = list(range(channels.shape[1])) if scene.columns is None else list(scene.columns)
    if not set(wanted) <= set(known):
        return None
    return channels[:, [known.index(column) for column in wanted]]


def _pick_rotation(scene: RecordedScene, channels: Tensor) -> Tensor | None:
    """World from body as recorded, (num_samples, 3, 3)."""
    turns = _pick_group(scene, channels, "quaternion")
    if turns is not None:
        return matrix_from_quaternion(turns / turns.norm(dim=-1, keepdim=True))
    angles = _pick_group(scene, channels, "attitude")
    return None if angles is None else matrix_from_rpy(angles)


def _build_stand_in(fleet: Fleet) -> tuple[Array, IntArray]:
    """Nodes (num_nodes, 3) in the body frame [m] and triangles of arms and discs."""
    hubs, axes = fleet.positions[0].numpy(), fleet.directions[0].numpy()
    radii = fleet.radii[0].numpy()
    nodes: list[Array] = []
    triangles: list[IntArray] = []
    for hub, axis, radius in zip(hubs, axes, radii, strict=True):
        # of an arm, where nobody states the propeller's radius
        size = float(radius) if radius > 0.0 else 0.4 * float(np.linalg.norm(hub))
        across = np.cross(axis, hub) if np.linalg.norm(np.cross(axis, hub)) > 0.0 else np.eye(3)[0]
        across = across / np.linalg.norm(across)
        beside = np.cross(axis, across)
        angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
        rim = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * beside
        first = sum(len(n) for n in nodes)
        width = 0.08 * size * across  # half the width of an arm, over its propeller's radius
        nodes += [np.array([width, -width, hub - width, hub + width]), hub + size * rim]
        disc = first + 4 + np.arange(_SIDES)
        fan = np.stack([np.full(_SIDES - 2, disc[0]), disc[1:-1], disc[2:]], 1)
        triangles += [first + np.array([[0, 1, 2], [0, 2, 3]]), fan]
    return np.concatenate(nodes), np.concatenate(triangles)


@checked_methods
class CopterModel(SimModel):
    """A model that flies many parameter points as one batch.

    Args:
        flights: Recipe that makes the scene of a run.
        base: Base parameters with their priors.
    """

    @checked
    def __init__(self, flights: Build, base: Sequence[Parameter]):
        super().__init__(flights, base, "multicopter")
        self.flights: Any = flights

    def scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> Scene:
        """The run at one point; where nobody differentiates it is that point to 13 digits, by which
        it is known again: sizes come from two formulas that differ in the last one."""
        if may_be_differentiated():
            return super().scene(run, q, sizes, numerics)
        q = _round_values(q)
        there = {e: _round_values(s) for e, s in (sizes or {}).items() if s.any()}
        made = super().scene(run, q, there, numerics)
        assert isinstance(made, CopterScene)
        digits = ((e, s.numpy().tobytes()) for e, s in there.items())
        point = (self, numerics or Numerics(), q.numpy().tobytes(), *digits)
        return made.changed(point=point, note=partial(self._note_starts, run, numerics))

    def _note_starts(self, run: Run, numerics: Numerics | None, number: int) -> None:
        """Count a flight of a search for initial states; it is no prediction by itself."""
        self.simulations.add(0, round(self.cost(run, numerics) * (1.0 + TOGETHER * (number - 1))))

    def shortened(self, runs: Sequence[Run]) -> SimModel | None:
        """The model with windows half as long as the longest one of some runs.

        Returns:
            None where their length was stated, or where they have as few samples as they may.
        """
        cutter = self.flights.cutter
        lengths = {run: self.flights.windows(run).measured.shape[1] for run in runs}
        if cutter.window_s is not None or max(lengths.values(), default=0) <= MIN_WINDOW_SAMPLES:
            return None
        longest_s = 0.5 * max(length * spacing(run) for run, length in lengths.items())
        shorter = replace(self.flights, cutter=replace(cutter, longest_s=longest_s))
        made = CopterModel(shorter, self.base)
        if SCALES in self.frame:
            scales = Scales.read(self.frame[SCALES])
            shorter_scales = replace(scales, facts={**scales.facts, LONGEST: longest_s})
            made.frame = {**self.frame, SCALES: shorter_scales.saved()}
        return made

    def prepared_at(self, q: Tensor, runs: Sequence[Run] = ()) -> SimModel:
        """The model with windows as long as it settles in at these coordinates, up to a second.

        Windows of the prior may be short because a gain of the data sheet is off.

        Args:
            q: Standardized base parameters, (num_base,).
            runs: Runs that were fitted; the model itself where their windows are long already.
        """
        cutter = self.flights.cutter
        if cutter.window_s is not None or (runs and not self.short_windows(runs)):
            return self
        values = {name: v.detach() for name, v in self.values.at(q).items()}
        longer = replace(cutter, longest_s=LONGEST_S)
        made = CopterModel(replace(self.flights, cutter=longer, cut_at=values), self.base)
        made.frame = self.frame
        before, after = (
            [m.flights.windows(r).measured.shape[1] for r in runs] for m in (self, made)
        )
        return made if not runs or sum(after) > sum(before) else self

    def short_windows(self, runs: Sequence[Run]) -> Mapping[str, float]:
        """Length of the windows [s] by run, where it is shorter than what was wished for."""
        wished = self.flights.cutter.window_s or LONGEST_S
        lengths = {r: (self.flights.windows(r).measured.shape[1], spacing(r)) for r in runs}
        return {
            run.name: count * dt
            for run, (count, dt) in lengths.items()
            if count < min(max(MIN_WINDOW_SAMPLES, round(wished / dt)), len(run.time_s))
        }

    def left_of_readings(
        self, scene: Callable[[], Scene], change: sparse.csr_array
    ) -> sparse.csr_array:
        """As of ``SimModel``: each window's start state takes in what it can."""
        with torch.no_grad():
            made = scene()
            assert isinstance(made, CopterScene)
            shooting = made.find_starts()
        return left_by_starts(change, shooting.tangent, shooting.gain)

    def num_fitted_inside(self, run: Run) -> int:
        """Number of values that are fitted to a run whatever it is used for: start states."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, CopterScene)
        guess = scene.windows.guess
        return len(guess) * RIGID + guess.shape[1] - RIGID

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """Arms and propellers at the poses that channels show, where they show them."""
        scene = self.scene(run, self.at_prior())
        assert isinstance(scene, CopterScene)
        return figure_of(scene, channels)

    def simulate_many(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        numerics: Numerics | None = None,
    ) -> Tensor:
        """Points with the same effects in one batch: what is absent costs nothing.

        Best initial states follow by the tangents of the first point, the center of a stencil.
        """
        present = torch.stack(
            [torch.zeros(len(q), dtype=torch.bool), *((s != 0.0).any(1) for s in sizes.values())], 1
        )
        kinds, kind = torch.unique(present, dim=0, return_inverse=True)
        out = q.new_empty(len(q), *run.measured.shape)
        shooting = self._build_scene(run, q[:1], sizes, present[0, 1:], numerics).find_starts()
        for k, row in enumerate(kinds[:, 1:]):
            mine = torch.nonzero(kind == k)[:, 0]
            mine_only = {e: s[mine] for e, s in sizes.items()}
            scenes = partial(self._build_scene, run, present=row, numerics=numerics)
            out[mine] = _simulate_near(scenes, q[mine], mine_only, shooting)
        return out

    def _build_scene(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor],
        present: Tensor,
        numerics: Numerics | None,
    ) -> CopterScene:
        there = {e: s for (e, s), on in zip(sizes.items(), present, strict=True) if on}
        scene = self.scene(run, q, {e: s[: len(q)] for e, s in there.items()}, numerics)
        assert isinstance(scene, CopterScene)
        return scene


def _simulate_near(
    scenes: Callable[[Tensor, Mapping[Effect, Tensor]], CopterScene],
    q: Tensor,
    sizes: Mapping[Effect, Tensor],
    shooting: FlightShooting,
) -> Tensor:
    """Predictions at points near that of the tangents, (K, num_samples, num_channels); a point that
    is too far from it has a search of its own."""
    scene = scenes(q, sizes)
    try:
        return scene.simulate_many(len(q), shooting)
    except ConvergenceError:
        if len(q) == 1:
            return scene.simulate()[None]
    middle = len(q) // 2
    halves = (slice(middle), slice(middle, None))
    parts = [(q[half], {e: s[half] for e, s in sizes.items()}) for half in halves]
    return torch.cat([_simulate_near(scenes, *part, shooting) for part in parts])


def _round_values(values: Tensor) -> Tensor:
    """Values to 13 digits."""
    bits = values.contiguous().view(torch.int64)
    return ((bits + (1 << 7)) >> 8 << 8).view(torch.float64)
