"""From a described network of channels to scenes and candidate causes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.flow_network import effects as causes
from diffsim.systems.flow_network.keys import FlowNuisanceKeys, MeterKeys, SourceKeys, TubeKeys
from diffsim.systems.flow_network.lumped import Layout, LumpedScene, Reading

_SIZES = ("width", "height", "diameter", "length", "resistance")


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedNetwork:
    """Makes the scene of a run at values of the base parameters.

    Attributes:
        tubes, sources, meters: As described; meters in the order of the study's channels.
        layout: What joins what.
        parameters: Quantities by name.
        density: Of the fluid [kg/m^3].
        shear_rate: Beyond which the fluid thins [1/s].
    """

    tubes: tuple[TubeKeys, ...]
    sources: tuple[SourceKeys, ...]
    meters: tuple[MeterKeys, ...]
    layout: Layout
    parameters: BaseParameters
    density: float
    shear_rate: float

    def __call__(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> LumpedScene:
        v = self.parameters.in_run(values, run)
        drive, back, level = self._levels(run)
        one, zero = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)

        def sizes(*names: str) -> Tensor:
            found = [
                next((v[f"{n}_{t.name}"] for n in names if f"{n}_{t.name}" in v), one)
                for t in self.tubes
            ]
            return torch.stack(found)

        names = [m.channel for m in self.meters]
        return LumpedScene(
            layout=self.layout,
            drive=drive * v["pump_gain"],
            back_pressure=back,
            level=level,
            viscosity=v["viscosity"],
            width=sizes("width", "diameter", "resistance"),
            height=sizes("height"),
            length=sizes("length"),
            nominal_viscosity=self.parameters.quantities["viscosity"].value,
            outlet_pressure=torch.zeros(back.shape[1], dtype=torch.float64),
            channel_gain=torch.stack([v.get(f"flow_gain_{n}", one) for n in names]),
            channel_offset=torch.stack([v.get(f"pressure_zero_{n}", zero) for n in names]),
            narrowing=torch.zeros(len(self.layout.branches), dtype=torch.float64),
            density=self.density,
            shear_rate=self.shear_rate,
            rtol=1e-11 * numerics.tolerance,
        )

    def _levels(self, run: Run) -> tuple[Tensor, Tensor, Tensor]:
        """Different levels of pumps and of pressures, and which holds at each sample."""
        count = len(run.time_s)
        columns = []
        pumps = [s for s in self.sources if s.flow is not None]
        for s in (*pumps, *(s for s in self.sources if s.flow is None)):
            given = s.flow if s.flow is not None else s.pressure
            value = run.command[given] if isinstance(given, str) else np.full(count, given)
            columns.append(np.asarray(value, dtype=np.float64))
        levels, level = np.unique(np.stack(columns, -1), axis=0, return_inverse=True)
        rows = torch.from_numpy(levels)
        return rows[:, : len(pumps)], rows[:, len(pumps) :], torch.from_numpy(level.reshape(-1))


def layout_of(
    tubes: Sequence[TubeKeys], sources: Sequence[SourceKeys], meters: Sequence[MeterKeys]
) -> Layout:
    """Nodes and channels by index.

    Raises:
        ValueError: a name that is not there, or a network whose pressures hang in the air.
    """
    nodes = nodes_of(tubes)
    names = [t.name for t in tubes]
    for s in sources:
        if s.node not in nodes:
            raise ValueError(f"sources: no channel ends at {s.node}; nodes: {', '.join(nodes)}")
    pressures = [s for s in sources if s.flow is None]
    held = tuple(nodes.index(s.node) for s in pressures)
    if not held:
        open_ends = dead_ends(tubes, sources)
        example = f", such as {{node: {open_ends[0]}, pressure: 0}}" if open_ends else ""
        raise ValueError(
            f"sources: no pressure is known anywhere; give one to each open end{example}"
        )
    if len(set(held)) < len(held):
        raise ValueError("sources: two pressures at one node")
    if repeated := {n for n in names if names.count(n) > 1}:
        raise ValueError(f"channels repeat: {', '.join(sorted(repeated))}")
    readings = []
    for m in meters:
        tube = m.flow_in or m.pressure_in
        known, given = (names, tube) if tube is not None else (nodes, m.pressure_at)
        if given not in known:
            raise ValueError(f"meter {m.channel}: no {given!r}; known: {', '.join(known)}")
        index = known.index(str(given))
        readings.append(
            Reading(tube=index, share=m.share) if tube is not None else Reading(node=index)
        )
    ends = tuple(nodes.index(t.end) for t in tubes)
    return Layout(
        starts=tuple(nodes.index(t.start) for t in tubes),
        ends=ends,
        shapes=tuple(t.shape for t in tubes),
        free=tuple(i for i in range(len(nodes)) if i not in held),
        pumps=tuple(nodes.index(s.node) for s in sources if s.flow is not None),
        held=held,
        branches=tuple(
            k for k, end in enumerate(ends) if end in held and tubes[k].shape != "resistance"
        ),
        readings=tuple(readings),
    )


def nodes_of(tubes: Sequence[TubeKeys]) -> list[str]:
    """Names of all nodes, in the order of their indices."""
    return list(dict.fromkeys(n for t in tubes for n in (t.start, t.end)))


def dead_ends(tubes: Sequence[TubeKeys], sources: Sequence[SourceKeys]) -> list[str]:
    """Nodes that a single channel joins and no source feeds: nothing flows out of them."""
    ends = [n for t in tubes for n in (t.start, t.end)]
    fed = {s.node for s in sources}
    return [n for n in dict.fromkeys(ends) if ends.count(n) == 1 and n not in fed]


def quantities_of(
    viscosity: Quantity,
    tubes: Sequence[TubeKeys],
    meters: Sequence[MeterKeys],
    nuisances: FlowNuisanceKeys,
) -> Iterator[tuple[str, Quantity]]:
    """Everything that may be fitted, by name of the base parameter."""
    yield "viscosity", viscosity
    for tube in tubes:
        for size in _SIZES:
            given: Quantity | None = getattr(tube, size)
            if given is not None:
                yield f"{size}_{tube.name}", given
    gain = nuisances.pump_gain
    one = Quantity(value=1.0)
    yield "pump_gain", Quantity(value=1.0, sd=gain, per="run") if gain > 0.0 else one
    for meter in meters:
        if meter.flow_in is not None and nuisances.flow_gain > 0.0:
            yield f"flow_gain_{meter.channel}", Quantity(value=1.0, sd=nuisances.flow_gain)
        if meter.flow_in is None and nuisances.pressure_zero > 0.0:
            zero = Quantity(value=0.0, sd=nuisances.pressure_zero, unit="Pa")
            yield f"pressure_zero_{meter.channel}", zero


_OF_LEVELS = tuple(e.name for e in (causes.COMPLIANCE, causes.THINNING, causes.ENTRANCE_LOSS))


def network_causes(network: LumpedNetwork, study: Study) -> tuple[Effect, ...]:
    """Candidate causes that the study's meters and commands can show.

    Args:
        network: Network as described.
        study: Recorded runs.
    """
    layout, values = network.layout, network.parameters.quantities
    narrow = [
        min(values[f"{s}_{t.name}"].value for s in _SIZES[:3] if f"{s}_{t.name}" in values)
        for t in network.tubes
        if t.shape != "resistance"
    ]
    is_flow = [m.flow_in is not None for m in network.meters]
    sees_pressure = not all(is_flow) or any(isinstance(s.pressure, str) for s in network.sources)
    return tuple(
        replace(
            effect, needs=_several_levels if effect.name in _OF_LEVELS else _nothing, smooth=True
        )
        for effect in (
            *(_of_walls(min(narrow)) if narrow else ()),
            *((causes.VISCOSITY,) if sees_pressure else ()),
            *((causes.LEAK,) if sees_pressure and layout.pumps else ()),
            *(_joint_leak(layout, i, name) for i, name in _joints(network)),
            *((_pressure_scale(is_flow),) if not all(is_flow) else ()),
            *(causes.pump_gain(i) for i in range(len(layout.pumps))),
            *(_meter_gain(i, n) for n, i in enumerate(_places(is_flow))),
            *(_sized(causes.blocked_branch(i), 0.1) for i in range(len(layout.branches))),
            *(_sized(causes.pressure_offset(i), 5.0) for i in range(len(layout.held))),
        )
    )


def _joints(network: LumpedNetwork) -> list[tuple[int, str]]:
    """Place among the free nodes, and name, of those where channels meet and no pump is."""
    layout, nodes = network.layout, nodes_of(network.tubes)
    ends = [*layout.starts, *layout.ends]
    return [
        (i, nodes[node])
        for i, node in enumerate(layout.free)
        if ends.count(node) > 1 and node not in layout.pumps
    ]


def _joint_leak(layout: Layout, place: int, name: str) -> Effect:
    """A leak at one joint, whose place is that among the free nodes."""
    there = torch.eye(len(layout.free), dtype=torch.float64)[place]

    def leaking(scene: LumpedScene, size: Tensor, run: Run) -> LumpedScene:
        return replace(scene, node_leak=scene.node_leak + size[0] * there)

    return replace(
        causes.LEAK,
        name=f"leak_at_{name}",
        form=f"Flow lost at the joint {name} in proportion to the pressure there.",
        also_looks_like=("a leak at another joint", "meter_gain", "loose fitting", "porous wall"),
        apply=leaking,
    )


def _of_walls(narrowest: float) -> Iterator[Effect]:
    yield _sized(causes.SLIP, 0.01 * narrowest)
    yield _sized(causes.WALL_OFFSET, 0.01 * narrowest)
    yield _sized(causes.COMPLIANCE, 5e-4)
    yield causes.THINNING
    yield causes.ENTRANCE_LOSS


def _places(is_flow: Sequence[bool]) -> list[int]:
    return [i for i, flow in enumerate(is_flow) if flow]


def _meter_gain(channel: int, number: int) -> Effect:
    """The gain of a flow meter, named by its number among the flow meters."""
    return replace(causes.meter_gain(channel), name=f"meter_gain_{number + 1}")


def _pressure_scale(is_flow: Sequence[bool]) -> Effect:
    shown = torch.tensor([0.0 if flow else 1.0 for flow in is_flow], dtype=torch.float64)

    def scaled(scene: LumpedScene, size: Tensor, run: Run) -> LumpedScene:
        return replace(scene, channel_gain=scene.channel_gain * (1.0 + size[0] * shown))

    return replace(causes.PRESSURE_SCALE, apply=scaled)


def _sized(effect: Effect, typical: float) -> Effect:
    return replace(effect, typical=typical)


def _several_levels(study: Study) -> str | None:
    """Only several levels of a command tell it from a constant."""
    levels = {float(v) for run in study.runs for c in run.command.values() for v in np.unique(c)}
    return None if len(levels) > 1 else "two levels of a command or more"


def _nothing(study: Study) -> str | None:
    return None
