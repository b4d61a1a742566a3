"""A channel network as a model: unit flows of the Stokes simulator, driven, loaded and read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.instruments import grid_of
from diffsim.data.study import Run
from diffsim.identify import Parameter
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.flow_network.network import NetworkDevice
from diffsim.systems.flow_network.network_balance import Balance
from diffsim.systems.flow_network.network_conditions import RTOL, NetworkConditions
from diffsim.systems.flow_network.steady import number_places
from diffsim.systems.flow_network.unit_flows import UnitFlowTable

#: Fields of a scene that are one number, which causes may change.
SINGLE = (
    *("viscosity", "wall_offset", "slip_length", "viscosity_gradient", "thinning"),
    *("compliance", "entrance_loss", "leak"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkScene(NetworkConditions):
    """One run of the network, ready to be simulated."""

    def simulate(self) -> Tensor:
        """Flows and pressures, (num_samples, num_channels).

        Raises:
            ConvergenceError: flows and pressures do not balance; an effect is too large.
        """
        balance = Balance(self)
        with torch.no_grad():
            y = balance.solved()
        residual, slope, tap = balance.at(y)
        # one Newton step more carries the gradients of the balance (implicit function theorem)
        y = y - torch.linalg.solve(slope.detach(), residual)
        if residual.requires_grad:
            tap = balance.at(y)[2]
        levels = torch.cat([y[:, :-1] * balance.flow_scale, y[:, -1:], tap[:, None]], 1)
        shown = levels * self.channel_gain + self.channel_offset
        if self.columns is not None:
            shown = shown[:, list(self.columns)]
        return self.show(shown)


def network_base(device: NetworkDevice, runs: Sequence[str]) -> tuple[Parameter, ...]:
    """Base parameters that are always uncertain in a network.

    Viscosity to 1 %, widths to 0.3 %, what the pump gives in each run to 0.5 %, each meter to
    0.5 %, the zeros of the pressure sensors to 0.2 Pa.
    """
    return (
        Parameter("viscosity", device.viscosity, 0.01, "Pa s", log=True),
        *(Parameter(f"width_{s.name}", s.width, 0.003, "m", log=True) for s in device.segments),
        *(Parameter(f"flow_gain_{i + 1}", 1.0, 0.005) for i in range(len(device.outlets))),
        *(Parameter(f"pressure_zero_{i + 1}", 0.0, 0.2, "Pa") for i in range(2)),
        *(Parameter(f"pump_gain@{run}", 1.0, 0.005) for run in runs),
    )


def network_model(
    device: NetworkDevice,
    base: Sequence[Parameter],
    *,
    pump: str,
    back_pressures: Sequence[str],
    columns: Sequence[int] | None = None,
    corrected: bool = True,
) -> SimModel:
    """A network as a model for the diagnosis: channels are outlet flows, pump and tap pressure.

    Args:
        device: Network to be simulated.
        base: Base parameters out of those that ``network_base`` makes; the others hold their
            nominal value.
        pump: Name of the command of the pump [m^3/s].
        back_pressures: Names of the commands that are pressures beyond the outlets [Pa]. Those that
            a run does not have are zero.
        columns: Whether resistances are corrected by what halving the cells once changes, as in
            ``UnitFlowTable``.
        corrected: Whether walls, slip and thinning are corrected as ``UnitFlowTable`` does.

    Returns:
        Model. Unit flows are simulated when first needed and kept with the model;
        ``Numerics.mesh`` scales the cells, ``tolerance`` the balance; ``time_step`` has no meaning.
    """
    nominal = {p.name: p.value for p in network_base(device, ())}
    unknown = sorted(
        p.name for p in base if p.name not in nominal and not p.name.startswith("pump_gain@")
    )
    if unknown:
        raise ValueError(f"base parameters {unknown} are unknown; known are {sorted(nominal)}")
    num_flows = len(device.outlets)
    numbers = number_places(
        SINGLE,
        {
            "meter": ("channel_gain", num_flows + 2),
            "narrowing": ("narrowing", num_flows),
            "outlet_pressure": ("outlet_pressure", num_flows),
        },
    )

    @lru_cache(maxsize=4)
    def table(mesh: float) -> UnitFlowTable:
        return UnitFlowTable(device, mesh, corrected=corrected)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> NetworkScene:
        fixed = {k: torch.tensor(v, dtype=torch.float64) for k, v in nominal.items()}
        v = fixed | dict(values)
        one = torch.ones((), dtype=torch.float64)
        gains = [v[f"width_{s.name}"] / s.width for s in device.segments]
        drive, back, level = _group_levels(run, pump, back_pressures)
        zeros = torch.zeros(num_flows, dtype=torch.float64)
        return NetworkScene(
            table=table(numerics.mesh),
            drive=drive * v.get(f"pump_gain@{run.name}", one),
            back_pressure=back,
            level=level,
            commands=(pump, *back_pressures),
            grid=grid_of(run),
            numbers=numbers,
            viscosity=v["viscosity"],
            width_gain=torch.stack(gains),
            outlet_pressure=zeros,
            channel_gain=torch.stack(
                [*(v[f"flow_gain_{i + 1}"] for i in range(num_flows)), one, one]
            ),
            channel_offset=torch.cat(
                [zeros, torch.stack([v["pressure_zero_1"], v["pressure_zero_2"]])]
            ),
            narrowing=zeros,
            columns=None if columns is None else tuple(columns),
            rtol=RTOL * numerics.tolerance,
        )

    make: Any = build
    return SimModel(make, base, name="channel network")


def _group_levels(run: Run, pump: str, back: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Different levels of the pump (levels, 1) and of the back pressures (levels, m), and which of
    them holds at each sample."""
    if pump not in run.command:
        raise ValueError(f"run {run.name}: command {pump} is missing, got {sorted(run.command)}")
    none = np.zeros(len(run.time_s))
    commands = np.stack([np.asarray(run.command.get(name, none)) for name in (pump, *back)], -1)
    levels, level = np.unique(commands, axis=0, return_inverse=True)
    rows = torch.from_numpy(levels)
    return rows[:, :1], rows[:, 1:], torch.from_numpy(level.reshape(-1))
