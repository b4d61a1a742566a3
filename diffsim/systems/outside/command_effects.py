"""Causes between a command and the actuators of an outside simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems import actuator, signals
from diffsim.systems.outside.hooks import SHARE, Group, plain
from diffsim.systems.outside.model import OutsideScene

CommandChange = Callable[[Tensor, float, Tensor], Tensor]  # command, dt, size -> command


def command_effects(group: Group, held: bool) -> list[Effect]:
    """Causes on a group of commands.

    Args:
        group: Commands that go the same way.
        held: Commands are held from sample to sample; else straight lines join the samples.
    """
    reach = group.reach
    # of one-sided commands a dead band is slack
    still = _slack() if group.one_sided else actuator.DEAD_BAND
    still = replace(still, typical=SHARE * reach)
    lag, delay = (
        (actuator.HELD_LAG, actuator.HELD_DELAY)
        if held
        else (actuator.LAG, replace(actuator.COMMAND_DELAY, signed=False))
    )
    delayed, lagged = (
        (signals.held_delayed, signals.held_lagged) if held else (signals.delayed, signals.lagged)
    )
    changes: list[tuple[Effect, CommandChange]] = [
        (lag, lambda u, dt, k: lagged(u, dt, k)),
        (delay, lambda u, dt, k: delayed(u, dt, k)),
        (still, lambda u, dt, k: signals.dead_band(u, k)),
        (
            replace(actuator.BACKLASH, typical=SHARE * reach),
            lambda u, dt, k: signals.backlash(u, k),
        ),
        (
            replace(
                actuator.SATURATION,
                form=f"The command is limited to (1 - size) times {reach:.4g}, the largest.",
            ),
            lambda u, dt, k: u.clamp(-(1.0 - k) * reach, (1.0 - k) * reach),
        ),
        (_gain(), lambda u, dt, k: u * (1.0 + k)),
        (_offset(reach), lambda u, dt, k: u + k),
        (_rate_limit(reach), lambda u, dt, k: rate_limited(u, dt, k)),
    ]
    end = f"_of_{plain(group.name)}" if group.name else ""
    return [
        replace(e, name=e.name + end, apply=partial(_commanded, names=group.columns, change=change))
        for e, change in changes
    ]


def _commanded(
    scene: OutsideScene, size: Tensor, run: Run, *, names: tuple[str, ...], change: CommandChange
) -> OutsideScene:
    now = size.detach()[0]
    return scene.with_command(names, lambda u, dt: change(u, dt, now)) if now != 0.0 else scene


def rate_limited(u: Tensor, dt: float, slowness: Tensor) -> Tensor:
    """A command (num_samples, width) followed no faster than 1 / slowness [per s]."""
    most = dt / slowness
    now, out = u[0], [u[0]]
    for target in u[1:]:
        now = now + torch.minimum(torch.maximum(target - now, -most), most)
        out.append(now)
    return torch.stack(out)


def unchanged(scene: Any, size: Tensor, run: Run) -> Any:
    """The scene itself: place holder until an effect gets its group."""
    return scene


def _gain() -> Effect:
    return Effect(
        name="command_gain",
        form="The actuators get (1 + size) times the command.",
        family="gain",
        kind="actuator",
        unit="-",
        typical=0.1,
        also_looks_like=("scale of a driver", "mass or inertia, where no other force counts"),
        needs=actuator.needs_command,
        apply=unchanged,
    )


def _offset(reach: float) -> Effect:
    return Effect(
        name="command_offset",
        form="The actuators get size more than the command.",
        family="zero",
        kind="actuator",
        unit="command",
        typical=SHARE * reach,
        also_looks_like=("a constant force", "a tilted base"),
        needs=actuator.needs_command,
        apply=unchanged,
    )


def _slack() -> Effect:
    return Effect(
        name="slack",
        form="Nothing happens until the command exceeds size, then it acts less size.",
        family="shape",
        kind="actuator",
        unit="command",
        typical=1.0,
        signed=False,
        smooth=False,
        masks=("rate_limit",),
        also_looks_like=("dead band of a valve", "a loose tendon"),
        needs=actuator.needs_command,
        apply=unchanged,
    )


def _rate_limit(reach: float) -> Effect:
    return Effect(
        name="rate_limit",
        form="The command is followed no faster than 1 / size.",
        family="timing",
        kind="actuator",
        unit="s/command",
        typical=0.1 / reach,
        signed=False,
        smooth=False,
        also_looks_like=("lag, at one amplitude", "a weak supply"),
        needs=actuator.needs_command,
        apply=unchanged,
    )
