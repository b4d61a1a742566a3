"""Mirrored rotors on arms of free length: a design space for any number of pairs and any rotor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffsim.copter.airframe import Airframe
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.core.check import require_number
from diffsim.core.checked import checked

_MIRROR = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
_ROD_COST, _ROTOR_COST, _CORE_COST = 25.0, 40.0, 150.0  # [EUR/m], [EUR], [EUR]; assumed


@checked
@dataclass(frozen=True, kw_only=True)
class ArmSpace:
    """Arms at equal angles, one length per mirrored pair; directions are free to tilt.

    Attributes:
        airframe: Number of pairs, and what it is built of.
        longest: Largest length, in propeller radii.
    """

    airframe: Airframe = field(default_factory=Airframe)
    longest: float = 5.0

    def __post_init__(self) -> None:
        require_number("longest", self.longest * self.airframe.parts.radius, at_least=self.shortest)

    @property
    def names(self) -> Sequence[str]:
        """One per pair, from front to back."""
        return [f"arm_{k}" for k in range(self.airframe.num_pairs)]

    @property
    def shortest(self) -> float:
        """Least length: neighboring discs just pass each other [m]."""
        return self.airframe.parts.radius / math.sin(0.5 * math.pi / self.airframe.num_pairs)

    @property
    def values(self) -> Tensor:
        """Present lengths, (num_pairs,) [m]: a little above the shortest."""
        room = self.longest * self.airframe.parts.radius - self.shortest
        start = self.shortest + 0.05 * room
        return torch.full((self.airframe.num_pairs,), start, dtype=torch.float64)

    @property
    def inequalities(self) -> tuple[Tensor, Tensor]:
        """Lengths between shortest and longest."""
        unit = torch.eye(self.airframe.num_pairs, dtype=torch.float64)
        ends = [self.longest * self.airframe.parts.radius, -self.shortest]
        limits = torch.tensor(ends, dtype=torch.float64)
        return torch.cat([unit, -unit]), limits.repeat_interleave(self.airframe.num_pairs)

    @checked
    def multicopter(
        self, s: Tensor, directions: Tensor | None = None, spins: Tensor | None = None
    ) -> Multicopter:
        """See ``DesignSpace``."""
        count = self.airframe.num_pairs
        angles = math.pi / count * (torch.arange(count, dtype=torch.float64) + 0.5)
        ways = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1)
        right = s[:, None] * ways
        places = torch.cat([right, (right * _MIRROR).flip(0)])
        up = places.new_tensor([[0.0, 0.0, -1.0]]).expand(2 * count, 3)
        vehicle = self.airframe.assembled(places, up)
        if directions is not None:
            vehicle = vehicle.replace(directions=directions)
        return vehicle if spins is None else vehicle.replace(spins=spins)

    @checked
    def size(self, s: Tensor) -> Tensor:
        """See ``DesignSpace``."""
        return 2.0 * s.sum()

    @checked
    def cost(self, s: Tensor) -> Tensor:
        """See ``DesignSpace``."""
        return _CORE_COST + 2 * len(s) * _ROTOR_COST + _ROD_COST * self.size(s)
