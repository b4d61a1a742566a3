"""A described soft body under commands of the moment: what a controller steers.

The same scene that predicts recordings, step by step: body, water, walls, weights and drives are
those of ``model: {system: soft_body}``; a command is held over a step in place of a recorded one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.contact import check_clear
from diffsim.core.errors import ConvergenceError, FactorizationError
from diffsim.data.study import Run
from diffsim.identify.numerics import Numerics
from diffsim.soft.integrators import WITH_CONTACT
from diffsim.soft.step import step_in_water
from diffsim.systems.description import BaseParameters
from diffsim.systems.soft_body.body_keys import SoftBodyKeys
from diffsim.systems.soft_body.described import DescribedModel
from diffsim.systems.soft_body.keys import DescribedMuscle, DescribedTendon, Drive
from diffsim.systems.soft_body.readings import Look, Reading, look_of
from diffsim.systems.soft_body.scene import Moment, SoftScene

#: Physical parameters that episodes may scale, by what the factor is called.
SCALED = {"stiffness": "youngs_modulus", "density": "density"}


@dataclass(frozen=True, eq=False)
class DescribedRobot:
    """A soft body of a description, ready to be steered."""

    scene: SoftScene  # the body with its parameters, drives, fluid, walls and weights
    look: Look  # markers and where they are on the mesh
    commands: tuple[str, ...]  # names of the commands
    units: tuple[str, ...]  # unit of each command
    # the body of each member of a batch, where they differ; empty: all are ``scene``
    members: tuple[SoftScene, ...] = ()

    @classmethod
    def read(
        cls,
        given: SoftBodyKeys,
        folder: Path | None,
        setup: Mapping[str, Any] | None = None,
        numerics: Numerics | None = None,
    ) -> DescribedRobot:
        """Build what a description says; numbers with a prior are at their best guess.

        Args:
            given: Keys of ``model: {system: soft_body}``.
            folder: Folder that its files are relative to.
            setup: Facts that the keys ask for, as a run of a study states them.
            numerics: Factors on time step, mesh and tolerance; None: those of the description.

        Raises:
            ValueError: nothing drives the body; it is quasi-static; regions or markers that are not
                in it; walls with an integrator that has no contact. Begins with the key.
        """
        if not given.commands:
            raise ValueError("model: nothing drives the body; give tendons, muscles or chambers")
        if given.numerics.motion != "dynamic":
            raise ValueError(
                f"model.numerics.motion must be dynamic to be steered, got {given.numerics.motion}"
            )
        if given.walls and given.numerics.integrator not in WITH_CONTACT:
            raise ValueError(
                f"model.numerics.integrator must be one of {', '.join(WITH_CONTACT)} where there "
                f"are walls, got {given.numerics.integrator}"
            )
        times = np.array([0.0, given.numerics.time_step])
        still = {name: np.zeros(2) for name in given.commands}
        run = Run("task", times, np.full((2, 0), np.nan), still, "task", setup=dict(setup or {}))
        parameters = BaseParameters(given.quantities(), [run])
        guess = {p.name: torch.tensor(p.value, dtype=torch.float64) for p in parameters.base}
        described = DescribedModel(
            given.model_copy(update={"channels": {}}), folder, (), parameters
        )
        scene = described.build(guess, run, numerics or Numerics())
        every = [(name, Reading(markers=(name,), axis="x")) for name in given.markers]
        look = look_of(scene.body.mesh, given.markers, every)
        units = tuple(_unit_of(name, given) for name in given.commands)
        made = cls(scene, look, given.commands, units)
        if scene.obstacles:
            x = scene.body.x_rest if scene.start_position is None else scene.start_position
            check_clear(list(scene.obstacles), scene.body.mesh, x)
        return made

    @property
    def body(self) -> soft.SoftBody:
        """Mesh, material, muscles, time step."""
        return self.scene.body

    @property
    def is_pushed(self) -> bool:
        """Whether a force is evaluated in every step: of the fluid, of what hangs."""
        return bool(self.scene.makers) or self.scene.water is not None

    def start(self, command: Tensor) -> soft.State:
        """State in which the body starts under a command, (num_nodes, 3).

        Args:
            command: (num_commands,), each in its unit.

        Raises:
            ValueError: it has no equilibrium.
        """
        physics = self.physics({})
        commands = replace(self.scene.commands, values=command.expand(2, -1).mT)
        held = self.scene.changed(commands=commands, command_dt=self.body.dt)
        activations = held.activations(1)
        first = None if activations is None else activations[0]
        try:
            return held.initial_state(first, physics)
        except (FactorizationError, ConvergenceError) as error:
            raise ValueError(
                f"model.start.shape: no equilibrium to start from ({error}); a body that nothing "
                "holds needs `start: {shape: rest}`"
            ) from error

    def physics(self, factors: Mapping[str, Tensor]) -> soft.Physics:
        """Parameters of the body.

        Args:
            factors: Factor of each member of a batch, (batch,), by the names of ``SCALED``.
        """
        values = dict(self.scene.parameters)
        batch = len(self.members) or next((len(f) for f in factors.values()), None)
        for name in values if self.members else ():
            each = torch.stack([scene.parameters[name] for scene in self.members])
            # a column, so that members are not taken for elements; mass damping knows no elements
            values[name] = each[:, None] if each.ndim == 1 and name != "rayleigh_alpha" else each
        for name, factor in factors.items():
            values[SCALED[name]] = factor[:, None] * values[SCALED[name]]
        return self.body.physics(batch=batch, **values)

    def force(
        self, state: soft.State, current: Tensor | None = None, gain: Tensor | None = None
    ) -> Tensor:
        """Force of fluid and weights at a state, shape of x [N].

        Args:
            state: x, v (batch, num_nodes, 3).
            current: Velocity of the fluid beside the description's, (batch, 3) [m/s].
            gain: Factor on drag and thrust, (batch,).
        """

        def of_one(scene: SoftScene, *given: Tensor | None) -> Tensor:
            x, v, flow, factor = given
            assert x is not None and v is not None
            moment = Moment(x, v, 0.0, self.body.dt)
            total = torch.zeros_like(x)
            for make in scene.makers:
                total = total + make()(scene, moment)
            if scene.water is None:
                return total
            moving = scene.current if flow is None else scene.current + flow
            wet = scene.water(x, v, water_velocity=moving)
            return total + (wet if factor is None else factor[:, None, None] * wet)

        return self._each(of_one, state.x, state.v, current, gain)

    def activation(self, command: Tensor) -> Tensor | None:
        """Activations of tendons and muscles under commands (..., num_commands)."""
        if self.scene.actuate is None or not self.body.muscles.num_muscles:
            return None
        return self._each(lambda scene, u: scene.actuate(u), command)

    def pressure(self, command: Tensor) -> Tensor | None:
        """Pressures of the chambers under commands (..., num_commands) [Pa]."""
        if self.scene.pressurize is None:
            return None
        return self._each(lambda scene, u: scene.pressurize(u), command)

    def _each(self, of_one: Callable[..., Tensor], *given: Tensor | None) -> Tensor:
        """A function of a scene and rows, for all members of a batch."""
        if not self.members:
            return of_one(self.scene, *given)
        rows = [
            of_one(scene, *(None if g is None else g[k : k + 1] for g in given))
            for k, scene in enumerate(self.members)
        ]
        return torch.cat(rows)

    def step(
        self,
        state: soft.State,
        command: Tensor,
        physics: soft.Physics,
        *,
        current: Tensor | None = None,
        gain: Tensor | None = None,
    ) -> soft.State:
        """One time step.

        Forces of fluid and weights are those at its start. Predictions of recordings extrapolate
        them, which is more exact and needs time steps a quarter as long.

        Args:
            state: x, v (batch, num_nodes, 3).
            command: Held over the step, (batch, num_commands).
            physics: As ``physics`` makes it.
            current, gain: As ``force`` takes them.
        """
        scene = self.scene
        loads = {"activation": self.activation(command), "pressure": self.pressure(command)}
        obstacles = list(scene.obstacles) or None
        if scene.water is not None and not scene.makers and not self.members:
            return step_in_water(
                self.body,
                state,
                scene.water,
                water_velocity=scene.current if current is None else scene.current + current,
                gain=None if gain is None else gain[:, None, None],
                obstacles=obstacles,
                physics=physics,
                **loads,
            )
        force = self.force(state, current, gain) if self.is_pushed else None
        return soft.step(
            self.body, state, external_force=force, obstacles=obstacles, physics=physics, **loads
        )

    def center(self, x: Tensor) -> Tensor:
        """Center of volume at rest weights, (..., 3) [m]."""
        return (self._shares[:, None] * x).sum(-2)

    def attitude(self, x: Tensor) -> Tensor:
        """Mean deformation gradient, (..., 3, 3): its columns are where the body's axes point."""
        rest = self.body.x_rest - self.center(self.body.x_rest)
        weighted = self._shares[:, None] * rest
        return x.mT @ weighted @ torch.linalg.inv(rest.T @ weighted)

    def places(self, x: Tensor) -> Tensor:
        """Where the markers are, (..., num_markers, 3), of nodes (..., num_nodes, 3).

        The same map gives their velocities from those of the nodes.
        """
        return self.look.weights @ x[..., self.look.nodes, :]

    def middle(self, markers: Sequence[str], x: Tensor) -> Tensor:
        """Mean place of some markers, (..., 3) [m]."""
        rows = [self.look.markers.index(name) for name in markers]
        return self.places(x)[..., rows, :].mean(-2)

    def faces(self) -> Tensor:
        """Surface of the body, (num_faces, 3 or 4)."""
        shape = self.body.mesh
        if isinstance(shape, mesh.HexMesh):
            return mesh.surface_quads(shape).faces
        return mesh.surface_triangles(shape).faces

    @property
    def length(self) -> float:
        """Largest extent of the body at rest [m]."""
        x = self.body.x_rest
        return float((x.amax(0) - x.amin(0)).max())

    @property
    def _shares(self) -> Tensor:
        return self.body.nodal_volume / self.body.nodal_volume.sum()


def _unit_of(command: str, given: SoftBodyKeys) -> str:
    """Unit of a command, by the first part that it drives."""
    parts: tuple[Drive, ...] = (*given.tendons, *given.muscles, *given.chambers)
    part = next(p for p in parts if p.command == command)
    if isinstance(part, DescribedMuscle):
        return "-"
    if isinstance(part, DescribedTendon):
        return {"share": "-", "force": "N"}.get(part.means, "m")
    return "Pa"
