"""A part: parametric geometry, feasible set, mass, price, patches (thesis 3.2.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from diffsim.copter.vehicle.geometry import LinearMesh, LinearPoints
from diffsim.copter.vehicle.parts.rotors import RotorData
from diffsim.copter.vehicle.patches import Patch
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.mesh.closed_surface import closed_surface

Source = Literal["bought", "cut", "printed"]


@checked
@dataclass(frozen=True)
class Parameter:
    """A shape parameter.

    Attributes:
        name: Such as ``length``.
        value: Starting value [m].
        lower, upper: Bounds of the feasible set [m].
        meaning: Its meaning, as listings print it.
    """

    name: str
    value: float
    lower: float = 0.0
    upper: float = math.inf
    meaning: str = ""


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class RotorMount:
    """What makes a part a motor; the thrust acts at the part's origin.

    Attributes:
        rotor: The propeller and motor.
        direction: Direction of the thrust in the part's frame, (3,).
        spin: +1 for a propeller that turns clockwise seen against its thrust, else -1.
    """

    rotor: RotorData
    direction: Array
    spin: int


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Part:
    """One part; its frame is turned and moved by the design, never scaled.

    Attributes:
        kind: Name in the database.
        mesh: Closed, vertices linear in the parameters.
        parameters: Shape parameters, in the order of the mesh's basis.
        density: [kg/m^3], of the solid.
        patches: Connecting patches by name.
        price: Constant share [EUR].
        price_per_parameter: Linear share per meter of a parameter, (num_parameters,) [EUR/m].
        price_per_mass: Price per mass of printed parts [EUR/kg].
        source: Procurement: ``bought``, ``cut`` to length, ``printed``.
        rod_parameter: Index of the parameter that counts as length of rod, None if not a rod.
        rows: Further rows A s <= b of the feasible set, (k, num_parameters) and (k,).
        rotor_mount: Mount of the rotor; None for parts that are no motors.
        options: Constant sizes and choices it was made with, for plans and listings.
    """

    kind: str
    mesh: LinearMesh
    density: float
    patches: Mapping[str, Patch]
    parameters: tuple[Parameter, ...] = ()
    price: float = 0.0
    price_per_parameter: tuple[float, ...] = ()
    price_per_mass: float = 0.0
    source: Source = "bought"
    rod_parameter: int | None = None
    rows: tuple[Array, Array] | None = None
    rotor_mount: RotorMount | None = None
    options: Mapping[str, object] = field(default_factory=dict)

    @property
    def values(self) -> Array:
        """Starting values of the parameters, (num_parameters,) [m]."""
        return np.array([p.value for p in self.parameters])

    @property
    def feasible(self) -> tuple[Array, Array]:
        """A s <= b of the part's own parameters: bounds and further rows."""
        n = len(self.parameters)
        eye = np.eye(n)
        upper = [i for i, p in enumerate(self.parameters) if math.isfinite(p.upper)]
        lower = [i for i, p in enumerate(self.parameters) if math.isfinite(p.lower)]
        a = [eye[upper], -eye[lower]]
        b = [
            np.array([self.parameters[i].upper for i in upper]),
            -np.array([self.parameters[i].lower for i in lower]),
        ]
        if self.rows is not None:
            a.append(self.rows[0])
            b.append(self.rows[1])
        return np.concatenate(a), np.concatenate(b)

    @checked
    def with_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> Part:
        """The part with narrower bounds of some parameters [m].

        Raises:
            ValueError: wider than the database's, within which the part can be made.
        """
        parameters = []
        for p in self.parameters:
            lower, upper = bounds.get(p.name, (p.lower, p.upper))
            if not p.lower <= lower <= upper <= p.upper:
                raise ValueError(
                    f"bounds of {p.name} must lie in [{p.lower:g}, {p.upper:g}], got "
                    f"[{lower:g}, {upper:g}]"
                )
            parameters.append(replace(p, lower=lower, upper=upper))
        return replace(self, parameters=tuple(parameters))

    def require_start(self) -> None:
        """Refuse starting values outside the bounds, which would be moved without a word.

        Raises:
            ValueError: names the parameter.
        """
        for p in self.parameters:
            if not p.lower - 1e-9 <= p.value <= p.upper + 1e-9:
                raise ValueError(
                    f"{p.name} must lie in its bounds [{p.lower:g}, {p.upper:g}], got {p.value:g}"
                )

    @checked
    def require_closed(self, name: str) -> None:
        """Refuse geometry without an inside.

        Raises:
            MeshError: the mesh has holes or encloses no volume; names the part.
        """
        import trimesh

        surface = trimesh.Trimesh(
            self.mesh.vertices.at(self.values), self.mesh.faces, process=False
        )
        try:
            # a file's triangles are asked whether they cross when it is read
            closed_surface(surface, may_cross=True)
        except MeshError as error:
            raise MeshError(
                f"part {name!r} ({self.kind}) is not closed, its mass is undefined: {error}",
                error.indices,
            ) from error
        if surface.volume <= 0.0:
            raise MeshError(
                f"part {name!r} ({self.kind}) is inside out (volume {surface.volume:.3g} m^3); "
                "turn its triangles around"
            )


def density_of(mesh: LinearMesh, mass: float) -> float:
    """Density that gives a mesh without parameters this mass [kg/m^3]."""
    vertices = mesh.vertices.at(np.zeros(0))
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    return mass / (float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0)


def linear_center(constant: Array, basis: Array) -> LinearPoints:
    """A patch's center, (3,) and (3, num_parameters) [m]."""
    return LinearPoints(np.asarray(constant, dtype=np.float64), np.asarray(basis, np.float64))


PartMaker = Callable[..., Part]
