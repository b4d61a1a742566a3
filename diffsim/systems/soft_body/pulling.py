"""Causes between a command and what it pulls: how far, how fast, and from where on."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.actuator import needs_command
from diffsim.systems.signals import straight
from diffsim.systems.soft_body.scene import SoftScene

_NO_LIMIT = 1e-12


def rate_limited(u: Tensor, dt: float, slowness: Tensor) -> Tensor:
    """Command (num_samples, width) that is followed at most at the rate 1 / slowness.

    Args:
        u: Command at every sample.
        dt: Time between two samples [s].
        slowness: Time per unit of the command, () [s/command]; 0: the command itself.
    """
    most = dt / slowness.clamp(min=_NO_LIMIT)
    now, out = u[0], [u[0]]
    for target in u[1:]:
        now = now + torch.minimum(torch.maximum(target - now, -most), most)
        out.append(now)
    return torch.where(slowness > 0.0, torch.stack(out), u)


def _rate_limit(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_command(lambda u, dt: rate_limited(u, dt, size[0]))


def _slack(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_command(
        lambda u, dt: torch.where(size[0] > 0.0, (u - size[0]).clamp(min=0.0), u)
    )


def _gain(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_command(lambda u, dt: u * (1.0 + size[0]))


def _pull(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    def changed(u: Tensor, dt: float) -> Tensor:
        times = dt * torch.arange(len(u), dtype=u.dtype)
        return u + straight(size[:, None], spacing, times)

    return scene.with_command(changed)


RATE_LIMIT = Effect(
    name="rate_limit",
    form="The actuator moves no faster than 1 / size.",
    family="timing",
    kind="actuator",
    unit="s/command",
    typical=1.0,
    signed=False,
    smooth=False,
    masks=("tendon_slack", "lag"),
    also_looks_like=("lag, at one amplitude", "weak battery", "a motor at its limit"),
    needs=needs_command,
    apply=_rate_limit,
)
TENDON_SLACK = Effect(
    name="tendon_slack",
    form="Nothing is pulled until the command exceeds size, then that much less.",
    family="shape",
    kind="actuator",
    unit="command",
    typical=0.01,
    signed=False,
    smooth=False,
    masks=("rate_limit", "lag"),
    also_looks_like=("a tendon that is too long", "dead band", "zero of the command"),
    needs=needs_command,
    apply=_slack,
)
COMMAND_GAIN = Effect(
    name="command_gain",
    form="The actuators move (1 + size) times as far as commanded.",
    family="gain",
    kind="actuator",
    unit="-",
    typical=0.2,
    also_looks_like=("radius of the pulley", "scale of the camera", "stretch of the tendons"),
    needs=needs_command,
    apply=_gain,
)


def in_words(effect: Effect, unit: str) -> Effect:
    """A cause that says its size in the command's unit.

    Args:
        effect: One of this file's.
        unit: SI unit of the command.
    """
    factor, shown = (1e3, "mm") if unit == "m" else (1.0, unit.replace("-", "of the command"))
    if effect.name == "rate_limit":
        return replace(
            effect,
            words=lambda s: f"a speed limit near {factor / s:.3g} {shown}/s" if s else "none",
        )
    if effect.name == "tendon_slack":
        return replace(effect, words=lambda s: f"{factor * s:.2g} {shown} of slack")
    return effect


PULLING: tuple[Effect, ...] = (COMMAND_GAIN, RATE_LIMIT, TENDON_SLACK)


def unknown_pull(num_knots: int, spacing: float) -> Effect:
    """A change of the command that nothing explains, knots in time every ``spacing`` [s]."""
    return Effect(
        name="unknown_pull",
        family="unknown",
        kind="actuator",
        unit="command",
        typical=0.01,
        apply=partial(_pull, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(num_knots)),
    )
