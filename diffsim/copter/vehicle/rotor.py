"""Rotors: speed to thrust, torque, current and power; pulse width and voltage to speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim.copter._shipped import read_shipped, shipped
from diffsim.copter.vehicle.effects import MotorLag
from diffsim.core.checked import checked
from diffsim.core.values import amounts, scalar
from diffsim.core.yaml_text import load_yaml

Number = float | Tensor
SIGNAL_LOW, SIGNAL_HIGH = 1000.0, 2000.0  # [us]
_ROUNDING = 1e-6  # [N], which optimizers leave below zero; the smallest rotors push 0.1 N


@dataclass(frozen=True, kw_only=True, eq=False)
class RotorModel:
    """A motor with its propeller and speed controller (thesis 3.3.1). Numbers may be tensors.

    thrust = c speed^p + offset,           torque = lambda thrust,
    current = a thrust^alpha + offset,     speed = g (voltage (duty - duty_0))^b

    with duty from 0 at a pulse of 1000 us to 1 at 2000 us. The speed controller passes on its share
    of the voltage; b would be 1 without load and 1/2 where the load takes all of it.

    Attributes:
        name: Name of the rotor.
        radius: Radius of the propeller [m].
        thrust_coefficient: c [N / (rad/s)^p].
        thrust_exponent: p.
        thrust_offset: Offset of the thrust [N].
        torque_ratio: lambda [m]; None: not measured.
        max_thrust: At full signal and nominal voltage [N].
        current_coefficient: a [A / N^alpha], at the nominal voltage.
        current_exponent: alpha.
        current_offset: Offset of the current [A].
        nominal_voltage: Nominal voltage [V].
        duty_offset: duty_0; negative where the rotor turns at 1000 us already.
        speed_coefficient: g [rad/s / V^b].
        speed_exponent: b.
        time_constant: Time constant of a first-order lag of the thrust [s]; None: unknown.
        mass: Mass of motor and propeller [kg]; None: unknown.
        assumed: Names of the attributes above that were not measured but assumed. Where that of
            the nominal voltage is, b tells of the signal only: at another voltage the map is a
            guess.
    """

    name: str
    radius: Number
    thrust_coefficient: Number
    thrust_exponent: Number
    thrust_offset: Number
    torque_ratio: Number | None
    max_thrust: Number
    current_coefficient: Number
    current_exponent: Number
    current_offset: Number
    nominal_voltage: Number
    duty_offset: Number
    speed_coefficient: Number
    speed_exponent: Number
    time_constant: Number | None = None
    mass: Number | None = None
    assumed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in (
            "radius",
            "thrust_coefficient",
            "thrust_exponent",
            "max_thrust",
            "current_coefficient",
            "current_exponent",
            "nominal_voltage",
            "speed_coefficient",
            "speed_exponent",
        ):
            scalar(name, getattr(self, name), above=0.0)
        for name in ("thrust_offset", "current_offset", "duty_offset"):
            scalar(name, getattr(self, name))
        for name in ("torque_ratio", "time_constant", "mass"):
            if getattr(self, name) is not None:
                scalar(name, getattr(self, name), at_least=0.0)

    def thrust(self, speed: Number) -> Tensor:
        """Thrust [N] at a speed [rad/s], any shape; zero at standstill."""
        speed = amounts("speed", speed, at_most=1e100, hint="unit is rad/s")
        thrust = self.thrust_coefficient * speed**self.thrust_exponent + self.thrust_offset
        return torch.where(speed > 0.0, thrust.clamp(min=0.0), 0.0)

    def speed(self, thrust: Number) -> Tensor:
        """Speed [rad/s] for a thrust [N], any shape; zero for none."""
        thrust = _pushing(thrust)
        lift = (thrust - self.thrust_offset) / self.thrust_coefficient
        turning = (thrust > 0.0) & (lift > 0.0)
        # a base of one where standing still: its power has a finite derivative
        speed = torch.where(turning, lift, 1.0) ** (1.0 / doubles(self.thrust_exponent))
        return torch.where(turning, speed, 0.0)

    def torque(self, thrust: Number) -> Tensor:
        """Reaction torque [N m] at a thrust [N] (thesis eq. 3.1)."""
        if self.torque_ratio is None:
            raise ValueError(
                f"the torque of {self.name} was not measured; replace its torque_ratio by yours"
            )
        return self.torque_ratio * amounts("thrust", thrust)

    def power(self, thrust: Number) -> Tensor:
        """Electrical power [W] at a thrust [N]."""
        return self.nominal_voltage * self.current(thrust)

    @checked
    def current(self, thrust: Number, voltage: Number | None = None) -> Tensor:
        """Current [A] at a thrust [N]; at another voltage [V] the power stays the same."""
        thrust = _pushing(thrust)
        turning = thrust > 0.0
        drawn = torch.where(turning, thrust, 1.0) ** self.current_exponent
        current = self.current_coefficient * torch.where(turning, drawn, 0.0) + self.current_offset
        if voltage is None:
            return current
        return current * self.nominal_voltage / self._voltage(voltage)

    @checked
    def speed_at(self, signal: Number, voltage: Number | None = None) -> Tensor:
        """Speed [rad/s] at a pulse width [us] and battery voltage [V], nominal by default."""
        voltage = self._voltage(voltage)
        duty = (amounts("signal", signal) - SIGNAL_LOW) / (SIGNAL_HIGH - SIGNAL_LOW)
        passed = voltage * (duty - self.duty_offset)
        turning = passed > 0.0
        speed = self.speed_coefficient * torch.where(turning, passed, 1.0) ** self.speed_exponent
        return torch.where(turning, speed, 0.0)

    @checked
    def signal(self, thrust: Number, voltage: Number | None = None) -> Tensor:
        """Pulse width [us] for a thrust [N], 1000 to 2000: what is beyond is out of reach."""
        voltage = self._voltage(voltage)
        share = self.speed(thrust) / self.speed_coefficient
        turning = share > 0.0
        passed = torch.where(turning, share, 1.0) ** (1.0 / doubles(self.speed_exponent))
        duty = self.duty_offset + torch.where(turning, passed, 0.0) / voltage
        return (SIGNAL_LOW + (SIGNAL_HIGH - SIGNAL_LOW) * duty).clamp(SIGNAL_LOW, SIGNAL_HIGH)

    def _voltage(self, voltage: Number | None) -> Tensor:
        """A battery voltage [V], nominal by default."""
        return amounts(
            "voltage", self.nominal_voltage if voltage is None else voltage, above=0.0, hint="in V"
        )


def rotor_names() -> list[str]:
    """Names of the models that come with the package."""
    return list(shipped("vehicle/rotors"))


def rotor_record(name: str) -> dict[str, Any]:
    """All that is known of a model: ``model``, ``fit`` and ``provenance``.

    Raises:
        ValueError: no such model; the message offers the closest names.
    """
    return load_yaml(read_shipped("vehicle/rotors", "name", name), f"{name}.yaml")


def rotor_model(name: str) -> RotorModel:
    """A model that comes with the package, fitted to bench measurements.

    Args:
        name: One of ``rotor_names()``, such as "kde2814_10in".

    Raises:
        ValueError: no such model; the message offers the closest names.
    """
    # pydantic takes a third of a second: only for those who read a file
    from diffsim.copter.vehicle.option_keys import option_keys
    from diffsim.core.schema import read_part

    numbers = rotor_record(name)["model"]
    return RotorModel(**dict(read_part(option_keys(RotorModel), numbers, f"{name}.yaml: model: ")))


@checked
def motor_lag(rotors: Sequence[RotorModel]) -> MotorLag:
    """The lag of a vehicle's motors as an effect of flight, one model per rotor."""
    unknown = [r.name for r in rotors if r.time_constant is None]
    if unknown:
        raise ValueError(f"time_constant of {unknown[0]} is unknown; replace it by yours")
    return MotorLag(time_constants=torch.stack([doubles(r.time_constant) for r in rotors]))


def _pushing(thrust: Number) -> Tensor:
    """A thrust [N]; a negative one, of a reversed rotor, is refused and does not pass for idle."""
    return amounts(
        "thrust", thrust, at_least=-_ROUNDING, hint="unit is N; rotors do not turn backward here"
    )


def doubles(value: Any) -> Tensor:
    """A number, an array or a tensor in float64."""
    return torch.as_tensor(value, dtype=torch.float64)
