"""What a flight may feel besides gravity and ideal rotors: named, optional, differentiable.

Every tensor of an effect may have a leading batch axis, one entry per vehicle, and may carry
gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from diffsim.core.check import require, require_range
from diffsim.core.checked import checked


def _of(kernel: str, shape: tuple[int | str, ...], **limits: float) -> dict[str, Any]:
    """What is said of a field: its name in the kernel, its shape without a batch, its range."""
    return {"kernel": kernel, "shape": shape, "limits": limits}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Effect:
    """An effect of tensors; each field says its own by ``_of``."""

    def __post_init__(self) -> None:
        for one in fields(self):
            value, shape = getattr(self, one.name), one.metadata["shape"]
            batched = isinstance(value, Tensor) and value.dim() == len(shape) + 1
            require(one.name, value, ("batch", *shape) if batched else shape)
            require_range(one.name, value, **one.metadata["limits"])

    @checked(kinds_only=True)
    def row(self, dt: float) -> dict[str, Tensor]:
        """Parameters of the kernel."""
        return {one.metadata["kernel"]: getattr(self, one.name) for one in fields(self)}


@dataclass(frozen=True, kw_only=True, eq=False)
class MotorLag(_Effect):
    """First-order lag of the thrust behind its command: tau s' = command - s, solved exactly.

    Attributes:
        time_constants: tau, (n_rotors,) [s], > 0.
    """

    time_constants: Tensor = field(metadata=_of("lag_decay", ("n_rotors",), above=0.0))

    @checked(kinds_only=True)
    def row(self, dt: float) -> dict[str, Tensor]:
        """Parameters of the kernel."""
        return {"lag_decay": torch.exp(-0.5 * dt / self.time_constants)}


@dataclass(frozen=True, kw_only=True, eq=False)
class ThrustCurve(_Effect):
    """A speed controller that assumes thrust ~ speed^2 on a propeller with thrust ~ speed^p.

    thrust = reference (command / reference)^exponent with exponent = p / 2. Where the command is
    zero, thrust and gradients are zero.

    Attributes:
        exponents: p / 2, (n_rotors,), > 0.
        reference_thrusts: Thrusts at which command and thrust agree, (n_rotors,) [N], > 0.
    """

    exponents: Tensor = field(metadata=_of("curve_exponent", ("n_rotors",), above=0.0))
    reference_thrusts: Tensor = field(metadata=_of("curve_reference", ("n_rotors",), above=0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class RotorDrag(_Effect):
    """In-plane force of a rotor in cross flow: -k thrust (velocity of the hub across its axis)."""

    # k, () [s/m], >= 0 (Mahony, Kumar, Corke 2012, blade flapping and induced drag)
    coefficient: Tensor = field(metadata=_of("rotor_drag", (), at_least=0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyDrag(_Effect):
    """Drag at the center of mass along the body's axes: -(linear + quadratic |a|) a.

    Attributes:
        linear: (3,) [N s/m], >= 0.
        quadratic: (3,) [N s^2/m^2], >= 0.
    """

    linear: Tensor = field(metadata=_of("drag_linear", (3,), at_least=0.0))
    quadratic: Tensor = field(metadata=_of("drag_quadratic", (3,), at_least=0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundEffect(_Effect):
    """More thrust near level ground: times 1 / (1 - k (radius / 4 height)^2) for every rotor.

    Cheeseman and Bennett 1955 has k = 1. Below half a radius the height counts as that (zero
    gradient). The ground does not stop the vehicle.

    Attributes:
        coefficient: k, (), 0 to 3.
        terrain_height: Height of the ground above the origin, () [m], up positive.
    """

    coefficient: Tensor = field(metadata=_of("ground_coefficient", (), at_least=0.0, at_most=3.0))
    terrain_height: Tensor = field(metadata=_of("terrain_height", ()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Interference(_Effect):
    """Thrust that rotors take from one another: thrust_i -= sum_j losses_ij thrust_j."""

    # (n_rotors, n_rotors), 0 to 1; a coaxial pair has the loss of the lower rotor at (lower, upper)
    losses: Tensor = field(
        metadata=_of("interference", ("n_rotors", "n_rotors"), at_least=0.0, at_most=1.0)
    )

    def row(self, dt: float) -> dict[str, Tensor]:
        """Parameters of the kernel."""
        return {"interference": self.losses.flatten(-2)}


@dataclass(frozen=True, kw_only=True, eq=False)
class BatterySag(_Effect):
    """Thrust falls with the voltage: times (voltage / nominal)^exponent, the command unchanged.

    current = idle + sum_i a_i s_i^alpha_i from the thrust states s, voltage = open_circuit(charge)
    - resistance current, charge' = -current / capacity. ``Battery.sag`` makes one.
    """

    resistance: Tensor = field(metadata=_of("resistance", (), at_least=0.0))  # () [ohm], >= 0
    capacity: Tensor = field(metadata=_of("inverse_capacity", (), above=0.0))  # () [A s], > 0
    # at which the thrusts are as commanded, () [V], > 0
    nominal_voltage: Tensor = field(metadata=_of("nominal_voltage", (), above=0.0))
    # (); near 2 where the speed is proportional to the voltage, 0 for a controller that makes up
    # for the voltage
    exponent: Tensor = field(metadata=_of("sag_exponent", (), at_least=0.0))
    # coefficients of V = sum_j c_j charge^j, (4,) [V]
    open_circuit: Tensor = field(metadata=_of("open_circuit", (4,)))
    # a_i, (n_rotors,), A per N^alpha, >= 0
    current_coefficients: Tensor = field(
        metadata=_of("current_coefficient", ("n_rotors",), at_least=0.0)
    )
    # alpha_i, (n_rotors,), > 0
    current_exponents: Tensor = field(metadata=_of("current_exponent", ("n_rotors",), above=0.0))
    # current of rotors at no thrust and everything else on board, () [A], >= 0
    idle_current: Tensor = field(metadata=_of("idle_current", (), at_least=0.0))

    def row(self, dt: float) -> dict[str, Tensor]:
        """Parameters of the kernel."""
        return super().row(dt) | {"inverse_capacity": 1.0 / self.capacity}


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightEffects:
    """The effects that a flight has; None is absent, and costs nothing.

    Attributes:
        motor_lag: Thrust behind its command.
        thrust_curve: Thrust against speed with an exponent other than two.
        rotor_drag: In-plane force of the rotors.
        body_drag: Linear and quadratic drag.
        wind: World frame, (3,) steady, (steps, 3) a gust's series held over each control step, or
            (batch, steps, 3) [m/s]. Felt through the drags only.
        ground_effect: More thrust near the ground.
        interference: Thrust that rotors take from one another.
        battery: Voltage sag.
    """

    motor_lag: MotorLag | None = None
    thrust_curve: ThrustCurve | None = None
    rotor_drag: RotorDrag | None = None
    body_drag: BodyDrag | None = None
    wind: Tensor | None = None
    ground_effect: GroundEffect | None = None
    interference: Interference | None = None
    battery: BatterySag | None = None

    def __post_init__(self) -> None:
        if self.wind is not None:
            require_wind(self.wind, self.has_drag)

    @property
    def has_drag(self) -> bool:
        """Whether there is something that feels wind."""
        return self.rotor_drag is not None or self.body_drag is not None

    def present(self) -> Iterator[tuple[str, Any]]:
        """Names and values of those that are there, but for the wind."""
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name != "wind" and value is not None:
                yield one.name, value


def require_wind(wind: Tensor, has_drag: bool) -> Tensor:
    """Check a wind, (3,), (steps, 3) or (batch, steps, 3) [m/s], and that something feels it."""
    require("wind", wind, ("...", 3))
    if wind.dim() > 3:
        raise ValueError(
            f"wind must have shape (3,), (steps, 3) or (batch, steps, 3), got {tuple(wind.shape)}"
        )
    if not has_drag:
        raise ValueError("wind acts through drag; give rotor_drag or body_drag as well")
    return wind
