"""Causes without a form: a generic smooth force on a soft body, a pull that nothing explains."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.interpolation import straight
from diffsim.causes.signals import Grid
from diffsim.core.checked import checked
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.kept import OfTime, ratio
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene

_SHAPES = ("even", "growing")


def _push_volume(
    scene: SoftScene,
    size: Tensor,
    run: Run,
    *,
    num_knots: int,
    spacing: float,
    axes: tuple[int, ...],
) -> SoftScene:
    """Force per volume: per axis evenly spread, and growing along the body's length.

    Components: knots of time fastest, then shapes, then axes; straight lines between knots.
    """
    x = scene.body.mesh.x_rest
    spread = x.amax(0) - x.amin(0)
    axis = int(spread.argmax())
    along = (x[:, axis] - x[:, axis].min()) / spread[axis]
    shapes = torch.stack([torch.ones_like(along), along]) * scene.body.nodal_volume
    knots = torch.zeros(3, len(_SHAPES), num_knots, dtype=size.dtype)
    own = size.reshape(len(axes), len(_SHAPES), num_knots)
    knots = knots.index_copy(0, torch.tensor(axes), own)
    return scene.with_hook(lambda: _Knots(knots, shapes, spacing))


class _Knots(Force):
    leading_axes, reads = True, ()

    def __init__(self, knots: Tensor, shapes: Tensor, spacing: float):
        rows = knots.reshape(-1, knots.shape[-1]).T  # (num_knots, 3 * num_shapes)
        self._rows, self._shapes, self._spacing = rows, shapes, spacing
        self._knots = OfTime(lambda times: straight(rows, spacing, times).unflatten(1, (3, -1)))

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        return (self._knots(moment) @ self._shapes).T.expand(moment.x.shape)

    def factor_of(self, other: Force) -> Tensor | None:
        """Signals on the same knots may be multiples of each other."""
        if not isinstance(other, _Knots) or other._spacing != self._spacing:
            return None
        return ratio(self._rows, other._rows)

    def stacked_with(self, others: Sequence[Force]) -> Force | None:
        """Signals on the same knots, with the same shapes."""
        alike = [o for o in others if isinstance(o, _Knots) and self._is_like(o)]
        if len(alike) < len(others):
            return None
        every = torch.stack([h._rows for h in (self, *alike)], 1)
        return _ManyKnots(every, self._shapes, self._spacing)

    def _is_like(self, other: _Knots) -> bool:
        same_knots = other._spacing == self._spacing and other._rows.shape == self._rows.shape
        return same_knots and torch.equal(other._shapes, self._shapes)


class _ManyKnots(Force):
    """n forces of :class:`_Knots`, each at a state of its own.

    Args:
        rows: (num_knots, n, 3 * num_shapes) values at the knots.
        shapes: (num_shapes, num_nodes) volume that each value acts on [m^3].
        spacing: Time between two knots [s].
    """

    leading_axes, reads = True, ()

    def __init__(self, rows: Tensor, shapes: Tensor, spacing: float):
        count, every = rows.shape[1], rows.flatten(1)
        self._shapes = shapes
        self._knots = OfTime(
            lambda times: straight(every, spacing, times).unflatten(1, (count, 3, -1))
        )

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        return (self._knots(moment) @ self._shapes).transpose(-1, -2)


@checked
def unknown_force(num_knots: int, until_s: float, axes: str = "xyz") -> Effect:
    """The effect with ``num_knots`` >= 2 knots from 0 to ``until_s`` [s], along ``axes``."""
    idx, spacing = tuple("xyz".index(axis) for axis in axes), until_s / (num_knots - 1)
    return Effect(
        name="unknown_force",
        form="Force per volume: per axis evenly spread, and growing along the body's length.",
        family="unknown",
        kind="force",
        unit="N/m^3",
        typical=100.0,
        also_looks_like=("anything",),
        apply=partial(_push_volume, num_knots=num_knots, spacing=spacing, axes=idx),
        components=tuple(f"{a}_{s}_{k}" for a in axes for s in _SHAPES for k in range(num_knots)),
    )


def _pull_more(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    def add(u: Tensor, grid: Grid) -> Tensor:
        return u + straight(size[:, None], spacing, grid.times).mT

    return scene.with_command((), add)


def unknown_pull(num_knots: int, spacing: float) -> Effect:
    """A change of the command that nothing explains, knots in time every ``spacing`` [s]."""
    return Effect(
        name="unknown_pull",
        family="unknown",
        kind="actuator",
        unit="command",
        typical=0.01,
        apply=partial(_pull_more, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(num_knots)),
    )
