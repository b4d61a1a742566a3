"""Causes of error of a flow device (design table C): forms, aliases, and what separates them."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.flow_network.device import ChannelDevice
from diffsim.systems.flow_network.model import StokesScene, with_added
from diffsim.systems.flow_network.network import NetworkDevice
from diffsim.systems.flow_network.network_model import NetworkScene


def _slip(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, slip_length=size[0])


def _wall_offset(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, wall_offset=size[0])


def _viscosity(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return dataclasses.replace(scene, viscosity=scene.viscosity * (1.0 + size[0]))


def _temperature_gradient(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, viscosity_gradient=size[0])


def _compliance(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, compliance=size[0])


def _thinning(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, thinning=size[0])


def _inertia(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, density=size[0])


def _leak(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, leak=size[0])


def _pressure_scale(scene: NetworkScene, size: Tensor, run: Run) -> NetworkScene:
    is_pressure = torch.ones_like(scene.channel_gain)
    is_pressure[: scene.back_pressure.shape[1]] = 0.0
    gain = scene.channel_gain * (1.0 + size[0] * is_pressure)
    return dataclasses.replace(scene, channel_gain=gain)


def _entrance_loss(scene: NetworkScene, size: Tensor, run: Run) -> NetworkScene:
    return with_added(scene, entrance_loss=size[0])


def _skewed_inlet(scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
    return with_added(scene, inlet_skew=size[0])


def _pump_gain(scene: StokesScene, size: Tensor, run: Run, *, inlet: int) -> StokesScene:
    return dataclasses.replace(scene, drive=_scaled(scene.drive, inlet, size[0]))


def _meter_gain(scene: StokesScene, size: Tensor, run: Run, *, outlet: int) -> StokesScene:
    gain = _scaled(scene.channel_gain[None], outlet, size[0])[0]
    return dataclasses.replace(scene, channel_gain=gain)


def _blocked_branch(scene: StokesScene, size: Tensor, run: Run, *, outlet: int) -> StokesScene:
    return scene.narrowed(outlet, size[0])


def _pressure_offset(scene: StokesScene, size: Tensor, run: Run, *, outlet: int) -> StokesScene:
    one = _one_hot(len(scene.outlet_pressure), outlet)
    return with_added(scene, outlet_pressure=size[0] * one)


def _needs_pressure(study: Study) -> str | None:
    """Only a pressure identifies it where pumps prescribe the flow."""
    known = _measures(study, "pressure") or _commands_pressure(study)
    return None if known else "a pressure channel"


def _needs_levels(study: Study) -> str | None:
    """Only several drive levels separate it from a constant."""
    levels = {round(float(v), 15) for r in study.runs for c in r.command.values() for v in c}
    return None if len(levels) > 1 else "two drive levels or more"


def _needs_flow_and_pressure(study: Study) -> str | None:
    if any(name.startswith("pressure_in") for run in study.runs for name in run.command):
        return "runs driven by flow: a regulated pressure makes up for a leak ahead of it"
    return _needs_pressure(study)


def _needs_flow(study: Study) -> str | None:
    if any(name.startswith("pressure_in") for run in study.runs for name in run.command):
        return "runs driven by flow: an open inlet finds its own profile"
    return None


SLIP = Effect(
    name="slip",
    form="Navier slip at the walls; to first order the same as walls further out by its length.",
    family="wall",
    kind="environment",
    unit="m",
    typical=4e-05,
    signed=False,
    also_looks_like=("wall_offset", "gas film", "hydrophobic coating"),
    apply=_slip,
)
WALL_OFFSET = Effect(
    name="wall_offset",
    form="All walls further out: channels w + 2 delta wide.",
    family="wall",
    kind="environment",
    unit="m",
    typical=4e-05,
    smooth=False,
    also_looks_like=("slip", "over-etching", "print shrinkage", "coating", "coarse mesh"),
    apply=_wall_offset,
)
VISCOSITY = Effect(
    name="viscosity",
    form="Viscosity (1 + size) times as large.",
    family="fluid",
    kind="material",
    unit="-",
    shown_unit="%",
    typical=0.1,
    also_looks_like=("temperature", "concentration", "pressure sensor's gain"),
    needs=_needs_pressure,
    apply=_viscosity,
)
TEMPERATURE_GRADIENT = Effect(
    name="temperature_gradient",
    form="Viscosity rising across the device in y, by ``size`` of its value over the box's height.",
    family="fluid",
    kind="environment",
    unit="-",
    typical=0.2,
    also_looks_like=("concentration gradient", "one-sided heating"),
    apply=_temperature_gradient,
)
COMPLIANCE = Effect(
    name="compliance",
    form="Channels w (1 + c p) wide under the local pressure p.",
    family="drive_dependent",
    kind="material",
    unit="1/Pa",
    typical=0.0002,
    signed=False,
    smooth=False,
    also_looks_like=("thinning", "fluid_inertia", "soft walls (PDMS)", "soft tubing"),
    needs=_needs_levels,
    apply=_compliance,
)
THINNING = Effect(
    name="thinning",
    form="Viscosity times (1 + (rate / nominal rate)^2)^(-size / 2).",
    family="drive_dependent",
    kind="material",
    unit="-",
    typical=0.1,
    also_looks_like=("compliance", "polymer solution", "viscous heating"),
    needs=_needs_levels,
    apply=_thinning,
)
FLUID_INERTIA = Effect(
    name="fluid_inertia",
    form="The fluid's inertia, rho (v . grad) v; quadratic in the drive at first.",
    family="drive_dependent",
    kind="environment",
    unit="kg/m^3",
    typical=1000.0,
    signed=False,
    also_looks_like=("compliance", "entrance losses"),
    needs=_needs_levels,
    apply=_inertia,
)
LEAK_PER_DEPTH = Effect(
    name="leak_per_depth",
    form="Flow lost between pumps and inlets in proportion to the pressure there.",
    family="lost_flow",
    kind="actuator",
    unit="m^2/(s Pa)",
    typical=2e-08,
    signed=False,
    also_looks_like=("pump_gain", "loose fitting", "porous wall"),
    needs=_needs_flow_and_pressure,
    apply=_leak,
)
LEAK = replace(
    LEAK_PER_DEPTH,
    name="leak",
    form="Flow lost at the pump in proportion to the pressure there.",
    unit="m^3/(s Pa)",
    typical=1e-11,
    smooth=True,
)
PRESSURE_SCALE = Effect(
    name="pressure_scale",
    form="All pressure sensors show (1 + size) times the pressure.",
    family="meter",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.05,
    also_looks_like=("viscosity", "calibration of the pressure sensors"),
    needs=_needs_pressure,
    apply=_pressure_scale,
)
ENTRANCE_LOSS = Effect(
    name="entrance_loss",
    form="A loss of size rho u^2 / 2 at the entrance of every branch, u its mean speed.",
    family="drive_dependent",
    kind="environment",
    unit="-",
    typical=3.0,
    signed=False,
    also_looks_like=("fluid_inertia", "compliance", "sharp edges"),
    needs=_needs_levels,
    apply=_entrance_loss,
)
SKEWED_INLET = Effect(
    name="skewed_inlet",
    form="Inflow leaning to one side: u (1 + size (y - y0) / (w / 2)), the flow kept.",
    family="inlet",
    kind="actuator",
    unit="-",
    typical=0.5,
    also_looks_like=("bent supply tube", "misaligned connector"),
    needs=_needs_flow,
    apply=_skewed_inlet,
)


def pump_gain(inlet: int) -> Effect:
    """The effect of one inlet, counted from 0; named pump_gain_1 for the first."""
    return Effect(
        name=f"pump_gain_{inlet + 1}",
        form="One pump (or regulator) delivers (1 + size) times its command.",
        family="lost_flow",
        kind="actuator",
        unit="-",
        shown_unit="%",
        typical=0.05,
        also_looks_like=("leak", "pump calibration", "all meters' gains"),
        apply=partial(_pump_gain, inlet=inlet),
    )


def meter_gain(outlet: int) -> Effect:
    """The effect of one outlet, counted from 0; named meter_gain_1 for the first."""
    return Effect(
        name=f"meter_gain_{outlet + 1}",
        form="One outlet's flow meter shows (1 + size) times its flow.",
        family="meter",
        kind="sensor",
        unit="-",
        shown_unit="%",
        typical=0.05,
        also_looks_like=("blocked_branch", "meter calibration"),
        apply=partial(_meter_gain, outlet=outlet),
    )


def blocked_branch(outlet: int) -> Effect:
    """The effect of one outlet, counted from 0; named blocked_branch_1 for the first."""
    return Effect(
        name=f"blocked_branch_{outlet + 1}",
        form="The middle of one branch narrower by ``size`` of its width.",
        family="blockage",
        kind="environment",
        unit="-",
        shown_unit="%",
        typical=0.15,
        signed=False,
        smooth=False,
        also_looks_like=("bubble", "debris", "meter_gain", "one channel printed narrow"),
        apply=partial(_blocked_branch, outlet=outlet),
    )


def pressure_offset(outlet: int) -> Effect:
    """The effect of one outlet, counted from 0; named pressure_offset_1 for the first."""
    return Effect(
        name=f"pressure_offset_{outlet + 1}",
        form="A constant pressure beyond one outlet, largest effect at low drive.",
        family="blockage",
        kind="environment",
        unit="Pa",
        typical=10.0,
        also_looks_like=(
            "bubble held by capillarity",
            "height of the outlet tube",
            "blocked_branch",
        ),
        needs=_needs_levels,
        apply=partial(_pressure_offset, outlet=outlet),
    )


def stokes_library(device: ChannelDevice | None = None) -> tuple[Effect, ...]:
    """All candidate effects of a device; those with a place once per place.

    Args:
        device: Device whose candidates are listed; None: ``ChannelDevice()``.
    """
    device = ChannelDevice() if device is None else device
    outlets, inlets = range(len(device.outlets)), range(len(device.inlets))
    return (
        SLIP,
        WALL_OFFSET,
        VISCOSITY,
        TEMPERATURE_GRADIENT,
        COMPLIANCE,
        THINNING,
        FLUID_INERTIA,
        LEAK_PER_DEPTH,
        SKEWED_INLET,
        *(pump_gain(i) for i in inlets),
        *(meter_gain(i) for i in outlets),
        *(blocked_branch(i) for i in outlets),
        *(pressure_offset(i) for i in outlets),
    )


def network_library(device: NetworkDevice) -> tuple[Effect, ...]:
    """All candidate effects of a channel network; sizes in flows, not flows per depth.

    Args:
        device: Typical sizes of walls follow from its narrowest channel.
    """
    narrowest = min(s.width for s in device.segments)
    outlets = range(len(device.outlets))
    return (
        _of(SLIP, 0.01 * narrowest),
        _of(WALL_OFFSET, 0.01 * narrowest),
        VISCOSITY,
        TEMPERATURE_GRADIENT,
        _of(COMPLIANCE, 5e-4),
        THINNING,
        ENTRANCE_LOSS,
        LEAK,
        PRESSURE_SCALE,
        pump_gain(0),
        *(meter_gain(i) for i in outlets),
        *(_of(blocked_branch(i), 0.1) for i in outlets),
        *(_of(pressure_offset(i), 5.0) for i in outlets),
    )


def _of(effect: Effect, typical: float) -> Effect:
    """The effect on a device where another size is typical. Networks interpolate between shapes of
    the walls, so that there all effects are smooth."""
    return replace(effect, typical=typical, smooth=True)


def _measures(study: Study, kind: str) -> bool:
    return any(channel.kind == kind for channel in study.channels)


def _commands_pressure(study: Study) -> bool:
    """A known pressure drives flows that identify the viscosity."""
    commands = [c for run in study.fit_runs for n, c in run.command.items() if n.endswith("_Pa")]
    return any(bool((c != 0.0).any()) for c in commands)


def _one_hot(count: int, index: int) -> Tensor:
    return torch.eye(count, dtype=torch.float64)[index]


def _scaled(values: Tensor, column: int, size: Tensor) -> Tensor:
    """Values (n, count) with one column times 1 + size."""
    return values * (1.0 + size * _one_hot(values.shape[1], column))
