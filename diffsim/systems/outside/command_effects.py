"""Causes between a command and the actuators of an outside simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.actuator import command_causes
from diffsim.systems.grid import SizedMap
from diffsim.systems.outside.hooks import SHARE, Group, plain
from diffsim.systems.outside.model import OutsideScene


def command_effects(group: Group, held: bool) -> list[Effect]:
    """Causes on a group of commands.

    Args:
        group: Commands that go the same way.
        held: Commands are held from sample to sample; else straight lines join the samples.
    """
    end = f"_of_{plain(group.name)}" if group.name else ""
    return [
        replace(
            model,
            name=model.name + end,
            masks=tuple(m + end for m in model.masks),
            apply=partial(_commanded, names=group.columns, change=change),
        )
        for model, change in command_causes(
            group.reach, SHARE, held=held, one_sided=group.one_sided
        )
    ]


def _commanded(
    scene: OutsideScene, size: Tensor, run: Run, *, names: tuple[str, ...], change: SizedMap
) -> OutsideScene:
    now = size.detach()[0]
    if now == 0.0:
        return scene
    return scene.with_command(names, lambda u, grid: change(u, grid, now))
