"""A generic smooth pressure in the branches of a channel network: a cause without a form."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.interpolation import straight
from diffsim.causes.signals import Grid
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.flow_network.network_balance import NetworkScene


def _with_pressure(
    scene: NetworkScene, size: Tensor, run: Run, *, commands: tuple[str, ...], spacing: float
) -> NetworkScene:
    """Pressure drop in every branch [Pa], straight lines between knots of time.

    Components: knots fastest, then the branches.
    """
    time = torch.from_numpy(run.time_s - run.time_s[0])
    drop = straight(size.reshape(len(commands), -1).T, spacing, time).T

    def add(pressures: Tensor, grid: Grid) -> Tensor:
        return pressures + drop

    return scene.changed(is_in_time=True).with_command(commands, add)


def unknown_pressure(num_knots: int, until_s: float, commands: Sequence[str]) -> Effect:
    """The effect on the commands of pressure, with ``num_knots`` >= 2 knots from 0 to ``until_s``
    [s] for every outlet."""
    return Effect(
        name="unknown_pressure",
        form="Pressure drop in every branch [Pa], straight lines between knots of time.",
        family="unknown",
        kind="force",
        unit="Pa",
        typical=1.0,
        also_looks_like=("anything",),
        apply=partial(_with_pressure, commands=tuple(commands), spacing=until_s / (num_knots - 1)),
        components=tuple(
            f"outlet_{i + 1}_{k}" for i in range(len(commands)) for k in range(num_knots)
        ),
    )
