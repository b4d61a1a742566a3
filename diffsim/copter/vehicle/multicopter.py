"""What the dynamics of a multicopter need to know: of one, or of many with equal rotor count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffsim.core import units
from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.core.module import loadable
from diffsim.core.numbers import values_of
from diffsim.core.values import as_array

GRAVITY = units.GRAVITY  # [m/s^2]

NUMBERS = (
    "mass",
    "inertia",
    "positions",
    "directions",
    "spins",
    "torque_ratios",
    "max_thrusts",
    "radii",
)
"""Fields of a vehicle that are numbers, as the dynamics take them."""


@loadable
@dataclass(frozen=True, eq=False)
class Multicopter:
    """Mass properties and rotors of a multicopter, body frame at the center of mass, NED.

    m p'' = m g + R M_f u and J w' + w x J w = M_t u (thesis eqs. 3.2-3.5): any number of rotors,
    any tilt, coaxial pairs, different propellers. Every tensor may carry gradients; numbers, lists
    and NumPy arrays become tensors.

    Attributes:
        mass: Mass, () [kg].
        inertia: (3, 3) about the center of mass [kg m^2].
        positions: Centers of the rotors relative to the center of mass, (n_rotors, 3) [m].
        directions: Unit directions of thrust d_i, (n_rotors, 3); up is (0, 0, -1).
        spins: b_i, (n_rotors,): +1 where the reaction torque points along the thrust (the propeller
            turns clockwise seen from above an upright rotor), else -1.
        torque_ratios: lambda_i, torque per thrust, (n_rotors,) [m].
        max_thrusts: u_max, (n_rotors,) [N].
        radii: Radii of the propellers, (n_rotors,) [m].
        rotor_models: Names of the rotors' models, one each; empty if unknown.

    Raises:
        TypeError, ValueError: wrong shapes or types, values that are not finite, a mass that is not
            positive, an inertia that is not symmetric positive definite, directions that are not
            unit vectors, spins other than +1 and -1.
    """

    mass: Tensor
    inertia: Tensor
    positions: Tensor
    directions: Tensor
    spins: Tensor
    torque_ratios: Tensor
    max_thrusts: Tensor
    radii: Tensor
    rotor_models: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in NUMBERS:
            object.__setattr__(self, name, as_array(name, getattr(self, name)))
        require("positions", self.positions, ("n_rotors", 3), torch.float64)
        n = self.num_rotors
        shapes: dict[str, tuple[int, ...]] = {
            "mass": (),
            "inertia": (3, 3),
            "positions": (n, 3),
            "directions": (n, 3),
            "spins": (n,),
            "torque_ratios": (n,),
            "max_thrusts": (n,),
            "radii": (n,),
        }
        for name, shape in shapes.items():
            require(name, getattr(self, name), shape, torch.float64)
        if n == 0:
            raise ValueError("a multicopter needs at least one rotor, got none")
        if self.rotor_models and len(self.rotor_models) != n:
            raise ValueError(f"rotor_models names {len(self.rotor_models)} of {n} rotors")
        with torch.no_grad():
            self._require_physical()

    def _require_physical(self) -> None:
        lightest = float(values_of(self.mass).min())
        if not lightest > 0.0:
            raise ValueError(f"mass must be above 0 kg, got {lightest:g}")
        inertia = values_of(self.inertia)
        skew = float((inertia - inertia.mT).abs().max())
        least = float(torch.linalg.eigvalsh(0.5 * (inertia + inertia.mT)).min())
        if skew > 1e-9 * float(inertia.abs().max()) or not least > 0.0:
            raise ValueError(
                "inertia must be symmetric positive definite, got smallest eigenvalue "
                f"{least:g} kg m^2 and asymmetry {skew:g} kg m^2"
            )
        lengths = values_of(self.directions).norm(dim=-1).flatten()
        worst = int((lengths - 1.0).abs().argmax())
        if abs(float(lengths[worst]) - 1.0) > 1e-6:
            raise ValueError(
                f"directions must be unit vectors; that of rotor {worst % self.num_rotors} has "
                f"length {float(lengths[worst]):g}"
            )
        spins = values_of(self.spins)
        if bool((spins.abs() != 1.0).any()):
            raise ValueError(f"spins must be +1 or -1, got {spins.tolist()}")
        for name in ("torque_ratios", "max_thrusts", "radii"):
            entries = values_of(getattr(self, name))
            if bool((entries < 0.0).any()):
                raise ValueError(f"{name} must not be negative, got {entries.tolist()}")

    @property
    def num_rotors(self) -> int:
        """Number of rotors."""
        return self.positions.shape[0]

    @property
    def force_matrix(self) -> Tensor:
        """M_f: thrusts to force in the body frame, (3, n_rotors) (thesis eq. 3.3)."""
        return self.directions.T

    @property
    def torque_matrix(self) -> Tensor:
        """M_t: thrusts to torque about the center of mass, (3, n_rotors) [m] (thesis eq. 3.5)."""
        reaction = (self.spins * self.torque_ratios)[:, None] * self.directions
        return (reaction + torch.linalg.cross(self.positions, self.directions)).T

    @property
    def weight(self) -> Tensor:
        """m g, () [N]."""
        return self.mass * GRAVITY

    def replace(self, **changes: Any) -> Multicopter:
        """A copy with other values."""
        return replace(self, **changes)

    def detach(self) -> Multicopter:
        """A copy that carries no gradients."""
        tensors: dict[str, Any] = {
            f.name: value.detach()
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor)
        }
        return replace(self, **tensors)


@dataclass(frozen=True, eq=False)
class Fleet:
    """What the dynamics need of each; see :class:`Multicopter`, whose checks are not repeated here.

    Every tensor has a leading axis (batch or 1,) and may carry gradients.

    Attributes:
        mass: Mass of each vehicle, (batch,) [kg].
        inertia: Inertia matrix of each vehicle, (batch, 3, 3) [kg m^2].
        positions: Position of each rotor, (batch, n_rotors, 3) [m].
        directions: (batch, n_rotors, 3).
        spins: (batch, n_rotors).
        torque_ratios: Torque over thrust of each rotor, (batch, n_rotors) [m].
        max_thrusts: Largest thrust of each rotor, (batch, n_rotors) [N].
        radii: Radius of each rotor, (batch, n_rotors) [m].
    """

    mass: Tensor
    inertia: Tensor
    positions: Tensor
    directions: Tensor
    spins: Tensor
    torque_ratios: Tensor
    max_thrusts: Tensor
    radii: Tensor

    @classmethod
    @checked
    def of(cls, vehicles: Sequence[Multicopter]) -> Fleet:
        """Stack vehicles of equal rotor count."""
        return cls(*(torch.stack([getattr(v, name) for v in vehicles]) for name in NUMBERS))

    @property
    def num_rotors(self) -> int:
        """Number of rotors of each."""
        return self.positions.shape[1]

    @property
    def reactions(self) -> Tensor:
        """Reaction torque per thrust, (batch, n_rotors, 3) [m]."""
        return (self.spins * self.torque_ratios)[..., None] * self.directions

    @property
    def torque_matrix(self) -> Tensor:
        """M_t: thrusts to torque about the center of mass, (batch, 3, n_rotors) [m]."""
        levers = torch.linalg.cross(*torch.broadcast_tensors(self.positions, self.directions))
        return (self.reactions + levers).mT

    def replace(self, **changes: Any) -> Fleet:
        """A copy with other values."""
        return replace(self, **changes)

    @checked(kinds_only=True)
    def repeated(self, count: int) -> Fleet:
        """Every vehicle ``count`` times in a row; a leading axis of one stays."""
        values = {name: getattr(self, name) for name in NUMBERS}
        return replace(
            self,
            **{k: v.repeat_interleave(count, 0) for k, v in values.items() if v.shape[0] > 1},
        )

    def rows(self) -> dict[str, Tensor]:
        """Parameters of the flight kernel by name, (batch or 1, size)."""
        return {
            "inverse_mass": 1.0 / self.mass[:, None],
            "inertia": self.inertia.flatten(1),
            "inertia_inverse": torch.linalg.inv(self.inertia).flatten(1),
            "arms": self.positions.flatten(1),
            "axes": self.directions.flatten(1),
            "reactions": self.reactions.flatten(1),
            "max_thrusts": self.max_thrusts,
            "radii": self.radii,
        }
