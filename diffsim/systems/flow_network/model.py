"""The flow device as a model: base parameters in, outlet flows, pressures and a profile out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.instruments import grid_of
from diffsim.core.errors import ConvergenceError
from diffsim.data.study import Run
from diffsim.identify.model import Parameter, SimModel
from diffsim.identify.numerics import Numerics
from diffsim.stokes import FlowField
from diffsim.systems.flow_network.corrections import shear_rate_squared
from diffsim.systems.flow_network.device import ChannelDevice
from diffsim.systems.flow_network.rig import Rig
from diffsim.systems.flow_network.steady import SteadyScene, number_places

SWEEP_RTOL = 1e-8
MAX_SWEEPS = 60
WALL_SWEEPS = 3
"""Walls follow the pressure so often, each time ten times closer. Not to the last digit: the flow
jumps by some 1e-4 where a wall passes nodes, and such a map may have no fixed point."""
#: Fields of a scene that are one number, which causes may change.
SINGLE = (
    *("viscosity", "wall_offset", "inlet_skew", "leak", "slip_length", "compliance"),
    *("viscosity_gradient", "thinning", "density"),
)
SWEPT = ("leak", "slip_length", "compliance", "viscosity_gradient", "thinning", "density")
_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class StokesScene(SteadyScene):
    """One run of the device, with the hooks of its effects; zero or None is "not there".

    Attributes:
        rig: Device on its grid, with what all runs share.
        viscosity: At the nominal temperature [Pa s].
        wall_offset: Distance by which all walls move outwards [m].
        narrowing: Of the middle of each branch, relative to its width, (num_outlets,) [-].
        inlet_skew: Lean of the inlet profile to one side, as in ``Rig.inflow`` [-].
        outlet_pressure: Beyond each outlet, (num_outlets,) [Pa].
        leak: Flow lost ahead of each inlet over the pressure there [m^2/(s Pa)].
        channel_gain: Gain of every channel's meter, (num_channels,) [-].
        channel_offset: Offset of every channel's meter, (num_channels,) [unit of the channel].
        slip_length: Slip length of Navier's condition at the walls [m].
        compliance: Compliance c of the walls: the width at pressure p is w (1 + c p) [1/Pa].
        viscosity_gradient: Relative viscosity across the box in y, from -g/2 to g/2 [-].
        thinning: 1 - n: viscosity (1 + (rate / shear_rate)^2)^(-thinning / 2) [-].
        density: Density that the fluid's inertia is computed with [kg/m^3].
        rtol: Relative tolerance of the sweeps over the nonlinear terms [-].
        columns: Channels that were measured, by index; all if None.
    """

    rig: Rig
    viscosity: Tensor
    outlet_pressure: Tensor
    channel_gain: Tensor
    channel_offset: Tensor
    narrowing: Tensor
    wall_offset: Tensor = _ZERO
    inlet_skew: Tensor = _ZERO
    leak: Tensor | None = None
    slip_length: Tensor | None = None
    compliance: Tensor | None = None
    viscosity_gradient: Tensor | None = None
    thinning: Tensor | None = None
    density: Tensor | None = None
    rtol: float = SWEEP_RTOL
    columns: tuple[int, ...] | None = None

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels).

        Raises:
            ConvergenceError: the sweeps over leak, slip, compliance, viscosity or inertia do not
                settle: the effect is too large for this expansion.
        """
        # A wall that gives way has its own shape at each level; else one factorization serves all.
        each = 1 if self.compliance is not None else len(self.drive)
        parts = [
            self._read_sensors(self._solve_steady(levels)) for levels in self.drive.split(each)
        ]
        shown = torch.cat(parts) * self.channel_gain + self.channel_offset
        if self.columns is not None:
            shown = shown[:, list(self.columns)]
        return self.show(shown)

    def _read_sensors(self, field: FlowField) -> Tensor:
        rig = self.rig
        return torch.cat(
            [rig.outlet_flows(field), rig.tap_pressures(field), rig.profile(field)], -1
        )

    @property
    def _needs_sweeps(self) -> bool:
        return any(getattr(self, term) is not None for term in SWEPT)

    def _solve_steady(self, drive: Tensor) -> FlowField:
        """The flow at some levels, (levels, num_inlets): repeated until the terms agree with it."""
        flow = self._solve_linear(drive, None, self._rigid_level_set)
        if not self._needs_sweeps:
            return flow
        change, phi, loads = float("inf"), flow.phi, dict[str, Tensor]()
        for sweep in range(MAX_SWEEPS):
            if sweep < WALL_SWEEPS:
                phi = self._move_walls(flow)
            loads = self._compute_loads(flow, phi, loads.get("wall_velocity"))
            before, flow = flow, self._solve_linear(drive, flow, phi, loads)
            with torch.no_grad():
                # Nodes beyond the wall come and go with the cells that need them.
                inside = self.rig.phi > max(self.rig.grid.spacing)
                scale = flow.velocity.abs().max()
                difference = (flow.velocity - before.velocity)[:, inside]
                change = float(difference.abs().max() / scale.clamp(1e-300))
            if change <= self.rtol:
                return flow
        raise ConvergenceError(
            f"the flow changed by {change:.1e} of its largest speed in sweep {MAX_SWEEPS}, needed "
            f"{self.rtol:.1e}; an effect is too large to be swept (sizes: {self._say_sizes()})",
            residual_norm=change,
            tolerance=self.rtol,
            num_iters=MAX_SWEEPS,
        )

    def _say_sizes(self) -> str:
        given = {t: getattr(self, t) for t in SWEPT if getattr(self, t) is not None}
        return ", ".join(f"{name} {float(value.detach()):.3g}" for name, value in given.items())

    @property
    def _rigid_level_set(self) -> Tensor:
        """Level set without the pressure's doing."""
        phi, device = self.rig.phi + self.wall_offset, self.rig.device
        for outlet, share in enumerate(self.narrowing.unbind()):
            if share.requires_grad or bool(share != 0.0):
                half = 0.5 * device.outlets[outlet].width
                phi = phi - half * share * device.throat(outlet, self.rig.grid.nodes)
        return phi

    def _solve_linear(
        self,
        drive: Tensor,
        before: FlowField | None,
        phi: Tensor,
        loads: Mapping[str, Tensor] | None = None,
    ) -> FlowField:
        """Linear flow under loads; leaks are those at the pressures before."""
        rig = self.rig
        slip = _ZERO if self.slip_length is None else self.slip_length
        if rig.device.drive == "flow":
            if self.leak is not None and before is not None:
                drive = drive - self.leak * rig.tap_pressures(before)
            inlet = rig.inflow(phi, drive, self.inlet_skew, self.wall_offset, slip)
            traction = rig.traction(None, self.outlet_pressure)
        else:
            inlet, traction = None, rig.traction(drive, self.outlet_pressure)
        return rig.solver(phi, inlet, viscosity=self.viscosity, traction=traction, **(loads or {}))

    def _move_walls(self, before: FlowField) -> Tensor:
        """The level set of walls that give way to the pressure."""
        if self.compliance is None:
            return self._rigid_level_set
        # Stencils of the rigid shape: cells on the verge would come and go with the sweeps.
        at_nodes = self.rig.derivatives(self._rigid_level_set).pressure_at_nodes(before.pressure)[0]
        return self._rigid_level_set + 0.5 * self.compliance * self.rig.width * at_nodes

    def _compute_loads(
        self, before: FlowField, phi: Tensor, wall_before: Tensor | None
    ) -> dict[str, Tensor]:
        """Body force and wall velocity by name, as the flow before asks for."""
        d = self.rig.derivatives(self._rigid_level_set)
        loads: dict[str, Tensor] = {}
        gradient = d.gradient(before.velocity)
        extra = self._compute_extra_viscosity(gradient, d.centers)
        if extra is not None:
            loads["body_force"] = d.viscous_force(gradient, extra)
        if self.density is not None:
            inertia = -self.density * d.convection(before.velocity, gradient)
            loads["body_force"] = loads.get("body_force", 0.0) + inertia
        if self.slip_length is not None:
            wall = self.slip_length * d.slip_velocity(gradient, phi)
            # Waves of the wall velocity over two cells would grow by slip over cell size.
            share = 1.0 / (
                1.0 + 1.5 * float(self.slip_length.detach()) / min(self.rig.grid.spacing)
            )
            loads["wall_velocity"] = share * wall
            if wall_before is not None:
                loads["wall_velocity"] = loads["wall_velocity"] + (1.0 - share) * wall_before
        return loads

    def _compute_extra_viscosity(self, gradient: Tensor, centers: Tensor) -> Tensor | None:
        """Viscosity above the nominal one in fluid cells, (levels or 1, n) [Pa s]."""
        if self.viscosity_gradient is None and self.thinning is None:
            return None
        factor = torch.ones(1, len(centers), dtype=torch.float64)
        if self.viscosity_gradient is not None:
            height = self.rig.device.size[1]
            factor = factor + self.viscosity_gradient * (centers[:, 1] / height - 0.5)
        if self.thinning is not None:
            rate = shear_rate_squared(gradient) / self.rig.device.shear_rate**2
            factor = factor * (1.0 + rate) ** (-0.5 * self.thinning)
        return self.viscosity * (factor - 1.0)


def device_base(device: ChannelDevice) -> tuple[Parameter, ...]:
    """Base parameters that are always uncertain: viscosity to 2 %, each meter's and pump's gain to
    0.5 %, walls to 0.3 % of the narrowest channel."""
    narrowest = min(o.width for o in (*device.inlets, *device.outlets))
    drives = [Parameter(f"drive_gain_{i + 1}", 1.0, 0.005) for i in range(len(device.inlets))]
    meters = [Parameter(f"flow_gain_{i + 1}", 1.0, 0.005) for i in range(len(device.outlets))]
    return (
        Parameter("viscosity", device.viscosity, 0.02, "Pa s", log=True),
        Parameter("wall_offset", 0.0, 0.0015 * narrowest, "m"),
        *drives,
        *meters,
    )


def device_model(
    device: ChannelDevice | None = None,
    base: Sequence[Parameter] | None = None,
    *,
    commands: Sequence[str] | None = None,
    columns: Sequence[int] | None = None,
) -> SimModel:
    """The device as a model for the diagnosis.

    Args:
        device: Device to be simulated; None: ``ChannelDevice()``.
        base: Base parameters, of the names that ``device_base`` uses; those left out hold their
            nominal value. Default ``device_base(device)``.
        commands: Names of the runs' commands, one per inlet; None: ``device.commands``.
        columns: Which of ``device.channels`` were measured, by index; None: all.

    Returns:
        Model whose runs hold these commands and channels. ``Numerics.mesh`` scales the
        cells, ``tolerance`` the sweeps; ``time_step`` has no meaning, as the flow is steady.

    Raises:
        ValueError: unknown base parameters.
    """
    device = ChannelDevice() if device is None else device
    nominal = {p.name: p.value for p in device_base(device)}
    base = device_base(device) if base is None else tuple(base)
    if unknown := sorted({p.name for p in base} - set(nominal)):
        raise ValueError(f"base parameters {unknown} are unknown; known are {sorted(nominal)}")

    names = tuple(device.commands if commands is None else commands)
    outlets = len(device.outlets)
    numbers = number_places(
        SINGLE,
        {
            "meter": ("channel_gain", outlets + len(device.inlets) + device.num_profile_points),
            "narrowing": ("narrowing", outlets),
            "outlet_pressure": ("outlet_pressure", outlets),
        },
    )

    @lru_cache(maxsize=4)
    def rig(mesh: float) -> Rig:
        return Rig(device, mesh)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> StokesScene:
        on_grid = rig(numerics.mesh)
        all_values = {k: torch.tensor(v, dtype=torch.float64) for k, v in nominal.items()}
        all_values |= dict(values)
        levels, level = _group_levels(device, run, names)
        gains = [all_values[f"drive_gain_{i + 1}"] for i in range(len(device.inlets))]
        meters = [all_values[f"flow_gain_{i + 1}"] for i in range(len(device.outlets))]
        others = [torch.ones((), dtype=torch.float64)] * (
            len(device.inlets) + device.num_profile_points
        )
        return StokesScene(
            rig=on_grid,
            drive=levels * torch.stack(gains),
            back_pressure=levels[:, :0],
            level=level,
            commands=names,
            grid=grid_of(run),
            numbers=numbers,
            viscosity=all_values["viscosity"],
            wall_offset=all_values["wall_offset"],
            outlet_pressure=torch.zeros(len(device.outlets), dtype=torch.float64),
            narrowing=torch.zeros(len(device.outlets), dtype=torch.float64),
            channel_gain=torch.stack([*meters, *others]),
            channel_offset=torch.zeros(len(meters) + len(others), dtype=torch.float64),
            rtol=SWEEP_RTOL * numerics.tolerance,
            columns=None if columns is None else tuple(columns),
        )

    return SimModel(build, base, name="stokes device")


def _group_levels(device: ChannelDevice, run: Run, names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Different levels of the commands (num_levels, num_inlets), and which holds at each sample."""
    missing = [name for name in names if name not in run.command]
    if missing:
        raise ValueError(
            f"run {run.name}: commands {missing} are missing; a device with drive "
            f"{device.drive!r} needs {list(names)}, got {sorted(run.command)}"
        )
    commands = np.stack([np.asarray(run.command[name]) for name in names], -1)
    levels, level = np.unique(commands, axis=0, return_inverse=True)
    return torch.from_numpy(levels), torch.from_numpy(level.reshape(-1))
