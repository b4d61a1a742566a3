"""How effects reach a scene: by formulas with their sizes, by signals on the way in or out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Apply
from diffsim.systems.ode.grid import Grid
from diffsim.systems.ode.network import Change
from diffsim.systems.ode.scene import OdeScene

#: (signal on the grid, grid, size () or (K,)) -> the same signal, changed
SizedMap = Callable[[Tensor, Grid, Tensor], Tensor]


def symbol(effect: str) -> str:
    """What the size of an effect is called in formulas that users cannot write."""
    return f"size of {effect}"


def by_formulas(change: Change, *symbols: str) -> Apply:
    """An effect that changes formulas.

    Args:
        change: Formulas in which the sizes are called ``symbols``.
        symbols: One for each component, in order.
    """
    return partial(_changed, change=change, symbols=symbols)


def _changed(
    scene: OdeScene, size: Tensor, run: Run, *, change: Change, symbols: Sequence[str]
) -> OdeScene:
    return scene.with_change(change, {s: size[..., i] for i, s in enumerate(symbols)})


def by_input(name: str, change: SizedMap) -> Apply:
    """An effect that changes an input on its way: f(input, grid, size)."""
    return partial(_driven, name=name, change=change)


def _driven(scene: OdeScene, size: Tensor, run: Run, *, name: str, change: SizedMap) -> OdeScene:
    return scene.with_input(name, lambda u, grid: change(u, grid, size[..., 0]))


def by_reading(channels: Sequence[str], change: SizedMap) -> Apply:
    """An effect that changes channels alike: f(channel, grid, size)."""
    return partial(_read, channels=tuple(channels), change=change)


def _read(
    scene: OdeScene, size: Tensor, run: Run, *, channels: Sequence[str], change: SizedMap
) -> OdeScene:
    for channel in channels:
        scene = scene.with_reading(channel, lambda y, grid: change(y, grid, size[..., 0]))
    return scene
