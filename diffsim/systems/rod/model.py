"""A described rod as a model: its scenes, from values of its quantities to poses of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from diffsim.causes.scene import Commands, Scene, grid_of
from diffsim.core.arrays import Array, IntArray
from diffsim.core.memo import Memo
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.shape import MovingShape
from diffsim.systems.rod.assembly import Numbers, rod_of
from diffsim.systems.rod.layout import RodLayout, layout_of
from diffsim.systems.rod.statics import RodStatics

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.shape import MovingShape
    from diffsim.systems.description import BaseParameters
    from diffsim.systems.rod.keys import RodKeys


_SIDES = 12  # of a section
_BULGE, _STUD = 1.25, 0.35  # radius of a marker in the axis and on the skin, in radii of the rod


def skin_of(layout: RodLayout, frames: Tensor, places: Tensor, thicker: float) -> MovingShape:
    """The rod as it is simulated, one closed tube.

    Args:
        layout: What does not change with a number.
        frames: Of the sections at the ends of the elements, (num_samples, N + 1, 3, 3).
        places: Their places, (num_samples, N + 1, 3) [m].
        thicker: Added to the radius [m].
    """
    radius = _average_radius(layout) + thicker
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], 1)
    across = np.einsum("sekl,il->seik", frames.numpy(), ring)
    skin = places.numpy()[:, :, None] + radius[:, None, None] * across
    ends = places.numpy()[:, [0, -1]]
    nodes = np.concatenate([skin.reshape(len(skin), -1, 3), ends], 1)
    return MovingShape(
        triangles=_build_tube(len(radius)),
        nodes_m=nodes @ _find_upright(layout).T,
        closed=True,
    )


def dots_of(layout: RodLayout, channels: Tensor) -> MovingShape | None:
    """Markers of which channels show all three coordinates.

    Args:
        channels: Measured or predicted, (num_samples, num_channels) [m].

    Returns:
        None where no marker is known in space.
    """
    column = {int(c): i for i, c in enumerate(layout.columns)}
    markers = layout.markers
    known = [m for m in range(len(markers.names)) if all(3 * m + k in column for k in range(3))]
    if not known:
        return None
    places = channels[:, [[column[3 * m + k] for k in range(3)] for m in known]].numpy()
    radius = layout.shape.radius[markers.element[known]].numpy()
    beside = markers.offset[known].norm(dim=-1).numpy()
    size = np.maximum(_STUD * radius, _BULGE * radius - beside)
    return MovingShape.of_balls(places @ _find_upright(layout).T, size)


def _average_radius(layout: RodLayout) -> Array:
    shape = layout.shape
    at, radius = shape.middles.numpy(), shape.radius.numpy()
    slope = np.diff(radius)[[0, -1]] / np.diff(at)[[0, -1]]
    edges = shape.edges.numpy()
    out = np.interp(edges, at, radius)
    out[[0, -1]] += slope * (edges[[0, -1]] - at[[0, -1]])
    return np.maximum(out, 0.0)


def _build_tube(count: int) -> IntArray:
    """Triangles of rings one behind the other, then the middles of both ends."""
    here = np.arange(_SIDES)
    beside = (here + 1) % _SIDES
    pieces = []
    for k in range(count - 1):
        a, b = k * _SIDES + here, k * _SIDES + beside
        pieces += [np.stack([a, b, b + _SIDES], 1), np.stack([a, b + _SIDES, a + _SIDES], 1)]
    base, tip, last = count * _SIDES, count * _SIDES + 1, (count - 1) * _SIDES
    pieces.append(np.stack([np.full(_SIDES, base), beside, here], 1))
    pieces.append(np.stack([np.full(_SIDES, tip), last + here, last + beside], 1))
    return np.concatenate(pieces)


def _find_upright(layout: RodLayout) -> Array:
    """From the recorded frame to one in which gravity points down, (3, 3)."""
    down = layout.gravity.numpy()
    if not down.any() or (np.allclose(down[:2], 0.0) and down[2] < 0.0):
        return np.eye(3)
    return Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])[0].as_matrix()


@dataclass(frozen=True, kw_only=True, eq=False)
class RodScene(Scene):
    """A rod under the tensions of a run; each sample is a pose."""

    layout: RodLayout  # what does not change with a number: elements, markers, paths
    tolerance: float  # turn of the solver's last step [rad]
    # strains to start from, (num_samples, N, 3) [1/m]; None: from straight
    guess: Tensor | None = None

    @property
    def tensions(self) -> Tensor:
        """Commanded tensions as the tendons hear them, (..., num_samples, num_tendons) [N]."""
        return self.commands.heard(self.grid).mT

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        numbers = Numbers.of(self.numbers)
        ways = [f"{m}_{way}" for m in self.layout.markers.names for way in ("along", "y", "z")]
        offset = self.layout.markers.offset + numbers.stacked(*ways).unflatten(-1, (-1, 3))
        shown = self._solve(self._rod, offset)[1].flatten(-2)[..., self.layout.columns]
        is_one = self.tensions.ndim == 2 and not any(v.ndim for v in self.numbers.values())
        return self.instruments.read_late(shown[0] if is_one else shown, self.grid)

    @property
    def _rod(self) -> RodStatics:
        return rod_of(self.layout, self.numbers, self.tensions)

    def strains(self) -> Tensor:
        """Twist and bends at the first point in equilibrium, (num_samples, N, 3) [1/m]."""
        with torch.no_grad():
            return self._solve(self._rod, self.layout.markers.offset)[0][0]

    def course(self) -> tuple[Tensor, Tensor]:
        """Rotations (num_samples, N + 1, 3, 3) and places (num_samples, N + 1, 3) [m] of the
        sections at the ends of the elements, at the first point."""
        rod = self._rod
        with torch.no_grad():
            found = rod.survey(self._solve(rod, self.layout.markers.offset)[0])
        return found.frames[0], found.nodes[0]

    def skin(self) -> MovingShape:
        """The rod in every pose; what causes change in channels is left out."""
        with torch.no_grad():
            added = float(self.numbers.get("radius_offset", torch.zeros(())))
            return skin_of(self.layout, *self.course(), added)

    def _solve(self, rod: RodStatics, offset: Tensor) -> tuple[Tensor, Tensor]:
        """Strains (K, num_samples, N, 3) [1/m] and places of the markers (K, num_samples, P, 3)."""
        start, straight = self.guess, self.guess is None
        if start is None:
            shape = self.commands.values.shape[-1], len(self.layout.shape.radius), 3
            start = torch.zeros(shape, dtype=torch.float64)
        start = start.expand(Numbers.of(self.numbers).count, *start.shape)
        return rod.solve(self.layout.markers, offset, start, self.tolerance, straight=straight)


class RodModel(SimModel):
    """The model of a described rod; many points are simulated at once.

    Args:
        given: Description.
        channels: Names of the channels, in the order of the study.
        parameters: Quantities of the description: base parameters, and values of a run.
        zeros: Numbers that causes alone change.
    """

    _shape_of_scene = staticmethod(RodScene.skin)

    def __init__(
        self,
        given: RodKeys,
        channels: Sequence[str],
        parameters: BaseParameters,
        zeros: tuple[str, ...],
    ):
        self.given, self.parameters, self.zeros = given, parameters, zeros
        self.step_cost = 1000.0  # weighted steps of a pose
        self._layout = lru_cache(maxsize=8)(lambda finer: layout_of(given, channels, finer))
        self._guesses: Memo[Tensor] = Memo()
        super().__init__(self._build, parameters.base, "described rod", batched=True)

    def _build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        """The scene of a run, which starts from the run's pose at the best guess beforehand."""
        scene = self._build_scene(self.parameters.in_run(values, run), run, numerics)
        pulls = (
            scene.commands.values.mT.numpy()
        )  # the first half of a run has its name, and fewer of them
        key = (run.name, len(pulls), pulls.tobytes(), numerics.mesh)
        guess = self._guesses(key, lambda: self._build_at_prior(run, numerics).strains())
        return scene.changed(guess=guess)

    def _build_at_prior(self, run: Run, numerics: Numerics) -> RodScene:
        values = {p.name: torch.tensor(p.value).double() for p in self.parameters.base}
        return self._build_scene(self.parameters.in_run(values, run), run, numerics)

    def _build_scene(self, numbers: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        layout: RodLayout = self._layout(1.0 / numerics.mesh)
        drives = [t.command for t in self.given.tendons]
        columns = [np.asarray(run.command[drive], np.float64) for drive in drives]
        tensions = np.stack(columns, 1) if columns else np.zeros((len(run.time_s), 0))
        return RodScene(
            grid=grid_of(run),
            numbers=numbers,
            zeros=self.zeros,
            commands=Commands.named(drives, torch.from_numpy(tensions).mT),
            layout=layout,
            tolerance=self.given.numerics.tolerance * numerics.tolerance,
        )

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """Markers where channels tell all their coordinates."""
        return dots_of(self._layout(1.0), channels)
