"""How a formula of a user acts on a scene, through each of its ports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.formulas import Formula, constant_in
from diffsim.causes.ports import SignalChange, change_number
from diffsim.causes.scene import ForceLaw, Scene
from diffsim.causes.signals import Grid, change_rows
from diffsim.core.expression import Expression
from diffsim.data.study import Run
from diffsim.identify.effect import Apply


@dataclass(frozen=True, eq=False)
class ByFormula:
    """A formula that acts."""

    formula: Formula  # of the signal u, the time t and ``size``; of a force of x, v and w
    shapes: tuple[str, ...]  # its further numbers, whose values come after the sizes
    num_sizes: int = 1  # number of sizes; 0: the shapes are all that there is
    is_kinked: bool = False  # whether it has a kink at size 0

    def at_commands(self, names: Sequence[str]) -> Apply:
        """How it acts on commands."""
        return partial(self._change_commands, names=tuple(names))

    def at_readings(self, places: Sequence[int], channels: Sequence[str]) -> Apply:
        """How it acts on channels.

        Args:
            places: Indices of the channels that it changes.
            channels: Names of all channels, which it may use.
        """
        used = {n: k for k, n in enumerate(channels) if n in self.formula.names}
        return partial(self._change_readings, places=tuple(places), used=used)

    def at_numbers(self, names: Sequence[str], *, is_factor: bool) -> Apply:
        """How it acts on numbers: equally many of each size share it.

        Args:
            is_factor: Whether they become as much larger, in place of having it added.
        """
        return partial(self._change_numbers, names=tuple(names), is_factor=is_factor)

    def at_place(self, place: str) -> Apply:
        """How it acts as a force at a place."""
        return partial(self._push, place=place)

    def _split(self, size: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Sizes, (..., num_sizes), and the shapes by name, (...) each."""
        shapes = size[..., self.num_sizes :]
        return size[..., : self.num_sizes], dict(zip(self.shapes, shapes.unbind(-1), strict=True))

    def _change_commands(
        self, scene: Scene, size: Tensor, run: Run, *, names: tuple[str, ...]
    ) -> object:
        return scene.with_command(names, self._change(size, run, {}))

    def _change_readings(
        self,
        scene: Scene,
        size: Tensor,
        run: Run,
        *,
        places: tuple[int, ...],
        used: Mapping[str, int],
    ) -> object:
        if not used:
            return scene.with_reading(places, self._change(size, run, {}))
        plain = self._change(size, run, {})
        among = partial(_among, places=places, used=used, of=partial(self._change, size, run))
        return scene.with_reading((), SignalChange(among, plain.size))

    def _change(self, size: Tensor, run: Run, more: Mapping[str, Tensor]) -> SignalChange:
        sizes, shapes = self._split(size)
        own = {**{name: value[..., None, None] for name, value in shapes.items()}, **more}
        change = partial(self._map, run=run, own=own)
        return SignalChange(change, sizes if self.num_sizes else size, self.is_kinked)

    def _map(
        self, u: Tensor, grid: Grid, size: Tensor, *, run: Run, own: Mapping[str, Tensor]
    ) -> Tensor:
        own = {**own, "u": u, "t": grid.since_start, "size": size[..., None]}
        return self.formula(own, run, grid)

    def _change_numbers(
        self,
        scene: Scene,
        size: Tensor,
        run: Run,
        *,
        names: tuple[str, ...],
        is_factor: bool,
    ) -> object:
        sizes, shapes = self._split(size)
        num_each = len(names) // max(self.num_sizes, 1)
        out: Scene = scene
        for i, name in enumerate(names):
            own = {"size": sizes[..., i // num_each]} if self.num_sizes else {}
            amount = self.formula({**shapes, **own}, run)
            out = out.with_number(name, partial(change_number, amount=amount, is_factor=is_factor))
        return out

    def _push(self, scene: Scene, size: Tensor, run: Run, *, place: str) -> object:
        sizes, shapes = self._split(size)
        known = {n: constant_in(run, n) for n in self._list_constants()}
        known.update(self.formula.numbers)
        own = sizes[..., 0] if self.num_sizes else torch.ones_like(size[..., 0])
        law = FilledLaw(self.formula.expression, known, shapes)
        return scene.with_force(place, ForceLaw(law, own))

    def _list_constants(self) -> list[str]:
        own = {"x", "v", "w", "size", *self.shapes, *self.formula.numbers}
        return [name for name in self.formula.expression.names if name not in own]


def _among(
    signals: Tensor,
    grid: Grid,
    size: Tensor,
    *,
    places: tuple[int, ...],
    used: Mapping[str, int],
    of: Callable[[Mapping[str, Tensor]], SignalChange],
) -> Tensor:
    """Some of all channels changed by a formula that uses others."""
    others = {name: signals[..., k : k + 1, :] for name, k in used.items()}
    return change_rows(signals, places, of(others), grid)


@dataclass(frozen=True, eq=False)
class FilledLaw:
    """A formula of position and speed in which all else has its value."""

    expression: Expression
    numbers: Mapping[str, float]  # known numbers and facts of the run by name
    shapes: Mapping[str, Tensor]  # further numbers, () or (K,) each

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        """Its value; shapes stand along the axis of the sizes."""
        size = values["size"]
        own = {n: torch.tensor(v, dtype=torch.float64) for n, v in self.numbers.items()}
        own |= {n: v.reshape(size.shape) for n, v in self.shapes.items()}
        return self.expression({**own, **values})

    def on_floats(self, *names: str) -> Callable[..., float]:
        """The same on plain numbers."""
        more = {**self.numbers, **{n: float(v.detach()) for n, v in self.shapes.items()}}
        inner, given = self.expression.on_floats(*names, *more), tuple(more.values())
        return lambda *values: inner(*values, *given)
