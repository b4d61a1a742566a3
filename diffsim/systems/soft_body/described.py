"""A described soft body as a model: from values of its quantities to scenes of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim import contact
from diffsim.causes.scene import Commands, Instruments, grid_at
from diffsim.core.layer import may_be_differentiated
from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.identify.numerics import Numerics
from diffsim.soft.materials import CONSTANTS
from diffsim.systems.commands import command_of, interpolated
from diffsim.systems.description import fact_in
from diffsim.systems.soft_body.loads import HungWeight
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.quasi_static import posed
from diffsim.systems.soft_body.readings import main_axis, seen
from diffsim.systems.soft_body.rig import SOFT_CABLE_N, BodyRig, mesh_softness
from diffsim.systems.soft_body.scene import ANYWHERE, CLOCK_RATE, ForcePlace, SoftScene

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.systems.description import BaseParameters
    from diffsim.systems.soft_body.body_keys import SoftBodyKeys

Values = Mapping[str, Tensor]


class DescribedModel:
    """Makes scenes of a described soft body.

    Args:
        folder: Folder that files are relative to.
        channels: Names of the channels, in the order of the study.
        parameters: Quantities of the description: base parameters, and values of a run.
        pose_commands: Values of the only command at which slow motions are computed, (num_poses,);
            None: there is none, or several.
        clocks: Indices of the channels that are late together, by the quantity that says how much.
        speed: Usual speed of the markers [m/s].
    """

    def __init__(
        self,
        given: SoftBodyKeys,
        folder: Path | None,
        channels: Sequence[str],
        parameters: BaseParameters,
        pose_commands: Tensor | None = None,
        clocks: Mapping[str, tuple[int, ...]] | None = None,
        speed: float = 1.0,
    ):
        self.given, self.channels, self.parameters = given, tuple(channels), parameters
        self._clocks, self._speed = clocks or {}, speed
        numerics = given.numerics
        self._dt, self._rtol = numerics.time_step, numerics.tolerance
        self.commands = given.commands
        self._pose_commands = pose_commands
        self._rig = lru_cache(maxsize=8)(
            lambda coarser, dt, rtol: BodyRig(given, folder, self.channels, coarser, dt, rtol)
        )
        self._softness = lru_cache(maxsize=8)(self._measure_softness)

    def model(self) -> SoftModel:
        """The model that is fitted."""
        made = SoftModel(self.build, self.parameters.base, "described soft body")
        numerics = self.given.numerics
        made.num_nodes, made.num_poses = len(self.rig().mesh.nodes), numerics.poses
        made.dt_s = 0.0 if numerics.motion == "quasi_static" else numerics.time_step
        return made

    def rig(self, numerics: Numerics | None = None) -> BodyRig:
        """The body on the mesh of some numerics."""
        factors = Numerics() if numerics is None else numerics
        made: BodyRig = self._rig(
            factors.mesh if self.given.body.can_refine else 1.0,
            self._dt * factors.time_step,
            self._rtol * factors.tolerance,
        )
        return made

    def _measure_softness(self, coarser: float) -> float:
        """What coarse cells bend too little, as a factor on Young's modulus."""
        if not (self.given.numerics.correct_mesh and self.given.body.can_refine):
            return 1.0
        found = [self._rig(c, self._dt, self._rtol).compliance() for c in (1.0, 0.5, coarser)]
        known = [c for c in found if c is not None]
        return mesh_softness(*known) if len(known) == len(found) else 1.0

    def build(self, values: Values, run: Run, numerics: Numerics) -> SoftScene:
        """The scene of a run."""
        rig, given = self.rig(numerics), self.given
        own = self.parameters.in_run(values, run)
        physical = self._list_physical(rig, own, run, numerics)
        hung = self._sum_hung_mass(rig, own, run)
        times = np.asarray(run.time_s, dtype=np.float64)
        start = float(times[0]) if given.start.at is None else given.start.at
        start -= given.start.lead_in
        scene: dict[str, Any] = {
            "body": rig.body,
            "grid": grid_at(torch.from_numpy(times - start)),
            "observe": rig.observe,
            "rest_places": rig.look.rest,
            "axes": tuple(main_axis(given.channels[c]) for c in self.channels),
            "numbers": {**physical, CLOCK_RATE: own["clock_rate"]},
            "forces": () if hung is None else ((ANYWHERE, HungWeight),),
            "hung_mass": hung,
            "places": {name: ForcePlace(own, self._speed) for name, own in rig.places.items()},
            "friction_shares": rig.sliding,
            "clock_offset": own["clock_offset"],
            "instruments": Instruments(tuple((c, own[key]) for key, c in self._clocks.items())),
            "output_maps": (seen(rig.look, given.camera, own, self.channels),),
            "obstacles": tuple(
                contact.plane(w.normal, w.offset, friction=w.friction) for w in given.walls
            ),
            **self._make_command(rig, own, run, start),
        }
        if given.water is not None:
            scene["water"] = rig.water(own["water_drag"], own["water_thrust"])
            scene["current"] = torch.tensor(given.water.current, dtype=torch.float64)
            scene["fluid_density"] = given.water.density
        made = SoftScene(**scene)
        if given.numerics.motion == "quasi_static":
            return posed(made, self._pose_commands, rig.poses)
        return made.changed(**self._make_start(rig, made, own))

    def _list_physical(
        self, rig: BodyRig, own: Values, run: Run, numerics: Numerics
    ) -> dict[str, Tensor]:
        given = self.given
        out = {
            name: self._make_field(rig, own, name)
            for name in ("youngs_modulus", "poissons_ratio", "density")
        }
        coarser = numerics.mesh if given.body.can_refine else 1.0
        out["youngs_modulus"] = out["youngs_modulus"] * self._softness(coarser)
        out |= {name: own[name] for name in CONSTANTS.get(given.material.law, ())}
        out["rayleigh_beta"], out["rayleigh_alpha"] = own["rayleigh_beta"], own["rayleigh_alpha"]
        tilt = torch.stack([own["gravity_roll"], own["gravity_pitch"], torch.zeros(()).double()])
        vector = torch.tensor(given.gravity.vector, dtype=torch.float64)
        is_level = not may_be_differentiated() and not bool(tilt.any())
        out["gravity"] = vector if is_level else matrix_from_rotation_vector(tilt) @ vector
        attached = [
            self._find_mass(i, own, run) * rig.load_shares[i]
            for i, load in enumerate(given.masses)
            if load.acts_as == "mass"
        ]
        if attached:
            out["attached_mass"] = torch.stack(attached).sum(0)
        if given.water is not None:
            out["added_mass"] = own["water_added_mass"] * given.water.density * rig.volume
        stiffness = [
            t.part * own[f"{t.name}_axial_stiffness"]
            if t.axial_stiffness is not None
            else torch.tensor(SOFT_CABLE_N, dtype=torch.float64)
            for t in given.tendons
        ]
        stiffness += [own[f"{m.name}_stiffness"] for m in given.muscles]
        if stiffness:
            out["fiber_stiffness"] = torch.stack(stiffness)
        return out

    def _make_field(self, rig: BodyRig, own: Values, name: str) -> Tensor:
        """A property of the material, one number or one per cell where regions differ."""
        regions = [
            (cells, own[f"{name}_{region.name}"])
            for region, cells in zip(self.given.regions, rig.region_cells, strict=True)
            if getattr(region, name) is not None
        ]
        if not regions:
            return own[name]
        field = own[name].expand(rig.mesh.num_elements)
        for cells, value in regions:
            field = field.index_put((cells,), value.expand(len(cells)))
        return field

    def _find_mass(self, i: int, own: Values, run: Run) -> Tensor:
        """Mass of a load in a run, its share included [kg]."""
        load = self.given.masses[i]
        share = own[f"{load.name}_share"]
        if load.mass is not None:
            return share * own[f"{load.name}_mass"]
        assert load.mass_from is not None
        return share * fact_in(run, load.mass_from, "kg")

    def _sum_hung_mass(self, rig: BodyRig, own: Values, run: Run) -> Tensor | None:
        """(num_nodes,) of what acts by its weight alone [kg]; less than 0: buoyancy."""
        hung = [
            self._find_mass(i, own, run) * rig.load_shares[i]
            for i, load in enumerate(self.given.masses)
            if load.acts_as == "weight"
        ]
        water = self.given.water
        if water is not None and water.buoyant:
            hung.append(-water.density * rig.volume)
        return torch.stack(hung).sum(0) if hung else None

    def _make_command(self, rig: BodyRig, own: Values, run: Run, start: float) -> dict[str, Any]:
        """Commands of a run and what they move."""
        if not self.commands:
            return {}
        times = np.asarray(run.time_s, dtype=np.float64)
        dt = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        count = max(2, int(np.ceil((times[-1] - start) / dt - 1e-9)) + 1)
        grid = start + dt * np.arange(count)
        columns = []
        for name in self.commands:
            given = command_of(run, name)
            known = given.detach().isfinite()
            column = interpolated(torch.from_numpy(grid), times[known.numpy()], given[known])
            lead = self.given.start.lead_in
            if lead > 0.0:
                # the command comes up in the first half of the lead-in
                rise = np.clip((grid - start) / (0.5 * lead), 0.0, 1.0)
                column = column * torch.from_numpy(rise)
            columns.append(column)
        actuate, pressurize = self._make_drives(rig, own)
        return {
            "commands": Commands.named(self.commands, torch.stack(columns)),
            "command_dt": dt,
            "actuate": actuate,
            "pressurize": pressurize if self.given.chambers else None,
        }

    def _make_drives(self, rig: BodyRig, own: Values) -> tuple[Callable[[Tensor], Tensor], ...]:
        """Functions of commands (n, width) that give activations and pressures."""
        given, place = self.given, {name: k for k, name in enumerate(self.commands)}

        def column(u: Tensor, drive: Any) -> Tensor:
            return own[f"{drive.name}_gain"] * u[..., place[drive.command]]

        def activation(u: Tensor) -> Tensor:
            rows = []
            for cable, tendon in zip(given.tendons, rig.tendons, strict=True):
                full = cable.full_length or tendon.rest_length
                rows.append(_compute_stretch(cable.means, column(u, cable), full, cable.part))
            for muscle in given.muscles:
                rows.append(_compute_stretch(_AS_SHARE[muscle.means], column(u, muscle), 1.0, 1.0))
            return torch.stack(rows, -1)

        def pressure(u: Tensor) -> Tensor:
            return torch.stack([column(u, c) for c in given.chambers], -1)

        return activation, pressure

    def _make_start(self, rig: BodyRig, scene: SoftScene, own: Values) -> dict[str, Any]:
        start = self.given.start
        if start.shape != "held":
            return {"start": start.shape}
        activations = scene.activations(1)
        first = None if activations is None else activations[0]
        return {
            "start": "given",
            "start_position": rig.held_shape(scene.parameters, own["start_offset"], first),
            "start_velocity": own["start_speed"] * rig.swing,
        }


_AS_SHARE = {"shortening": "share", "length": "length"}


def _compute_stretch(means: str, u: Tensor, full_length: float, part: float) -> Tensor:
    """Commanded over rest length of a cable or muscle."""
    if means == "shortening":
        return 1.0 - u / full_length
    if means == "share":
        return 1.0 - u
    if means == "length":
        return u / full_length
    return 1.0 - part * u / SOFT_CABLE_N
