"""Causes between a command and the actuators of an outside simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from diffsim.causes import signals
from diffsim.causes.commands import command_causes
from diffsim.causes.readings import spell_plainly
from diffsim.causes.signals import SizedMap
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.outside.hooks import SHARE, Group
from diffsim.systems.outside.model import OutsideScene


def command_effects(group: Group, held: bool) -> list[Effect]:
    """Causes on a group of commands.

    Args:
        group: Commands that go the same way.
        held: Commands are held from sample to sample; else straight lines join the samples.
    """
    end = f"_of_{plain(group.name)}" if group.name else ""
    # the simulator hears samples only: a delay must not smooth them, as straight lines would
    late = partial(signals.held_delayed, signed=False) if held else signals.smoothly_delayed
    found = []
    for model, change in command_causes(group.reach, SHARE, held=held, one_sided=group.one_sided):
        if model.name == "delay":
            model, change = replace(model, signed=False), late
        apply = partial(_commanded, names=group.columns, change=change)
        if model.name == "backlash":
            apply = partial(_played, names=group.columns)
        masks = tuple(m + end for m in model.masks)
        found.append(replace(model, name=model.name + end, masks=masks, apply=apply))
    return found


def _commanded(
    scene: OutsideScene, size: Tensor, run: Run, *, names: tuple[str, ...], change: SizedMap
) -> OutsideScene:
    now = size.detach()[0]
    if now == 0.0:
        return scene
    return scene.with_command(names, lambda u, grid: change(u, grid, now))


def _played(scene: OutsideScene, size: Tensor, run: Run, *, names: tuple[str, ...]) -> OutsideScene:
    """Commands behind a play, from where they are in it at the start."""
    now, start = size.detach()[0], scene.play_start
    if now == 0.0:
        return scene
    return scene.with_command(names, lambda u, grid: signals.with_play(u, grid, now, start))
