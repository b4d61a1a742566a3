"""What all scenes of steady flow share: levels of the commands, meters, and ports for causes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.instruments import Instruments
from diffsim.causes.signals import Grid, SignalMap, change_rows
from diffsim.core.check import did_you_mean

if TYPE_CHECKING:
    from typing_extensions import Self

_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyScene:
    """One run in which the flow is steady at every sample.

    Attributes:
        drive: What each pump gives, or each regulator holds, at each level of the commands,
            (num_levels, num_inlets) [m^3/s, m^2/s or Pa].
        back_pressure: Held at other ends, (num_levels, num_held) [Pa].
        level: Index of the level at each sample, (num_samples,).
        commands: Name of the command of each column of ``drive``, then of ``back_pressure``; empty
            where it is constant.
        grid: Times of the samples.
        numbers: Numbers that causes may change, by name: the field that holds it, and its index
            there; None: the field is the number.
        instruments: What shows flows and pressures, the meters' gains and zeros apart.
    """

    drive: Tensor
    back_pressure: Tensor
    level: Tensor
    commands: tuple[str, ...]
    grid: Grid
    numbers: Mapping[str, tuple[str, int | None]]
    instruments: Instruments = field(default_factory=Instruments)

    play_start = None  # plays begin in their middle

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> Self:
        """A copy in which a number is f(number); one that is not there yet counts as zero."""
        if name not in self.numbers:
            raise ValueError(f"no number {name!r}{did_you_mean(name, list(self.numbers))}")
        where, index = self.numbers[name]
        values: Tensor | None = getattr(self, where)
        values = _ZERO if values is None else values
        if index is None:
            changed = change(values)
        else:
            parts = list(values.unbind())
            parts[index] = change(parts[index])
            changed = torch.stack(parts)
        fields: dict[str, Any] = {where: changed}
        return dataclasses.replace(self, **fields)

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> Self:
        """A copy in which some commands are f(commands (width, num_samples), grid).

        Names are those of commands, or ``inlet_1`` for what drives the first inlet alone.
        """
        num_inlets = self.drive.shape[1]
        which = [i for i in range(len(self.commands)) if self._is_among(names, i)]
        told = torch.cat([self.drive, self.back_pressure], 1)[self.level]
        given = change_rows(told.mT, which, change, self.grid).mT
        _, first, level = np.unique(
            given.detach().numpy(), axis=0, return_index=True, return_inverse=True
        )
        levels = given[torch.from_numpy(first)]
        return dataclasses.replace(
            self,
            drive=levels[:, :num_inlets],
            back_pressure=levels[:, num_inlets:],
            level=torch.from_numpy(level.reshape(-1)),
        )

    def _is_among(self, names: tuple[str, ...], column: int) -> bool:
        """Whether a column of the commands is named; without names all that have a command are."""
        command = self.commands[column]
        if not names:
            return bool(command)
        is_inlet = column < self.drive.shape[1] and f"inlet_{column + 1}" in names
        return is_inlet or command in names

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Self:
        """A copy in which some channels are f(channels (width, num_samples), grid)."""
        instruments = self.instruments.with_reading(channels, change)
        return dataclasses.replace(self, instruments=instruments)

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Self:
        """A copy in which some channels show what was ``delay`` ago [s]."""
        return dataclasses.replace(self, instruments=self.instruments.with_clock(channels, delay))

    def show(self, levels: Tensor) -> Tensor:
        """What instruments say at every sample, (num_samples, num_channels).

        Args:
            levels: What meters show at each level, (num_levels, num_channels).
        """
        return self.instruments.read_late(levels[self.level], self.grid)


def number_places(
    single: tuple[str, ...], vectors: Mapping[str, tuple[str, int]]
) -> dict[str, tuple[str, int | None]]:
    """Places of the numbers of a scene: "leak", and "narrowing_1" for the first of several.

    Args:
        single: Fields that are a number.
        vectors: Field, and how many numbers it holds, by what these are called before their number.
    """
    found: dict[str, tuple[str, int | None]] = {name: (name, None) for name in single}
    for called, (where, count) in vectors.items():
        found |= {f"{called}_{i + 1}": (where, i) for i in range(count)}
    return found


__all__ = ["SteadyScene", "number_places"]
