"""Keys of a rotor file; ``diffsim.copter.vehicle.rotor.RotorModel`` has the laws."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from diffsim.core.schema import FinitePart
from diffsim.core.schema_numbers import Kilograms, Meters, Newtons, Seconds, Volts


class ModelKeys(FinitePart):
    """Numbers of the laws."""

    name: str = Field(description="Name of the rotor")
    radius: Meters = Field(description="Radius of the propeller [m]")
    thrust_coefficient: float = Field(description="[N / (rad/s)^p]")
    thrust_exponent: float = Field(description="p: power of the speed")
    thrust_offset: Newtons = Field(description="[N]")
    torque_ratio: Meters | None = Field(description="Torque over thrust [m]; null: not measured")
    max_thrust: Newtons = Field(description="At full signal and nominal voltage [N]")
    current_coefficient: float = Field(description="[A / N^alpha], at the nominal voltage")
    current_exponent: float = Field(description="alpha: power of the thrust")
    current_offset: float = Field(description="[A]")
    nominal_voltage: Volts = Field(description="[V]")
    duty_offset: float = Field(description="Duty at which it begins to turn")
    speed_coefficient: float = Field(description="[rad/s / V^b]")
    speed_exponent: float = Field(description="b: power of the voltage passed on")
    time_constant: Seconds | None = Field(None, description="Lag of the thrust [s]")
    mass: Kilograms | None = Field(None, description="Motor and propeller [kg]")
    assumed: tuple[str, ...] = Field((), description="Keys above that were not measured")


class RotorFile(FinitePart):
    """A model with what it was fitted to, as ``diffsim fit-rotors`` writes it."""

    model: ModelKeys = Field(description="Numbers of the laws")
    fit: dict[str, Any] = Field({}, description="Standard errors and residuals of each curve")
    provenance: dict[str, Any] = Field({}, description="Where the measurements come from")
