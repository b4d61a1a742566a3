"""Causes in the instruments that show the channels of an outside simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from diffsim.causes.readings import spell_plainly, sensor_causes
from diffsim.causes.signals import SizedMap, with_play
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.outside.hooks import SHARE, Group
from diffsim.systems.outside.model import OutsideScene


def output_effects(group: Group, idx: tuple[int, ...], may_be_late: bool) -> list[Effect]:
    """Causes in one instrument.

    Args:
        group: Channels of the instrument.
        idx: Their indices among all channels.
        may_be_late: Whether lateness can be told from that of a command.
    """
    names = [plain(c) for c in group.columns]
    return [
        replace(
            model,
            name=f"{model.name}_of_{plain(group.name)}",
            apply=partial(_played, channels=idx)
            if model.name == "sensor_backlash"
            else partial(_shown, channels=idx, change=change),
        )
        for model, change in sensor_causes(names, group.unit, SHARE * group.reach, group.longest_s)
        if model.name in group.causes and (may_be_late or model.family != "timing")
    ]


def _shown(
    scene: OutsideScene, size: Tensor, run: Run, *, channels: tuple[int, ...], change: SizedMap
) -> OutsideScene:
    now = size.detach()
    return scene.with_output(channels, lambda y, grid: change(y, grid, now)) if now.any() else scene


def _played(
    scene: OutsideScene, size: Tensor, run: Run, *, channels: tuple[int, ...]
) -> OutsideScene:
    """Channels behind a play, from where they are in it at the start."""
    now, start = size.detach(), scene.play_start
    if not now.any():
        return scene
    return scene.with_output(channels, lambda y, grid: with_play(y, grid, now, start))
