"""Topmost keys of ``model: {system: multicopter}``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.channel_groups import CLOCKS
from diffsim.core.schema_numbers import Hertz, Meters, Newtons
from diffsim.core.schema_paths import PathInside
from diffsim.systems.description import Description
from diffsim.systems.multicopter.keys import (
    CommandKeys,
    EstimatorKeys,
    FrameKeys,
    InertiaKeys,
    NuisanceKeys,
    PlaceKeys,
    RotorKeys,
    SensorKeys,
    ThrustKeys,
    WindowKeys,
)
from diffsim.systems.quantities import Frequency, Length, Plain, PositiveMass, Time


class MulticopterKeys(Description):
    """All keys of a described multicopter."""

    system: Literal["multicopter"] = Field(description="multicopter")
    frames: FrameKeys = Field(description="Frames of the recordings and of all places")
    design: PathInside | None = Field(
        None,
        description="Name of a shipped design, or a design file beside study.yaml; gives mass, "
        "inertia, rotors and propellers",
    )
    mass: PositiveMass | None = Field(
        None, description="Mass [kg]; a load is the fact `payload_kg` of a run's `setup`"
    )
    inertia: InertiaKeys | None = Field(
        None, description="[xx, yy, zz] or [xx, yy, zz, xy, xz, yz] about the center of mass"
    )
    center_of_mass: PlaceKeys = Field(
        PlaceKeys(), description="[x, y, z] in the frame that rotors are placed in [m]"
    )
    rotors: tuple[RotorKeys, ...] = Field((), description="One entry per rotor")
    thrust: ThrustKeys | None = Field(None, description="Thrust of a rotor by its command")
    rotor_model: str | None = Field(
        None, description="Name of a shipped rotor: gives thrust, torque and radius by its speed"
    )
    torque_ratio: Length | None = Field(None, description="Reaction torque over thrust [m]")
    torque_coefficient: float | None = Field(
        None, ge=0, description="In its place: torque over u^exponent, as `thrust.coefficient`"
    )
    radius: Meters | None = Field(None, gt=0, description="Radius of the propellers [m]")
    max_thrust: Newtons | None = Field(
        None, gt=0, description="Greatest thrust of a rotor: commands beyond give no more [N]"
    )
    thrust_gain: Plain | None = Field(
        None, description="Factor on all thrusts; default 1 to 5 %, held if the coefficient is not"
    )
    torque_gain: Plain | None = Field(
        None, description="Factor on reaction torques; default 1 to 20 %, held if the ratio is not"
    )
    inertia_gain: Plain | None = Field(
        None, description="Factor on the inertia; default 1 to 10 %, held if an entry is not"
    )
    motor_lag: Time | None = Field(
        None,
        description="Time constant of the motors behind their command [s]; default: none, and a "
        "candidate cause",
    )
    lag_of: Literal["thrust", "speed"] | None = Field(
        None, description="What lags; default: the thrust if it is commanded, else the speed"
    )
    sling_length: Length | None = Field(
        None, description="String of a load that may hang below [m]; default 0.5 to 60 %"
    )
    gust_frequency: Frequency | None = Field(
        None, description="Of a gust that there may be [Hz]; default: as the records suggest"
    )
    commands: CommandKeys = Field(description="Recorded commands of the rotors")
    estimator: EstimatorKeys | None = Field(
        None,
        description="Velocity and attitude are those of a state estimator on board that is told "
        "the position: that it knows no drag is a candidate cause",
    )
    battery: str | None = Field(None, description="Command that is the battery's voltage [V]")
    sensors: SensorKeys = Field(description="Channels by what they measure")
    rate: Hertz | None = Field(
        None,
        gt=0,
        description="Samples per second that the records are brought to [Hz]; default: as "
        "recorded, made even where they are not",
    )
    causes_act_in: dict[str, str | float] = Field(
        {},
        description="Facts of `setup`, such as {propeller: cut}: candidate causes act only in runs "
        "that state them. The other runs show what the vehicle is without",
    )
    clocks: dict[str, Time] = Field({}, description=CLOCKS)
    windows: WindowKeys = Field(WindowKeys(), description="Windows of the fit")
    nuisances: NuisanceKeys = Field(NuisanceKeys(), description="Offsets and clocks")

    @model_validator(mode="after")
    def _check_vehicle(self) -> MulticopterKeys:
        if self.design is None:
            missing = [k for k in ("mass", "inertia", "rotors") if not getattr(self, k)]
            if missing:
                raise ValueError(f"without a design, {', '.join(missing)} must be given")
            if not self.rotor_model and (self.torque_ratio is None) == (
                self.torque_coefficient is None
            ):
                raise ValueError("give torque_ratio or torque_coefficient (one of them)")
        elif self.inertia is not None or self.rotors:
            raise ValueError("design gives inertia and rotors; leave these keys out")
        meaning = self.commands.meaning
        if meaning == "pulse" and self.rotor_model is None:
            raise ValueError("pulse needs rotor_model; or give throttle with low and high")
        if meaning == "throttle" and self.thrust is None:
            raise ValueError("throttle needs thrust: {coefficient, exponent} or a curve")
        if meaning == "speed" and self.thrust is None and self.rotor_model is None:
            raise ValueError("speed needs thrust: {coefficient} or rotor_model")
        if self.commands.per_voltage is not None and self.battery is None:
            raise ValueError("commands.per_voltage needs battery, the command with the voltage")
        if self.rotors and len(self.rotors) != len(self.commands.columns):
            raise ValueError(
                f"commands.columns names {len(self.commands.columns)} columns for "
                f"{len(self.rotors)} rotors"
            )
        if self.torque_coefficient is not None and (
            self.thrust is None or self.thrust.coefficient is None
        ):
            raise ValueError("torque_coefficient needs thrust.coefficient; give torque_ratio")
        return self
