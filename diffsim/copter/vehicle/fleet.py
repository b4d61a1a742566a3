"""Many multicopters of equal rotor count as tensors with a leading axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import NUMBERS, Multicopter
from diffsim.core.checked import checked


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
