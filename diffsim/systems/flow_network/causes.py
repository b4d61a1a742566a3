"""Causes of error of devices and networks of channels: which of them a description leaves room for.

Each has its row in the table; what one pump, meter, branch or outlet has of its own is numbered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from diffsim.causes.catalogue import rows
from diffsim.causes.commands import CommandGroup, command_causes
from diffsim.causes.ports import on_commands, on_numbers
from diffsim.causes.readings import TIMED_COMMANDS, TIMED_READINGS, instrument_causes
from diffsim.causes.scales import Scales
from diffsim.causes.signals import Between
from diffsim.data.study import Study
from diffsim.identify.effect import Effect, needs_nothing
from diffsim.systems.flow_network.device import ChannelDevice
from diffsim.systems.flow_network.network import NetworkDevice

if TYPE_CHECKING:
    from diffsim.systems.flow_network.lumped_build import LumpedNetwork

FLOW = "flow"  # the table
DEVICE = "device"  # what plain magnitudes are of
MANIFOLD = "manifold"  # kind of system: a planar device with flows per depth
_WALLS = ("slip", "wall_offset", "compliance", "thinning", "entrance_loss")
# each pump has its gain, and each meter its own, under other names
_SAID_OTHERWISE = ("sensor_scale",)


def measure_scales(study: Study, narrowest: float | None) -> Scales:
    """Usual magnitudes of the recordings and of the channels.

    Args:
        study: Study whose runs to fit are looked at, unless its frame has the record.
        narrowest: Width of the narrowest channel [m]; None: no channel has a width.
    """
    kept = Scales.kept_in(study)
    if kept is not None:
        return kept
    plain = {DEVICE: {} if narrowest is None else {"narrowest": narrowest}}
    return replace(Scales.of_runs(study), plain=plain)


def stokes_library(device: ChannelDevice | None = None) -> tuple[Effect, ...]:
    """All candidate effects of a device; those with a place once per place.

    Args:
        device: Device whose candidates are listed; None: ``ChannelDevice()``.
    """
    device = ChannelDevice() if device is None else device

    def cause(name: str, number: int | None = None, **own: Any) -> Effect:
        return _make_cause(name, {}, number, system=MANIFOLD, **own)

    outlets = range(1, len(device.outlets) + 1)
    return (
        cause("slip"),
        cause("wall_offset"),
        cause("viscosity", needs=needs_pressure),
        cause("temperature_gradient"),
        cause("compliance"),
        cause("thinning"),
        cause("fluid_inertia"),
        cause("leak_per_depth", needs=needs_flow_and_pressure),
        cause("skewed_inlet", needs=needs_flow),
        *(_make_pump_gain(i + 1) for i in range(len(device.inlets))),
        *(cause("meter_gain", i) for i in outlets),
        *(cause("blocked_branch", i) for i in outlets),
        *(cause("pressure_offset", i) for i in outlets),
    )


def network_library(device: NetworkDevice) -> tuple[Effect, ...]:
    """All candidate effects of a channel network; sizes in flows, not flows per depth.

    Networks interpolate between shapes of the walls, so that there all effects are smooth.

    Args:
        device: Typical sizes of walls follow from its narrowest channel.
    """
    usual = {"narrowest": min(s.width for s in device.segments)}

    def cause(name: str, number: int | None = None, **own: Any) -> Effect:
        return _make_cause(name, usual, number, smooth=True, **own)

    outlets = range(1, len(device.outlets) + 1)
    pressures = tuple(f"meter_{len(device.outlets) + i + 1}" for i in range(2))
    return (
        cause("slip"),
        cause("wall_offset"),
        cause("viscosity", needs=needs_pressure),
        cause("temperature_gradient"),
        cause("compliance"),
        cause("thinning"),
        cause("entrance_loss"),
        cause("leak", needs=needs_flow_and_pressure),
        cause("pressure_scale", numbers=pressures, needs=needs_pressure),
        _make_pump_gain(1),
        *(cause("meter_gain", i) for i in outlets),
        *(cause("blocked_branch", i) for i in outlets),
        *(cause("pressure_offset", i) for i in outlets),
    )


def lumped_causes(network: LumpedNetwork, scales: Scales) -> tuple[Effect, ...]:
    """Candidate causes that a described network's meters and commands can show.

    Args:
        network: Network as described.
        scales: Usual magnitudes.
    """
    layout, usual = network.layout, scales.plain[DEVICE]

    def cause(name: str, number: int | None = None, **own: Any) -> Effect:
        needs = {} if name in _WALLS else {"needs": needs_nothing}
        return _make_cause(name, usual, number, smooth=True, **{**needs, **own})

    is_flow = [m.flow_in is not None for m in network.meters]
    flows = [i + 1 for i, flow in enumerate(is_flow) if flow]
    pressures = tuple(f"meter_{i + 1}" for i, flow in enumerate(is_flow) if not flow)
    sees_pressure = bool(pressures) or any(isinstance(s.pressure, str) for s in network.sources)
    joints = network.joints() if layout.free else []
    return (
        *((cause(name) for name in _WALLS) if usual else ()),
        *((cause("viscosity"),) if sees_pressure else ()),
        *((cause("leak"),) if sees_pressure and layout.pumps else ()),
        *(cause("leak_at", ending=f"_{n}", numbers=(f"leak_at_{n}",)) for n in joints),
        *((cause("pressure_scale", numbers=pressures),) if pressures else ()),
        *(_make_pump_gain(i + 1) for i in range(len(layout.pumps))),
        *(cause("meter_gain", k + 1, numbers=(f"meter_{i}",)) for k, i in enumerate(flows)),
        *(cause("blocked_branch", i + 1) for i in range(len(layout.branches))),
        *(cause("pressure_offset", i + 1) for i in range(len(layout.held))),
    )


def signal_causes(
    study: Study,
    scales: Scales,
    *,
    pumps: Sequence[str],
    pressures: Sequence[str],
    is_in_time: bool,
) -> tuple[Effect, ...]:
    """What commands meet on their way, and instruments do, beside the gains of pumps and meters.

    Args:
        study: Study with the channels.
        scales: Usual magnitudes.
        pumps, pressures: Names of the commands, each by itself by kind.
        is_in_time: Whether samples of a run follow each other in time.
    """
    timed = () if is_in_time else TIMED_COMMANDS
    several = bool(pumps and pressures)
    found: list[Effect] = []
    for names, ending, left_out in (
        (pumps, "_of_pumps", ("command_gain",)),
        (pressures, "_of_pressures", ()),
    ):
        if names:
            group = CommandGroup(
                tuple(dict.fromkeys(names)),
                scales.of_commands(names),
                between=between_samples("time" if is_in_time else "levels"),
                is_one_sided=scales.is_one_sided(names),
                ending=ending if several else "",
            )
            found += command_causes(group, without=(*left_out, *timed))
    found += instrument_causes(
        study.channels,
        scales,
        late_record=not (pumps or pressures),
        without=_SAID_OTHERWISE if is_in_time else (*_SAID_OTHERWISE, *TIMED_READINGS),
    )
    return tuple(found)


def between_samples(samples: str) -> Between:
    """What commands do between samples; each level by itself keeps its own."""
    return "straight" if samples == "time" else "held"


def needs_pressure(study: Study) -> str | None:
    """A pressure identifies it where pumps prescribe the flow."""
    known = any(c.kind == "pressure" for c in study.channels) or _commands_pressure(study)
    return None if known else "a pressure channel"


def needs_flow_and_pressure(study: Study) -> str | None:
    """Runs driven by flow, and a pressure."""
    if _has_regulators(study):
        return "runs driven by flow: a regulated pressure makes up for a leak ahead of it"
    return needs_pressure(study)


def needs_flow(study: Study) -> str | None:
    """Runs driven by flow."""
    if _has_regulators(study):
        return "runs driven by flow: an open inlet finds its own profile"
    return None


def _make_cause(
    name: str,
    usual: Mapping[str, float],
    number: int | None = None,
    *,
    numbers: tuple[str, ...] = (),
    **own: Any,
) -> Effect:
    """A cause that changes numbers: those of its row, the one of that number, or others."""
    row = rows(FLOW)[name]
    key = "scale" if row.scale else "add"
    if number is not None:
        numbers = numbers or tuple(f"{n}_{number}" for n in getattr(row, key))
        own = {"ending": f"_{number}", **own}
    row = row.model_copy(update={key: numbers}) if numbers else row
    return row.effect(on_numbers(row), usual, **own)


def _make_pump_gain(number: int) -> Effect:
    row = rows(FLOW)["pump_gain"]
    return row.effect(on_commands(row, (f"inlet_{number}",)), ending=f"_{number}")


def _has_regulators(study: Study) -> bool:
    return any(name.startswith("pressure_in") for run in study.runs for name in run.command)


def _commands_pressure(study: Study) -> bool:
    """A known pressure drives flows that identify the viscosity."""
    commands = [c for run in study.fit_runs for n, c in run.command.items() if n.endswith("_Pa")]
    return any(bool((c != 0.0).any()) for c in commands)


__all__ = ["lumped_causes", "measure_scales", "network_library", "signal_causes", "stokes_library"]
