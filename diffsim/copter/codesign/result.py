"""What a co-design run hands back, and what it could not do."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError


@checked(kinds_only=True)
@dataclass(frozen=True)
class StartRecord:
    """How one start went.

    Attributes:
        spins: (n_rotors,).
        value: Objective, relative; infinite if infeasible.
        violation: Relative violation of the constraints [-].
        status: Status of the solver.
        num_iters: Number of iterations of the solver.
        seconds: Wall time [s].
    """

    spins: tuple[float, ...]
    value: float
    violation: float
    status: str
    num_iters: int
    seconds: float


@checked(kinds_only=True)
@dataclass(frozen=True)
class CoDesignResult:
    """An optimized design and the record of its search.

    Attributes:
        s: Shape parameters, (num_params,).
        directions: (n_rotors, 3).
        spins: (n_rotors,).
        thrusts: Thrusts in hover, (n_rotors,) [N].
        attitude: Roll and pitch in hover, (2,) [rad].
        vehicle: The multicopter.
        objective: Weighted relative metrics.
        metrics: Values of the metrics, in relative units.
        max_weight: Largest overall weight that hovers (with the authority demanded) [N].
        bound: No design of the space is better than this; -inf if none was computed.
        history: Objective after each iteration of the best start.
        seconds_history: Wall time after each of them [s].
        hover_residual: Imbalance of the vehicle, relative to m g and m g L.
        feasible: Hover and all constraints are kept.
        status: One line of what happened.
        method: joint or alternating.
        seconds: Wall time of the whole run [s].
        starts: One record each.
        warnings: What the user should know.
    """

    s: Tensor
    directions: Tensor
    spins: Tensor
    thrusts: Tensor
    attitude: Tensor
    vehicle: Multicopter
    objective: float
    metrics: dict[str, float]
    max_weight: float
    bound: float
    history: list[float]
    seconds_history: list[float]
    hover_residual: float
    feasible: bool
    status: str
    method: str
    seconds: float
    starts: list[StartRecord]
    warnings: list[str] = field(default_factory=list)

    @property
    def gap(self) -> float:
        """How much better than this any design could be, relative to the objective."""
        return (self.objective - self.bound) / max(abs(self.objective), 1e-12)

    @property
    def max_payload(self) -> float:
        """Largest payload at the center of mass [kg]."""
        return self.max_weight / GRAVITY - float(self.vehicle.mass)

    @property
    def tilts(self) -> Tensor:
        """Angles of the rotors from up, (n_rotors,) [rad]."""
        return torch.arccos((-self.directions[:, 2]).clamp(-1.0, 1.0))

    def summary(self) -> str:
        """A few lines for a person."""
        lines = [
            f"{self.method}: {self.status}",
            f"objective {self.objective:.6g}, no design below {self.bound:.6g} "
            f"(gap {100.0 * self.gap:.3g} %)",
            f"mass {float(self.vehicle.mass):.4g} kg, lifts {self.max_weight:.4g} N overall "
            f"(payload {self.max_payload:.4g} kg), largest tilt "
            f"{np.degrees(float(self.tilts.max())):.3g} deg",
            f"hover residual {self.hover_residual:.1e}, {self.seconds:.3g} s, "
            f"{len(self.starts)} starts",
        ]
        return "\n".join(lines + [f"warning: {w}" for w in self.warnings])


def attitude_of(gamma: Array) -> Array:
    """Roll and pitch of gravity's direction in the body frame, gamma = R' (0, 0, 1)."""
    pitch = -np.arcsin(np.clip(gamma[0], -1.0, 1.0))
    return np.array([np.arctan2(gamma[1], gamma[2]), pitch])


class CoDesignError(DiffsimError):
    """No design, or none that hovers, lies in the space searched.

    Attributes:
        residual: Distance of the best candidate from feasibility, in the unit that the message
            names.
    """

    def __init__(self, message: str, *, residual: float):
        super().__init__(message)
        self.residual = residual
