"""A composed multicopter: free parameters in, meshes and a differentiable vehicle out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.design.assemble import assemble
from diffsim.copter.design.evaluate import PartTensors
from diffsim.copter.design.feasible import FeasibleSet
from diffsim.copter.design.listing import PartEntry, part_entries, placed_meshes
from diffsim.copter.design.placement import PlacedPart, distance_weights
from diffsim.copter.design.spec import DesignSpec
from diffsim.copter.design.spec_file import write_spec
from diffsim.copter.vehicle.mass import rigid_body
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.parts import RotorMount
from diffsim.core.arrays import Array
from diffsim.core.check import require, require_choice, require_constant
from diffsim.core.checked import checked
from diffsim.core.numbers import to_numpy, values_of
from diffsim.core.torch_names import on_constants

_SLACK = 2e-6  # [m], more than the step of a difference quotient at a bound

if TYPE_CHECKING:
    import trimesh


@checked(values=("n_free",))
@dataclass(frozen=True, eq=False)
class Design:
    """Parts with their feasible set and a current point in it.

    All parameters are x = offset + basis @ s with free parameters s, A s <= b (thesis 3.2.2). The
    free parameters are entries of x: ``names`` tells which.

    Attributes:
        spec: What its author wrote.
        parts: All of them, adapters included.
        feasible: Constraints and their elimination.
        values: Current free parameters s, (n_free,) [m].
        bounded: Whether free parameters outside of the feasible set are refused. An optimizer whose
            trial points may lie there switches it off; rods can be negative then.
    """

    spec: DesignSpec
    parts: tuple[PlacedPart, ...]
    feasible: FeasibleSet
    values: Tensor
    bounded: bool = True

    @property
    def name(self) -> str:
        """Name of the design."""
        return self.spec.name

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all parameters x, ``part.parameter``."""
        return self.feasible.names

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters s."""
        return tuple(self.feasible.names[i] for i in self.feasible.free_idx)

    @cached_property
    @on_constants()
    def basis(self) -> Tensor:
        """(n, n_free) of x = offset + basis @ s."""
        return torch.from_numpy(self.feasible.basis)

    @cached_property
    @on_constants()
    def offset(self) -> Tensor:
        """(n,) of x = offset + basis @ s."""
        return torch.from_numpy(self.feasible.offset)

    @cached_property
    @on_constants()
    def inequalities(self) -> tuple[Tensor, Tensor]:
        """A (num_rows, n_free) and b (num_rows,) of A s <= b (thesis eq. 3.10)."""
        return (
            torch.from_numpy(self.feasible.inequality_matrix),
            torch.from_numpy(self.feasible.inequality_bound),
        )

    @property
    def lower(self) -> Tensor:
        """Least value of each free parameter over the feasible set, (n_free,); -inf if none."""
        return torch.from_numpy(self.feasible.bounds[0])

    @property
    def upper(self) -> Tensor:
        """Greatest value of each free parameter over the feasible set, (n_free,); inf if none."""
        return torch.from_numpy(self.feasible.bounds[1])

    @cached_property
    def rotors(self) -> tuple[RotorMount, ...]:
        """Motors in the order in which they joined."""
        return tuple(p.part.rotor_mount for p in self.parts if p.part.rotor_mount is not None)

    @cached_property
    def rotor_names(self) -> tuple[str, ...]:
        """Names of the motor parts, one per rotor."""
        return tuple(p.name for p in self.parts if p.part.rotor_mount is not None)

    @cached_property
    @on_constants()
    def directions(self) -> Tensor:
        """Thrust directions as built, (n_rotors, 3)."""
        rows = [
            p.rotation @ p.part.rotor_mount.direction
            for p in self.parts
            if p.part.rotor_mount is not None
        ]
        return torch.from_numpy(np.array(rows).reshape(-1, 3))

    @cached_property
    @on_constants()
    def spins(self) -> Tensor:
        """b_i as built, (n_rotors,)."""
        return torch.tensor([float(m.spin) for m in self.rotors], dtype=torch.float64)

    @cached_property
    def distance_weights(self) -> Array:
        """Which parameters count as distance: all but the places of what rules inserted."""
        return distance_weights(self.parts)

    @cached_property
    @on_constants()
    def _tensors(self) -> PartTensors:
        return PartTensors(self.parts, self.feasible.names)

    def all_values(self, s: Tensor | None = None) -> Tensor:
        """All parameters x of free ones, (n,), wherever these are."""
        return self.offset + self.basis @ self._free(s)

    def _possible_values(self, s: Tensor | None) -> Tensor:
        """All parameters x of free ones in the feasible set, (n,)."""
        if s is not None and self.bounded and not torch.compiler.is_compiling():
            self._require_feasible(values_of(self._free(s)))
        return self.all_values(s)

    @checked
    def value(self, name: str, s: Tensor | None = None) -> float:
        """One parameter by name [m]."""
        values = to_numpy("s", self.all_values(s))
        return float(values[self._index(name)])

    def multicopter(
        self,
        s: Tensor | None = None,
        directions: Tensor | None = None,
        spins: Tensor | None = None,
    ) -> Multicopter:
        """Mass properties and rotors (thesis eqs. 3.2-3.5).

        Args:
            s: Free parameters, (n_free,) [m]; the current ones if None.
            directions: Unit thrust directions, (n_rotors, 3); as built if None. They turn the
                thrust about the propeller's center, nothing else: motors' mass stays where it is,
                as in the thesis, where d enters M_f and M_t only. ``with_directions`` rebuilds.
            spins: b_i, (n_rotors,), +1 or -1; as built if None.

        Returns:
            The vehicle. Gradients: s, directions, spins.

        Raises:
            ValueError: wrong shapes, no rotors, s is not in the feasible set.
        """
        if not self.rotors:
            raise ValueError(f"design {self.name!r} has no motor; add a part of kind 'motor'")
        x = self._possible_values(s)
        mass, com, inertia = rigid_body(self._tensors.moments(x))
        data = [mount.rotor for mount in self.rotors]

        def of_rotors(key: str) -> Tensor:
            return torch.tensor([getattr(d, key) for d in data], dtype=torch.float64)

        return Multicopter(
            mass=mass,
            inertia=inertia,
            positions=self._tensors.rotor_positions(x) - com,
            directions=self.directions if directions is None else directions,
            spins=self.spins if spins is None else spins,
            torque_ratios=of_rotors("torque_ratio"),
            max_thrusts=of_rotors("max_thrust"),
            radii=of_rotors("radius"),
            rotor_models=tuple(d.name for d in data),
        )

    def center_of_mass(self, s: Tensor | None = None) -> Tensor:
        """In the design's frame, (3,) [m]. Gradient: s."""
        return rigid_body(self._tensors.moments(self._possible_values(s)))[1]

    def mass(self, s: Tensor | None = None) -> Tensor:
        """() [kg] (thesis eq. 3.19). Gradient: s."""
        return self._tensors.moments(self._possible_values(s)).mass.sum()

    def cost(self, s: Tensor | None = None) -> Tensor:
        """Price of all parts, () [EUR]; linear in s but for printed frames (thesis eq. 3.18)."""
        x = self._possible_values(s)
        return self._tensors.cost(x, self._tensors.moments(x).mass)

    def size(self, s: Tensor | None = None) -> Tensor:
        """Total length of the rods, () [m]; linear in s (thesis eq. 3.16)."""
        return self._tensors.rod_length(self._possible_values(s))

    def extent(self, s: Tensor | None = None) -> Tensor:
        """Size of the box around the propellers' centers, (3,) [m]."""
        centers = self._tensors.rotor_positions(self._possible_values(s))
        return centers.amax(0) - centers.amin(0)

    @checked
    def closest(self, values: Mapping[str, float]) -> Design:
        """The feasible design closest to the current one in which parameters have these values.

        Distance is Euclidean over shapes and places of the author's parts (thesis 3.2.2); the
        adapters follow. Solved as a QP.

        Args:
            values: By name, free or dependent ones [m].

        Raises:
            ValueError: unknown parameter; offers the closest name.
            InfeasibleDesignError: no such design; names an irreducible set of constraints.
        """
        pinned = {self.feasible.names[self._index(name)]: float(v) for name, v in values.items()}
        target = self.all_values().numpy().copy()
        for name, value in pinned.items():
            target[self.feasible.names.index(name)] = value
        return self.with_values(
            torch.from_numpy(self.feasible.closest(target, self.distance_weights, pinned))
        )

    def with_values(self, s: Tensor) -> Design:
        """The same design at other free parameters.

        Raises:
            ValueError: outside the feasible set; names the worst constraint.
        """
        require_constant("s", s, "multicopter(s), mass(s) and the like carry gradients")
        s = self._free(s).detach().clone()
        self._require_feasible(s)
        return replace(self, values=s)

    def with_directions(self, directions: Tensor) -> Design:
        """Rebuild with motors tilted by compound-angle clips, free parameters kept.

        Args:
            directions: Unit thrust directions, (n_rotors, 3).
        """
        require_constant("directions", directions, "multicopter(s, directions) carries one")
        directions = require("directions", directions, (len(self.rotors), 3)).detach()
        rows = dict(zip(self.rotor_names, directions.tolist(), strict=True))
        return self._rebuilt({name: {"direction": tuple(row)} for name, row in rows.items()})

    def with_spins(self, spins: Tensor) -> Design:
        """Rebuild with propellers that turn the other way where ``spins`` says so.

        Args:
            spins: b_i, (n_rotors,), +1 or -1.

        Raises:
            ValueError: wrong shape, other values.
        """
        require_constant("spins", spins)
        spins = require("spins", spins, (len(self.rotors),)).detach()
        if bool((spins.abs() != 1.0).any()):
            raise ValueError(f"spins must be +1 or -1, got {spins.tolist()}")
        change = (spins != self.spins).tolist()
        turned = [name for name, differs in zip(self.rotor_names, change, strict=True) if differs]
        opposite = {"cw": "ccw", "ccw": "cw"}
        options = {p.name: p.part.options for p in self.parts if p.name in turned}
        return self._rebuilt(
            {
                p.name: {"options": {**p.options, "spin": opposite[str(options[p.name]["spin"])]}}
                for p in self.spec.parts
                if p.name in turned
            }
        )

    def _rebuilt(self, changes: Mapping[str, Mapping[str, Any]]) -> Design:
        """Composed anew with other fields of some parts' specifications, free parameters kept."""
        parts = tuple(replace(p, **changes.get(p.name, {})) for p in self.spec.parts)
        return build_design(replace(self.spec, parts=parts, values=self.named_values()))

    def named_values(self) -> dict[str, float]:
        """Current free parameters by name [m]."""
        values = require("values", self.values, (len(self.names),))
        return dict(zip(self.names, to_numpy("values", values).tolist(), strict=True))

    def meshes(
        self, s: Tensor | None = None, directions: Tensor | None = None
    ) -> dict[str, trimesh.Trimesh]:
        """Closed surfaces of all parts in the design's frame (NED) [m].

        Args:
            s: Free parameters, (n_free,); the current ones if None.
            directions: Thrust directions, (n_rotors, 3), to draw motors and propellers tilted.
        """
        x = to_numpy("s", self._possible_values(s))
        return placed_meshes(self.parts, dict(zip(self.all_names, x, strict=True)), directions)

    def bill_of_materials(self, s: Tensor | None = None) -> tuple[PartEntry, ...]:
        """Every part with mass and price."""
        x = self._possible_values(s).detach()
        masses = to_numpy("s", self._tensors.moments(x).mass).tolist()
        values = to_numpy("s", x).tolist()
        return part_entries(self.parts, dict(zip(self.all_names, values, strict=True)), masses)

    @checked
    def save(self, path: str | Path) -> Path:
        """Write the design with its current values as YAML, atomically."""
        return write_spec(replace(self.spec, values=self.named_values()), path)

    def _free(self, s: Tensor | None) -> Tensor:
        return self.values if s is None else require("s", s, (len(self.names),))

    def _require_feasible(self, s: Tensor) -> None:
        """Refuse free parameters outside of A s <= b; (n_free,), or more as torch.func maps."""
        rows = self.feasible.inequality_matrix
        points = np.array(s.reshape(-1, len(self.names)).tolist())
        slack = points @ rows.T - self.feasible.inequality_bound
        if not slack.size or float(slack.max()) <= _SLACK:
            return
        _, row = np.unravel_index(int(slack.argmax()), slack.shape)
        raise ValueError(
            f"s violates '{self.feasible.inequality_labels[row]}' by {float(slack.max()):.3g} m; "
            "use closest(...) to stay feasible"
        )

    def _index(self, name: str) -> int:
        if name in self.feasible.names:
            return self.feasible.names.index(name)
        part, _, parameter = name.partition(".")
        require_choice("part", part, [p.name for p in self.parts])
        known = [n.partition(".")[2] for n in self.feasible.names if n.startswith(f"{part}.")]
        require_choice(f"parameter of {part}", parameter, known)
        raise AssertionError("unreachable: every part's parameters are listed")


@checked
def build_design(spec: DesignSpec) -> Design:
    """Compose a design and start it at the feasible point closest to what its author gave.

    Raises:
        ValueError: unknown names, parts that face the wrong way or are connected to nothing.
        MeshError: a part that is not closed.
        InfeasibleDesignError: constraints that exclude each other, with an irreducible set.
    """
    return Design(spec, *assemble(spec))
