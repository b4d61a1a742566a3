"""A described soft body on one mesh: what its simulations share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffsim import mesh as meshes
from diffsim import soft
from diffsim.core.errors import FactorizationError
from diffsim.core.memo import Memo
from diffsim.soft.hydrodynamics import DRAG_COEFFICIENTS, THRUST_COEFFICIENTS
from diffsim.systems.soft_body.places import spread_evenly
from diffsim.systems.soft_body.readings import look_of, main_axis

if TYPE_CHECKING:
    from collections.abc import Iterator

    from diffsim.systems.soft_body.body_keys import SoftBodyKeys

SMALL = 1e-3  # of the body's length: displacements that are still linear
SOFT_CABLE_N = 0.1  # force per strain of cables whose tension is commanded: far below any body's


@contextmanager
def within(key: str) -> Iterator[None]:
    """Errors that begin with the key of the description that is wrong."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


class BodyRig:
    """The body, who holds it, what it carries and who watches it, on one mesh.

    Args:
        folder: Folder that files are relative to.
        channels: Names of the channels, in the order of the study.
        coarser: Factor on the length of the cells.
        dt_s, rtol: Time step [s] and relative tolerance of its solution.
    """

    def __init__(
        self,
        given: SoftBodyKeys,
        folder: Path | None,
        channels: Sequence[str],
        coarser: float,
        dt_s: float,
        rtol: float,
    ):
        self.given, self._dt, self._rtol = given, dt_s, rtol
        with within("body"):
            self.mesh = given.body.mesh(coarser, folder)
        self.volume = meshes.nodal_volume(self.mesh)
        self.fixed = self._find_fixed()
        self.region_cells = self._find_regions(folder)
        self.tendons = [self._make_tendon(i) for i in range(len(given.tendons))]
        self._chambers = self._make_cavities()
        self._muscles = [*(t.muscle for t in self.tendons), *self._make_fibers()]
        self.body = self._build_body(self.fixed)
        self.load_shares = [
            spread_evenly(self.volume, self._find_nodes(f"masses[{i}].where", m.where))
            for i, m in enumerate(given.masses)
        ]
        self.sliding = None
        if given.sliding is not None:
            self.sliding = spread_evenly(self.volume, self._find_nodes("sliding", given.sliding))
        for i, stop in enumerate(given.stops):
            self._find_nodes(f"stops[{i}].where", stop.where)
        readings = [(name, given.channels[name]) for name in channels]
        self.look = look_of(self.mesh, given.markers, readings)
        self.observe = self.look.places
        self.places = self.look.shares(self.mesh.num_nodes)
        self._seen = {main_axis(r) for _, r in readings if r.axis is not None} or {0, 1, 2}
        self._prepare_holder()
        self._waters: Memo[soft.Hydrodynamics] = Memo(64)
        self.poses: Memo[Tensor] = Memo(256)  # sequences of poses are large
        self._held_shapes: Memo[Tensor] = Memo(256)

    def _find_nodes(self, key: str, region: Any) -> Tensor:
        with within(key):
            found: Tensor = region.nodes(self.mesh)
        return found

    def _find_fixed(self) -> Tensor:
        """(num_nodes, 3) bool."""
        held = torch.zeros(self.mesh.num_nodes, 3, dtype=torch.bool)
        for i, clamp in enumerate(self.given.fixed):
            nodes = self._find_nodes(f"fixed[{i}]", clamp)
            for axis in clamp.axes:
                held[nodes, "xyz".index(axis)] = True
        return held

    def _find_regions(self, folder: Path | None) -> list[Tensor]:
        """Cells of each region of material; the mesh file is read again for its groups, once."""
        found = []
        groups = None
        for i, region in enumerate(self.given.regions):
            if region.where is not None:
                with within(f"regions[{i}].where"):
                    found.append(region.where.elements(self.mesh))
                continue
            assert region.group is not None
            with within(f"regions[{i}].group"):
                groups = groups or self.given.body.groups(folder)
                cells = groups.elements(region.group)
                if not len(cells):
                    raise ValueError(f"none of the cells that are kept is in {region.group!r}")
                found.append(cells)
        return found

    def _make_tendon(self, i: int) -> soft.Tendon:
        cable = self.given.tendons[i]
        stiffness = SOFT_CABLE_N if cable.axial_stiffness is None else cable.axial_stiffness.value
        with within(f"tendons[{i}].path"):
            return soft.Tendon(
                self.mesh, list(cable.path), axial_stiffness=stiffness, slack=not cable.pushes
            )

    def _make_cavities(self) -> list[soft.PressureChamber]:
        made = []
        for i, chamber in enumerate(self.given.chambers):
            with within(f"chambers[{i}].cavity"):
                made.append(soft.PressureChamber.from_cavity(self.mesh, chamber.cavity))
        return made

    def _make_fibers(self) -> list[soft.Muscle]:
        made = []
        for i, muscle in enumerate(self.given.muscles):
            with within(f"muscles[{i}].where"):
                cells = muscle.where.elements(self.mesh)
            made.append(
                soft.Muscle(
                    elements=cells, direction=muscle.direction, stiffness=muscle.stiffness.value
                )
            )
        return made

    def _build_body(self, fixed: Tensor, **changes: Any) -> soft.SoftBody:
        material = self.given.material
        none = torch.zeros_like(self.volume)
        options: dict[str, Any] = {
            "dt": self._dt,
            "integrator": self.given.numerics.integrator,
            "youngs_modulus": material.youngs_modulus.value,
            "poissons_ratio": material.poissons_ratio.value,
            "density": material.density.value,
            "material": material.law,
            "element": self.given.numerics.element,
            "gravity": self.given.gravity.vector,
            "fixed": fixed,
            "muscles": self._muscles,
            "chambers": self._chambers,
            # never a plain zero, which would switch damping off for good
            "damping": soft.Damping(rayleigh_beta=torch.tensor(0.0, dtype=torch.float64)),
            "masses": soft.Masses(attached_mass=none, added_mass=none),
            # [N]: far below what moves a marker by its noise
            "solver": soft.SolverOptions(rtol=self._rtol, atol=1e-11),
        }
        return soft.SoftBody(self.mesh, **(options | changes))

    def _prepare_holder(self) -> None:
        """What is needed of bodies that are held until they start."""
        start = self.given.start
        if start.where is None:
            return
        nodes = self._find_nodes("start.where", start.where)
        held = self.fixed.clone()
        for axis in start.axes:
            held[nodes, "xyz".index(axis)] = True
        self.holder = self._build_body(held)
        direction = torch.tensor(start.direction, dtype=torch.float64)
        self.shift = torch.zeros_like(self.mesh.x_rest)
        self.shift[nodes] = direction / direction.norm()
        length = float((self.mesh.x_rest.amax(0) - self.mesh.x_rest.amin(0)).max())
        moved = self.holder.static_equilibrium(
            dirichlet_target=self.mesh.x_rest + SMALL * length * self.shift,
            physics=self.holder.physics(gravity=torch.zeros(3, dtype=torch.float64)),
        )
        #: displacement of all nodes per displacement of the held ones
        self.swing = (moved.x.detach() - self.mesh.x_rest) / (SMALL * length)

    def held_shape(
        self, parameters: Mapping[str, Tensor], offset: Tensor, activation: Tensor | None
    ) -> Tensor:
        """Places of all nodes while some are held off their unstrained place by ``offset`` [m]."""
        inputs = [*parameters.values(), offset]
        if activation is not None:
            inputs.append(activation)
        if any(v.requires_grad for v in inputs):
            return self._solve_held(parameters, offset, activation)
        key = tuple(float(v) for one in inputs for v in one.flatten())
        return self._held_shapes(key, lambda: self._solve_held(parameters, offset, activation))

    def _solve_held(
        self, parameters: Mapping[str, Tensor], offset: Tensor, activation: Tensor | None
    ) -> Tensor:
        return self.holder.static_equilibrium(
            dirichlet_target=self.mesh.x_rest + offset * self.shift,
            activation=activation,
            physics=self.holder.physics(**parameters),
        ).x

    def water(self, drag: Tensor, thrust: Tensor) -> soft.Hydrodynamics:
        """The fluid, one object for one pair of factors: tangents know equal surroundings by it."""
        if drag.requires_grad or thrust.requires_grad:
            return self._make_water(drag, thrust)
        key = float(drag), float(thrust)
        return self._waters(key, lambda: self._make_water(drag, thrust))

    def _make_water(self, drag: Tensor, thrust: Tensor) -> soft.Hydrodynamics:
        """Published coefficients times factors; no water on planes of symmetry."""
        assert self.given.water is not None
        around = soft.Hydrodynamics(
            self.mesh,
            density=self.given.water.density,
            drag_coefficients=drag * torch.tensor(DRAG_COEFFICIENTS).double(),
            thrust_coefficients=thrust * torch.tensor(THRUST_COEFFICIENTS).double(),
            fade_angle=0.1,  # [rad] of attack, below which the force of the water fades
        )
        inside = torch.zeros(len(around.faces), dtype=torch.bool)
        for clamp in self.given.fixed:
            if len(clamp.axes) == 1 and not isinstance(getattr(clamp, clamp.axes), tuple):
                on_plane = torch.zeros(self.mesh.num_nodes, dtype=torch.bool)
                on_plane[clamp.nodes(self.mesh)] = True
                inside |= on_plane[around.faces].all(1)
        around.faces = around.faces[~inside]
        return around

    def compliance(self) -> float | None:
        """Work of a small even force per volume, in the most compliant direction that a channel
        shows; None: nothing holds the body.

        Scaled so that it is a property of the mesh: force [1], Young's modulus [1].
        """
        bare = self._build_body(
            self.fixed, muscles=(), chambers=(), gravity=(0.0, 0.0, 0.0),
            solver=soft.SolverOptions(rtol=1e-5),
        )  # fmt: skip
        young = self.given.material.youngs_modulus.value
        length = float((self.mesh.x_rest.amax(0) - self.mesh.x_rest.amin(0)).max())
        physics = bare.physics(**self.stiffness_field(torch.tensor(young, dtype=torch.float64)))
        best = 0.0
        for axis in self._seen:
            push = torch.zeros_like(self.mesh.x_rest)
            push[:, axis] = self.volume
            size = 1e-5 * young / length  # force per volume, of Young's modulus per length
            try:
                for _ in range(2):
                    still = bare.static_equilibrium(external_force=size * push, physics=physics)
                    moved = still.x.detach() - self.mesh.x_rest
                    work = float((moved * push).sum()) / size
                    size *= SMALL * length / float(moved.abs().max())
            except FactorizationError:
                return None  # nothing holds it
            best = max(best, work * young)
        return best

    def stiffness_field(self, young: Tensor) -> dict[str, Tensor]:
        """Young's modulus with the regions' own where they are known before a fit."""
        field = young.expand(self.mesh.num_elements).clone()
        for region, cells in zip(self.given.regions, self.region_cells, strict=True):
            if region.youngs_modulus is not None:
                field[cells] = region.youngs_modulus.value
        return {"youngs_modulus": field}


def mesh_softness(coarse: float, fine: float, here: float) -> float:
    """Compliance of a mesh over that of infinitely fine ones, by Richardson's extrapolation.

    Args:
        coarse, fine: Compliance of the stated cells, and of cells half as long.
    """
    return here / (fine + (fine - coarse) / 3.0)
