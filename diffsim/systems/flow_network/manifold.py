"""A manifold on the Stokes simulator as described: its device, its scenes, its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from diffsim.causes.scene import grid_of
from diffsim.core.errors import ConvergenceError
from diffsim.data.study import Run
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.stokes import FlowField
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.flow_network.corrections import MAX_SWEEPS, shear_rate_squared
from diffsim.systems.flow_network.device import ChannelDevice, Opening
from diffsim.systems.flow_network.keys import FlowDeviceKeys, ManifoldKeys
from diffsim.systems.flow_network.rig import FlowRig
from diffsim.systems.flow_network.steady import (
    Parts,
    SteadyScene,
    counted,
    drive_commands,
    meter_gains,
    numbered,
)

WALL_SWEEPS = 3
"""Walls follow the pressure so often, each time ten times closer. Not to the last digit: the flow
jumps by some 1e-4 where a wall passes nodes, and such a map may have no fixed point."""
#: Numbers of the whole device that causes may change.
_SINGLE = (
    *("viscosity", "wall_offset", "inlet_skew", "leak", "slip_length", "compliance"),
    *("viscosity_gradient", "thinning", "density"),
)
SWEPT = ("leak", "slip_length", "compliance", "viscosity_gradient", "thinning", "density")


@dataclass(frozen=True, kw_only=True, eq=False)
class StokesScene(SteadyScene):
    """One run of the device; a term of ``SWEPT`` that no cause has changed is not computed.

    Numbers: ``viscosity`` at the nominal temperature [Pa s]; ``wall_offset``, by which all walls
    move outwards, and ``slip_length`` [m]; ``inlet_skew``, lean of the inlet profile as in
    ``FlowRig.inflow``; ``leak``, flow lost ahead of each inlet over the pressure there
    [m^2/(s Pa)]; ``compliance``, c of width w (1 + c p) [1/Pa]; ``viscosity_gradient``, relative,
    across the box in y, from -g/2 to g/2; ``thinning``, 1 - n of viscosity
    (1 + (rate / shear_rate)^2)^(-thinning / 2); ``density`` that the fluid's inertia is computed
    with [kg/m^3]; of each outlet ``narrowing_1`` of its branch's middle, relative to its width, and
    ``outlet_pressure_1`` [Pa]; of each meter ``meter_1``, its gain.
    """

    rig: FlowRig  # device on its grid, with what all runs share
    columns: tuple[int, ...]  # channels that were measured, by index

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels).

        Raises:
            ConvergenceError: the sweeps over leak, slip, compliance, viscosity or inertia do not
                settle: the effect is too large for this expansion.
        """
        drive, _, level = self.levels()
        # A wall that gives way has its own shape at each level; else one factorization serves all.
        each = 1 if "compliance" in self.numbers else len(drive)
        read = torch.cat([self._read_sensors(self._solve_steady(d)) for d in drive.split(each)])
        shown = (read * self.several("meter", read.shape[1]))[:, list(self.columns)]
        return self.instruments.read_late(shown[level], self.grid)

    def _read_sensors(self, field: FlowField) -> Tensor:
        rig = self.rig
        return torch.cat(
            [rig.outlet_flows(field), rig.tap_pressures(field), rig.profile(field)], -1
        )

    @property
    def _needs_sweeps(self) -> bool:
        return any(term in self.numbers for term in SWEPT)

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
        given = {name: float(self.numbers[name].detach()) for name in SWEPT if name in self.numbers}
        return ", ".join(f"{name} {value:.3g}" for name, value in given.items())

    @property
    def _rigid_level_set(self) -> Tensor:
        """Level set without the pressure's doing."""
        phi, device = self.rig.phi + self.number("wall_offset"), self.rig.device
        for outlet in range(len(device.outlets)):
            share = self.number(f"narrowing_{outlet + 1}")
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
        beyond = self.several("outlet_pressure", len(rig.device.outlets))
        if rig.device.drive == "flow":
            if "leak" in self.numbers and before is not None:
                drive = drive - self.number("leak") * rig.tap_pressures(before)
            skew, offset, slip = map(self.number, ("inlet_skew", "wall_offset", "slip_length"))
            inlet, traction = rig.inflow(phi, drive, skew, offset, slip), rig.traction(None, beyond)
        else:
            inlet, traction = None, rig.traction(drive, beyond)
        return rig.solver(
            phi, inlet, viscosity=self.number("viscosity"), traction=traction, **(loads or {})
        )

    def _move_walls(self, before: FlowField) -> Tensor:
        """The level set of walls that give way to the pressure."""
        if "compliance" not in self.numbers:
            return self._rigid_level_set
        # Stencils of the rigid shape: cells on the verge would come and go with the sweeps.
        at_nodes = self.rig.derivatives(self._rigid_level_set).pressure_at_nodes(before.pressure)[0]
        return self._rigid_level_set + 0.5 * self.number("compliance") * self.rig.width * at_nodes

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
        if "density" in self.numbers:
            inertia = -self.number("density") * d.convection(before.velocity, gradient)
            loads["body_force"] = loads.get("body_force", 0.0) + inertia
        if "slip_length" in self.numbers:
            slip = self.number("slip_length")
            wall = slip * d.slip_velocity(gradient, phi)
            # Waves of the wall velocity over two cells would grow by slip over cell size.
            share = 1.0 / (1.0 + 1.5 * float(slip.detach()) / min(self.rig.grid.spacing))
            loads["wall_velocity"] = share * wall
            if wall_before is not None:
                loads["wall_velocity"] = loads["wall_velocity"] + (1.0 - share) * wall_before
        return loads

    def _compute_extra_viscosity(self, gradient: Tensor, centers: Tensor) -> Tensor | None:
        """Viscosity above the nominal one in fluid cells, (levels or 1, n) [Pa s]."""
        v = self.numbers
        if "viscosity_gradient" not in v and "thinning" not in v:
            return None
        factor = torch.ones(1, len(centers), dtype=torch.float64)
        if "viscosity_gradient" in v:
            height = self.rig.device.size[1]
            factor = factor + v["viscosity_gradient"] * (centers[:, 1] / height - 0.5)
        if "thinning" in v:
            rate = shear_rate_squared(gradient) / self.rig.device.shear_rate**2
            factor = factor * (1.0 + rate) ** (-0.5 * v["thinning"])
        return v["viscosity"] * (factor - 1.0)


class Manifold:
    """Inlets, a manifold across them, and outlets; flows per depth.

    Args:
        given: Description.
    """

    kind = "manifold"
    narrowest = None  # usual sizes are stated

    def __init__(self, given: FlowDeviceKeys, keys: ManifoldKeys):
        self.given = given
        self.device = ChannelDevice(
            inlets=tuple(Opening(o.y, o.width) for o in keys.inlets),
            outlets=tuple(Opening(o.y, o.width) for o in keys.outlets),
            size=keys.size,
            manifold=keys.manifold,
            fillet=keys.fillet,
            cells=keys.cells,
            drive=keys.drive,
            viscosity=given.viscosity.value,
            nominal_drive=keys.nominal_drive,
            num_profile_points=len(given.velocities),
        )
        self.num_inlets = self.num_gauges = len(keys.inlets)
        self.num_outlets = len(keys.outlets)
        self.drives_flow = keys.drive == "flow"

    @property
    def parts(self) -> Parts:
        """Parts that are alike, and what stands for them in names of numbers and commands."""
        outlets = numbered(self.num_outlets)
        return {
            "inlet": numbered(self.num_inlets, "inlet_"),
            **dict.fromkeys(("meter", "branch", "outlet"), outlets),
        }

    @property
    def num_meters(self) -> int:
        """Number of readings that the model makes."""
        return self.num_outlets + self.num_inlets + self.device.num_profile_points

    @property
    def numbers(self) -> tuple[str, ...]:
        """Numbers that causes may change."""
        count = self.num_outlets
        return (
            *_SINGLE,
            *counted(meter=self.num_meters, narrowing=count, outlet_pressure=count),
        )

    def quantities(self) -> dict[str, Quantity]:
        """What is known of the device and its pumps, by name of the base parameter."""
        gain = Quantity(value=1.0, sd=self.given.nuisances.pump_gain or None)
        gains = dict.fromkeys(counted(drive_gain=self.num_inlets), gain)
        return {"wall_offset": self.given.wall_offset, **gains}

    def model(self, parameters: BaseParameters, columns: Sequence[int]) -> SimModel:
        """The device as a model: ``Numerics.mesh`` scales the cells, ``tolerance`` the sweeps.

        Args:
            columns: Which of the readings are channels of the study.
        """

        @lru_cache(maxsize=4)
        def rig(mesh: float) -> FlowRig:
            return FlowRig(self.device, mesh)

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> StokesScene:
            v = parameters.in_run(values, run)
            gains = [v[name] for name in counted(drive_gain=self.num_inlets)]
            return StokesScene(
                grid=grid_of(run),
                numbers={**v, **meter_gains(v, self.num_meters)},
                zeros=self.numbers,
                commands=drive_commands(run, self.given.drives, gains),
                num_drives=self.num_inlets,
                is_in_time=self.given.is_in_time,
                rtol=1e-8 * numerics.tolerance,
                rig=rig(numerics.mesh),
                columns=tuple(columns),
            )

        return SimModel(build, parameters.base, name="stokes device")
