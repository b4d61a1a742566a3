"""Causes in the instruments that show the channels of an outside simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems import signals
from diffsim.systems.outside.hooks import SHARE, Group, plain
from diffsim.systems.outside.model import OutsideScene, on_even_times

OutputChange = Callable[[Tensor, Tensor, Tensor], Tensor]  # channels, times, size -> channels


def output_effects(group: Group, idx: tuple[int, ...], may_be_late: bool) -> list[Effect]:
    """Causes in one instrument.

    Args:
        group: Channels of the instrument.
        idx: Their indices among all channels.
        may_be_late: Whether lateness can be told from that of a command.
    """
    end, unit, size = f"_of_{plain(group.name)}", group.unit, SHARE * group.reach
    several = tuple(plain(c) for c in group.columns) if len(group.columns) > 1 else ("size",)

    def effect(
        name: str,
        family: str,
        unit: str,
        typical: float,
        form: str,
        change: OutputChange,
        looks_like: tuple[str, ...] = (),
        signed: bool = True,
        components: tuple[str, ...] = ("size",),
    ) -> Effect:
        return Effect(
            name=name + end,
            form=form,
            family=family,
            kind="sensor",
            unit=unit,
            typical=typical,
            signed=signed,
            components=components,
            also_looks_like=looks_like,
            apply=partial(_shown, channels=idx, change=change),
        )

    made = [
        effect(
            "sensor_scale",
            "sensor",
            "-",
            SHARE,
            "It shows (1 + size) times the true value.",
            lambda y, t, k: y * (1.0 + k),
            ("calibration of the sensor", "a length of the mechanism"),
        ),
        effect(
            "sensor_offset",
            "zero",
            unit,
            size,
            "It shows size more than the true value.",
            lambda y, t, k: y + k,
            ("zero of the sensor",),
            components=several,
        ),
        effect(
            "sensor_drift",
            "drift",
            unit,
            size,
            "It shows more and more: size at the end of the longest run.",
            lambda y, t, k: y + k * t[:, None] / group.longest_s,
            ("warming of the sensor",),
            components=several,
        ),
    ]
    if may_be_late:
        made += [
            effect(
                "sensor_delay",
                "timing",
                "s",
                0.02,
                "It shows what was size ago.",
                lambda y, t, k: _late(signals.delayed, y, t, k),
                ("clock of the recorder",),
                signed=False,
            ),
            effect(
                "sensor_lag",
                "timing",
                "s",
                0.02,
                "First-order low-pass filter with the time constant size.",
                lambda y, t, k: _late(signals.lagged, y, t, k),
                ("filter of the recorder",),
                signed=False,
            ),
        ]
    return made


def _shown(
    scene: OutsideScene, size: Tensor, run: Run, *, channels: tuple[int, ...], change: OutputChange
) -> OutsideScene:
    now = size.detach()
    return scene.with_output(channels, lambda y, t: change(y, t, now)) if now.any() else scene


def _late(
    change: Callable[[Tensor, float, Tensor], Tensor], y: Tensor, times: Tensor, size: Tensor
) -> Tensor:
    return on_even_times(y, times.numpy(), lambda u, dt: change(u, dt, size[0]))
