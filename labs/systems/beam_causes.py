"""Causes for the laboratory's beam, their sizes in the laboratory's units.

Drag per volume instead of per surface, a backlash by its full width, a tilt of one component, and
stiffening by the strain of a place instead of the body's mean: otherwise a right size would be
counted as wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from diffsim.causes import CommandGroup, command_cause, rows
from diffsim.causes.catalogue import rows_in_order
from diffsim.causes.needs import needs_command
from diffsim.causes.ports import on_numbers, on_readings
from diffsim.causes.readings import SENSOR
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.soft_body import forces, material
from diffsim.systems.soft_body.causes import FUNCTIONS, SOFT_BODY
from diffsim.systems.soft_body.scene import SoftScene

# Bending: the mean of strain^4 over the section is 9/5 of the square of the mean of strain^2.
STRAIN4 = 9.0 / 5.0
TYPICAL_LOSS = 0.1  # of the largest tension
SLIP_SPEED = 2e-3  # a twentieth of what the tip does [m/s]
_TENSION = CommandGroup((), {"reach": 1.0, "width": 1.0, "rate": 1.0})
_BACKLASH = command_cause("backlash", _TENSION)


def body_cause(
    name: str, scales: Mapping[str, float] | None = None, apply: Apply | None = None, **own: Any
) -> Effect:
    """A cause in a soft body, around it or in the cameras, for models that no study describes.

    Args:
        name: Name of its row.
        scales: Usual magnitudes that the row may use.
        apply: How it acts; None: as ``FUNCTIONS`` or the row says.
        **own: Fields of the effect that differ, as for :meth:`diffsim.causes.Row.effect`.
    """
    row = next(row for _, row in rows_in_order(SOFT_BODY) if row.name == name)
    acts = apply or FUNCTIONS.get(name) or on_numbers(row)
    return row.effect(acts, scales, system=SOFT_BODY, **{"unit": row.unit.replace("F", "N"), **own})


def _volumes(scene: SoftScene) -> Tensor:
    return scene.body.nodal_volume


def _stiffening(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return material.stiffen_by_strain(scene, STRAIN4 * size, run)


def _backlash(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    made: SoftScene = _BACKLASH.apply(scene, 0.5 * size, run)
    return made


def _sideways_tilt(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    sideways = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return scene.with_parameter("gravity", scene.number("gravity") + size[0] * sideways)


def _tip_scale(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    first = torch.eye(len(scene.axes), dtype=torch.float64)[0]
    return scene.with_reading((), lambda y, grid: y * (1.0 + size[0] * first)[:, None])


def _tension_limit(scene: SoftScene, size: Tensor, run: Run, *, largest_N: float) -> SoftScene:
    return scene.with_command(
        (), lambda u, grid: torch.minimum(u, (1.0 - size[0]) * largest_N * torch.ones_like(u))
    )


def _needs_tension(study: Study, *, largest_N: float) -> str | None:
    top = max(float(run.command["tendon_N"].max()) for run in study.fit_runs)
    if top < (1.0 - TYPICAL_LOSS) * largest_N:
        return f"a tension near {largest_N:g} N; the largest that was commanded is {top:g} N"
    return needs_command(study)


VOLUME_DRAG = replace(
    body_cause("linear_drag"),
    name="volume_drag",
    form="Force per volume -size v.",
    unit="N s/m^4",
    typical=1e3,
    apply=partial(forces.drag_nodes, shares=_volumes, quadratic=False),
)
QUADRATIC_VOLUME_DRAG = replace(
    body_cause("quadratic_drag"),
    name="quadratic_volume_drag",
    form="Force per volume -size |v| v.",
    unit="N s^2/m^5",
    typical=1.5e4,
    apply=partial(forces.drag_nodes, shares=_volumes, quadratic=True),
)
STIFFENING = replace(
    body_cause("stiffening"),
    form="Stress E (1 + size strain^2) strain, under bending of one curvature.",
    typical=400.0,
    apply=_stiffening,
)
SIDEWAYS_TILT = Effect(
    name="tilt",
    form="A constant acceleration sideways.",
    family="gravity",
    kind="environment",
    unit="m/s^2",
    typical=0.1,
    also_looks_like=("a bent rest shape",),
    apply=_sideways_tilt,
)
DRY_FRICTION = replace(
    body_cause("dry_friction"),
    form="Coulomb friction -size tanh(v / v_s) at the tip.",
    typical=5e-4,
    apply=partial(forces.rub_nodes, slip_speed=SLIP_SPEED),
)
ADDED_MASS = replace(
    body_cause("added_mass"),
    typical=0.05,
)
LOSS_FACTOR = replace(
    body_cause("loss_factor"),
    typical=0.03,
)
DELAY = replace(
    command_cause("delay", _TENSION),
    form="The tension comes size later; it cannot be early.",
    typical=0.006,
    signed=False,
)
LAG = replace(
    command_cause("lag", _TENSION),
    typical=0.006,
)
TENSION_DEAD_BAND = replace(
    command_cause("dead_band", _TENSION),
    name="tension_dead_band",
    unit="N",
    typical=0.04,
)
TENSION_BACKLASH = replace(
    _BACKLASH,
    name="tension_backlash",
    form="Play of the tension, full width size.",
    unit="N",
    typical=0.05,
    apply=_backlash,
)
TEMPERATURE_DRIFT = replace(
    body_cause("temperature_drift"),
    typical=0.003,
)
SENSOR_SCALE = replace(
    rows(SENSOR)["sensor_scale"].effect(on_readings(rows(SENSOR)["sensor_scale"], ())),
    typical=0.06,
)
TIP_SCALE = Effect(
    name="tip_scale",
    form="The tip's channel is larger by the share size; the other is not.",
    family="sensor",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.06,
    also_looks_like=("lens", "slipped marker", "mode shape"),
    apply=_tip_scale,
)


def tension_limit(largest_N: float) -> Effect:
    """The effect of a drive that can pull ``largest_N`` [N]."""
    return Effect(
        name="saturation",
        form="The drive gives (1 - size) of its largest tension, and no more.",
        family="shape",
        kind="actuator",
        unit="-",
        shown_unit="%",
        typical=TYPICAL_LOSS,
        signed=False,
        smooth=False,
        also_looks_like=("gain, if all commands reach as high", "stiffening"),
        needs=partial(_needs_tension, largest_N=largest_N),
        apply=partial(_tension_limit, largest_N=largest_N),
    )


def causes(largest_N: float) -> tuple[Effect, ...]:
    """Candidate causes of the laboratory's bar.

    Left out: what is a base parameter (stiffness-proportional damping, placement), what the
    laboratory has no channels for (tilt and lens of cameras), and a current without known drag.

    Args:
        largest_N: Largest force that the drive can pull with [N].
    """
    return (
        LOSS_FACTOR,
        STIFFENING,
        body_cause("stiffness_loss"),
        TEMPERATURE_DRIFT,
        VOLUME_DRAG,
        QUADRATIC_VOLUME_DRAG,
        ADDED_MASS,
        SIDEWAYS_TILT,
        DRY_FRICTION,
        command_cause("quantization", CommandGroup((), {"reach": largest_N}, unit="N")),
        DELAY,
        LAG,
        TENSION_DEAD_BAND,
        TENSION_BACKLASH,
        tension_limit(largest_N),
        SENSOR_SCALE,
        TIP_SCALE,
    )
