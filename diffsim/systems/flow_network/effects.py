"""Causes of error of a flow device (design table C): forms, aliases, and what tells them apart."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.flow_network.device import ChannelDevice
from diffsim.systems.flow_network.model import StokesScene, with_added
from diffsim.systems.flow_network.network import NetworkDevice
from diffsim.systems.flow_network.network_model import NetworkScene


class Slip(Effect):
    """Navier slip at the walls; to first order the same as walls further out by its length."""

    name, family, kind, unit = "slip", "wall", "environment", "m"
    typical, signed = 4e-5, False
    also_looks_like = ("wall_offset", "gas film", "hydrophobic coating")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, slip_length=size[0])


class WallOffset(Effect):
    """All walls further out: channels w + 2 delta wide."""

    name, family, kind, unit = "wall_offset", "wall", "environment", "m"
    typical = 4e-5
    smooth = False  # walls that pass nodes give the grid's flow kinks
    also_looks_like = ("slip", "over-etching", "print shrinkage", "coating", "coarse mesh")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, wall_offset=size[0])


class _NeedsPressure(Effect):
    """Only a pressure tells it where pumps prescribe the flow."""

    def needs(self, study: Study) -> str | None:
        known = _measures(study, "pressure") or _commands_pressure(study)
        return None if known else "a pressure channel"


class Viscosity(_NeedsPressure):
    """Viscosity (1 + size) times as large."""

    name, family, kind, unit = "viscosity", "fluid", "material", "-"
    typical = 0.1
    also_looks_like = ("temperature", "concentration", "pressure sensor's gain")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return dataclasses.replace(scene, viscosity=scene.viscosity * (1.0 + size[0]))


class TemperatureGradient(Effect):
    """Viscosity rising across the device in y, by ``size`` of its value over the box's height."""

    name, family, kind, unit = "temperature_gradient", "fluid", "environment", "-"
    typical = 0.2
    also_looks_like = ("concentration gradient", "one-sided heating")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, viscosity_gradient=size[0])


class _NeedsLevels(Effect):
    """Only several drive levels tell it from a constant."""

    def needs(self, study: Study) -> str | None:
        levels = {round(float(v), 15) for r in study.runs for c in r.command.values() for v in c}
        return None if len(levels) > 1 else "two drive levels or more"


class Compliance(_NeedsLevels):
    """Channels w (1 + c p) wide under the local pressure p."""

    name, family, kind, unit = "compliance", "drive_dependent", "material", "1/Pa"
    typical, signed = 2e-4, False
    smooth = False  # as for the wall offset
    also_looks_like = ("thinning", "inertia", "soft walls (PDMS)", "soft tubing")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, compliance=size[0])


class Thinning(_NeedsLevels):
    """Viscosity times (1 + (rate / nominal rate)^2)^(-size / 2): at high rates a power law of
    exponent 1 - size."""

    name, family, kind, unit = "thinning", "drive_dependent", "material", "-"
    typical = 0.1
    also_looks_like = ("compliance", "polymer solution", "viscous heating")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, thinning=size[0])


class Inertia(_NeedsLevels):
    """The fluid's inertia, rho (v . grad) v; quadratic in the drive at first."""

    name, family, kind, unit = "inertia", "drive_dependent", "environment", "kg/m^3"
    typical, signed = 1000.0, False
    also_looks_like = ("compliance", "entrance losses")

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, density=size[0])


class Leak(_NeedsPressure):
    """Flow lost between pumps and inlets in proportion to the pressure there."""

    name, family, kind, unit = "leak", "lost_flow", "actuator", "m^2/(s Pa)"
    typical, signed = 2e-8, False
    also_looks_like = ("pump_gain", "loose fitting", "porous wall")

    def needs(self, study: Study) -> str | None:
        if any(name.startswith("pressure_in") for run in study.runs for name in run.command):
            return "runs driven by flow: a regulated pressure makes up for a leak ahead of it"
        return super().needs(study)

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, leak=size[0])


class PumpGain(Effect):
    """One pump (or regulator) delivers (1 + size) times its command."""

    family, kind, unit = "lost_flow", "actuator", "-"
    typical = 0.05
    also_looks_like = ("leak", "pump calibration", "all meters' gains")

    def __init__(self, inlet: int):
        self.inlet, self.name = inlet, f"pump_gain_{inlet + 1}"  # type: ignore[misc]

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return dataclasses.replace(scene, drive=_scaled(scene.drive, self.inlet, size[0]))


class MeterGain(Effect):
    """One outlet's flow meter shows (1 + size) times its flow."""

    family, kind, unit = "meter", "sensor", "-"
    typical = 0.05
    also_looks_like = ("blocked_branch", "meter calibration")

    def __init__(self, outlet: int):
        self.outlet, self.name = outlet, f"meter_gain_{outlet + 1}"  # type: ignore[misc]

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        gain = _scaled(scene.channel_gain[None], self.outlet, size[0])[0]
        return dataclasses.replace(scene, channel_gain=gain)


class PressureScale(_NeedsPressure):
    """All pressure sensors show (1 + size) times the pressure."""

    name, family, kind, unit = "pressure_scale", "meter", "sensor", "-"
    typical = 0.05
    also_looks_like = ("viscosity", "calibration of the pressure sensors")

    def apply(self, scene: NetworkScene, size: Tensor, run: Run) -> NetworkScene:
        is_pressure = torch.ones_like(scene.channel_gain)
        is_pressure[: scene.back_pressure.shape[1]] = 0.0
        gain = scene.channel_gain * (1.0 + size[0] * is_pressure)
        return dataclasses.replace(scene, channel_gain=gain)


class EntranceLoss(_NeedsLevels):
    """A loss of size rho u^2 / 2 at the entrance of every branch, u its mean speed."""

    name, family, kind, unit = "entrance_loss", "drive_dependent", "environment", "-"
    typical, signed = 3.0, False
    also_looks_like = ("inertia", "compliance", "sharp edges")

    def apply(self, scene: NetworkScene, size: Tensor, run: Run) -> NetworkScene:
        return with_added(scene, entrance_loss=size[0])


class BlockedBranch(Effect):
    """The middle of one branch narrower by ``size`` of its width."""

    family, kind, unit = "blockage", "environment", "-"
    typical, signed = 0.15, False
    smooth = False  # as for the wall offset
    also_looks_like = ("bubble", "debris", "meter_gain", "one channel printed narrow")

    def __init__(self, outlet: int):
        self.outlet, self.name = outlet, f"blocked_branch_{outlet + 1}"  # type: ignore[misc]

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return scene.narrowed(self.outlet, size[0])


class PressureOffset(_NeedsLevels):
    """A constant pressure beyond one outlet, felt most at low drive."""

    family, kind, unit = "blockage", "environment", "Pa"
    typical = 10.0
    also_looks_like = ("bubble held by capillarity", "height of the outlet tube", "blocked_branch")

    def __init__(self, outlet: int):
        self.outlet, self.name = outlet, f"pressure_offset_{outlet + 1}"  # type: ignore[misc]

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        one = _one_hot(len(scene.outlet_pressure), self.outlet)
        return with_added(scene, outlet_pressure=size[0] * one)


class SkewedInlet(Effect):
    """Inflow leaning to one side: u (1 + size (y - y0) / (w / 2)), the flow kept."""

    name, family, kind, unit = "skewed_inlet", "inlet", "actuator", "-"
    typical = 0.5
    also_looks_like = ("bent supply tube", "misaligned connector")

    def needs(self, study: Study) -> str | None:
        if any(name.startswith("pressure_in") for run in study.runs for name in run.command):
            return "runs driven by flow: an open inlet finds its own profile"
        return None

    def apply(self, scene: StokesScene, size: Tensor, run: Run) -> StokesScene:
        return with_added(scene, inlet_skew=size[0])


def stokes_library(device: ChannelDevice | None = None) -> tuple[Effect, ...]:
    """All candidate effects of a device; those with a place once per place.

    Args:
        device: Default ``ChannelDevice()``.
    """
    device = ChannelDevice() if device is None else device
    outlets, inlets = range(len(device.outlets)), range(len(device.inlets))
    return (
        Slip(),
        WallOffset(),
        Viscosity(),
        TemperatureGradient(),
        Compliance(),
        Thinning(),
        Inertia(),
        Leak(),
        SkewedInlet(),
        *(PumpGain(i) for i in inlets),
        *(MeterGain(i) for i in outlets),
        *(BlockedBranch(i) for i in outlets),
        *(PressureOffset(i) for i in outlets),
    )


def network_library(device: NetworkDevice) -> tuple[Effect, ...]:
    """All candidate effects of a channel network; sizes in flows, not flows per depth.

    Args:
        device: Typical sizes of walls follow from its narrowest channel.
    """
    narrowest = min(s.width for s in device.segments)
    outlets = range(len(device.outlets))
    leak = _of(Leak(), 1e-11)
    leak.unit = "m^3/(s Pa)"  # type: ignore[misc]
    return (
        _of(Slip(), 0.01 * narrowest),
        _of(WallOffset(), 0.01 * narrowest),
        Viscosity(),
        TemperatureGradient(),
        _of(Compliance(), 5e-4),
        Thinning(),
        EntranceLoss(),
        leak,
        PressureScale(),
        PumpGain(0),
        *(MeterGain(i) for i in outlets),
        *(_of(BlockedBranch(i), 0.1) for i in outlets),
        *(_of(PressureOffset(i), 5.0) for i in outlets),
    )


def _of(effect: Effect, typical: float) -> Effect:
    """The effect on a device where another size is typical. Networks interpolate between shapes of
    the walls, so that there all effects are smooth."""
    effect.typical, effect.smooth = typical, True  # type: ignore[misc]
    return effect


def _measures(study: Study, kind: str) -> bool:
    return any(channel.kind == kind for channel in study.channels)


def _commands_pressure(study: Study) -> bool:
    """A known pressure drives flows that tell the viscosity."""
    commands = [c for run in study.fit_runs for n, c in run.command.items() if n.endswith("_Pa")]
    return any(bool((c != 0.0).any()) for c in commands)


def _one_hot(count: int, index: int) -> Tensor:
    return torch.eye(count, dtype=torch.float64)[index]


def _scaled(values: Tensor, column: int, size: Tensor) -> Tensor:
    """Values (n, count) with one column times 1 + size."""
    return values * (1.0 + size * _one_hot(values.shape[1], column))
