"""Keys of ``model: {system: multicopter}``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from diffsim.causes.channel_groups import CLOCKS
from diffsim.core.inertia import entries_of_matrix, inertia_mistake
from diffsim.core.schema import KindWords, Part
from diffsim.core.schema_numbers import (
    Hertz,
    Meters,
    MetersPerSquareSecond,
    Newtons,
    Radians,
    RadiansPerSecond,
    Ratio,
    Seconds,
    Volts,
)
from diffsim.core.schema_paths import PathInside
from diffsim.core.units import in_si
from diffsim.systems.description import Description, Quantity
from diffsim.systems.quantities import (
    Frequency,
    Inertia,
    Length,
    Plain,
    PositiveInertia,
    PositiveMass,
    Rate,
    Time,
)

_NONE = Quantity(value=0.0)
_INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
Level = Annotated[float, BeforeValidator(lambda given: in_si(given)[0]), KindWords("number")]


class FrameKeys(Part):
    """Frames that the recordings, and all places below, are written in."""

    world: Literal["NED", "ENU", "NWU"] = Field(
        description="What x, y, z of the world are: NED (z down), ENU or NWU (z up). In a room "
        "without a compass take NWU if x points ahead and y to the left"
    )
    body: Literal["FRD", "FLU"] = Field(
        description="What x, y, z of the body are: FRD (forward, right, down) or FLU (forward, "
        "left, up)"
    )


class InertiaKeys(Part):
    """Inertia about the center of mass, along the body's axes."""

    xx: PositiveInertia = Field(description="About x [kg m^2]")
    yy: PositiveInertia = Field(description="About y [kg m^2]")
    zz: PositiveInertia = Field(description="About z [kg m^2]")
    xy: Inertia = Field(_NONE, description="Entry of row x and column y [kg m^2]")
    xz: Inertia = Field(_NONE, description="Entry of row x and column z [kg m^2]")
    yz: Inertia = Field(_NONE, description="Entry of row y and column z [kg m^2]")

    @model_validator(mode="before")
    @classmethod
    def _read_list(cls, given: Any) -> Any:
        return _map_by_name("inertia", entries_of_matrix(given), _INERTIA, (3, 6))

    @model_validator(mode="after")
    def _check_possible(self) -> InertiaKeys:
        entries = [getattr(self, name).value for name in _INERTIA]
        if said := inertia_mistake(entries, _INERTIA):
            raise ValueError(said)
        return self


class PlaceKeys(Part):
    """A point in the body frame."""

    x: Length = Field(_NONE, description="Along the body's x [m]")
    y: Length = Field(_NONE, description="Along the body's y [m]")
    z: Length = Field(_NONE, description="Along the body's z [m]")

    @model_validator(mode="before")
    @classmethod
    def _read_list(cls, given: Any) -> Any:
        return _map_by_name("a place", given, ("x", "y", "z"), (3,))


class RotorKeys(Part):
    """One rotor, in the order of the commands."""

    at: PlaceKeys = Field(
        description="Center of the propeller, in the frame that `center_of_mass` is given in [m]"
    )
    spin: Literal["cw", "ccw"] = Field(
        description="Sense of rotation seen against its thrust (from above, if upright)"
    )
    axis: tuple[float, float, float] | None = Field(
        None, description="Direction of the thrust in the body frame; default: up"
    )
    share: Plain = Field(
        Quantity(value=1.0), description="Its thrust over that of the others, such as 1 [-]"
    )


class ThrustKeys(Part):
    """Thrust of a rotor by its command: coefficient * u^exponent + offset, or a curve.

    u is the command: a thrust [N], a speed [rad/s], or a throttle from 0 to 1.
    """

    coefficient: Quantity | None = Field(
        None, description="Thrust over u^exponent: N s^2 for speeds and exponent 2, N for throttles"
    )
    exponent: float | None = Field(
        None, gt=0, description="Power of u; default 2 for speeds and throttles, 1 for thrusts"
    )
    offset: Newtons = Field(0.0, description="Added to it [N]")
    curve: tuple[tuple[float, float], ...] = Field(
        (), description="In place of a coefficient: rows (u, thrust in N), u rising; straight lines"
    )

    @model_validator(mode="before")
    @classmethod
    def _read_coefficient(cls, given: Any) -> Any:
        if isinstance(given, Mapping) and isinstance(given.get("coefficient"), (int, float, str)):
            return {**given, "coefficient": {"value": float(given["coefficient"])}}
        return given

    one_of: ClassVar = ("coefficient", "curve")

    @model_validator(mode="after")
    def _check_rising(self) -> ThrustKeys:
        if self.curve and any(b[0] <= a[0] for a, b in pairwise(self.curve)):
            raise ValueError("the first column of curve must rise from row to row")
        return self


class CommandKeys(Part):
    """Recorded commands of the rotors."""

    columns: tuple[str, ...] = Field(
        description="Names of the study's commands, one per rotor, in the order of `rotors`"
    )
    meaning: Literal["thrust", "speed", "throttle", "pulse"] = Field(
        alias="as",
        description="What they are: thrust [N]; speed [rad/s] (state `unit: rpm` with the command "
        "where the file has rpm); throttle, from `low` to `high`; or pulse [us], which needs "
        "`rotor_model`",
    )
    low: Level = Field(
        0.0,
        description="Throttle at which nothing turns, such as 1000 us; a number alone is in the "
        "SI unit of the commands",
    )
    high: Level = Field(1.0, description="Full throttle, such as 2000 us or 65535")
    per_voltage: Volts | None = Field(
        None,
        description="Battery voltage at which the throttle means what `thrust` says; the throttle "
        "is scaled by `battery` over this. Leave out where the firmware does so itself",
    )

    @model_validator(mode="after")
    def _check_range(self) -> CommandKeys:
        if self.high <= self.low:
            raise ValueError(f"high must be above low, got {self.high:g} and {self.low:g}")
        if len(set(self.columns)) < len(self.columns):
            raise ValueError(f"a column is named twice: {', '.join(self.columns)}")
        return self


Columns = tuple[str | None, str | None, str | None]


class QuaternionKeys(Part):
    """Attitude as a quaternion that takes body vectors to the world."""

    columns: tuple[str, str, str, str] = Field(description="Channels, in the stated order")
    order: Literal["wxyz", "xyzw"] = Field(
        description="Order of the channels: scalar part first (wxyz) or last (xyzw)"
    )


class SensorKeys(Part):
    """Channels by what they measure: three names each, null where there is none."""

    position: Columns | None = Field(None, description="x, y, z in the world [m]")
    velocity: Columns | None = Field(None, description="x, y, z in the world [m/s]")
    quaternion: QuaternionKeys | None = Field(None, description="Attitude as a quaternion")
    roll_pitch_yaw: Columns | None = Field(
        None, description="Angles of R = Rz(yaw) Ry(pitch) Rx(roll), body to world [rad]"
    )
    body_rates: Columns | None = Field(None, description="Gyro, x, y, z of the body [rad/s]")
    specific_force: Columns | None = Field(
        None, description="Accelerometer, x, y, z of the body; 9.81 upwards at rest [m/s^2]"
    )
    specific_force_in_world: Columns | None = Field(
        None, description="The same turned to the world: (0, 0, 9.81) at rest if z is up [m/s^2]"
    )
    acceleration: Columns | None = Field(
        None, description="Acceleration in the world, gravity taken off: zero at rest [m/s^2]"
    )

    @model_validator(mode="after")
    def _check_enough_channels(self) -> SensorKeys:
        if self.position is None and self.velocity is None:
            raise ValueError("name the channels of position or velocity; a flight needs one")
        names = self.names
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"channel {name} is named twice")
        return self

    @property
    def names(self) -> list[str]:
        """All channels that are named."""
        columns: list[Sequence[str | None]] = [
            c
            for c in (
                self.position,
                self.velocity,
                self.roll_pitch_yaw,
                self.body_rates,
                self.specific_force,
                self.specific_force_in_world,
                self.acceleration,
                None if self.quaternion is None else self.quaternion.columns,
            )
            if c is not None
        ]
        return [name for group in columns for name in group if name is not None]


class WindowKeys(Part):
    """A flight is cut into windows, and the state at the start of each is fitted away."""

    length: Seconds | None = Field(
        None, gt=0, description="Length [s]; default: 1 s, shorter where the model needs it"
    )
    substeps: int = Field(2, ge=1, le=1_000, description="Integration steps per sample")


class NuisanceKeys(Part):
    """What no flight is without, as standard deviations; 0 leaves one out."""

    run_thrust_gain: Ratio = Field(
        0.005, ge=0, description="Factor on all thrusts, of its own in every run: battery, air"
    )
    attitude_offset: Radians = Field(
        3e-3, ge=0, description="Constant error of the measured attitude, per axis [rad]"
    )
    body_rates_offset: RadiansPerSecond = Field(
        0.0, ge=0, description="Zero of the gyro, per axis [rad/s]; 0: a candidate cause instead"
    )
    specific_force_offset: MetersPerSquareSecond = Field(
        0.03, ge=0, description="Zero of the accelerometer, per axis [m/s^2]"
    )
    clock: Seconds = Field(
        0.0, ge=0, description="Clock of the commands against that of the sensors, per run [s]"
    )


class EstimatorKeys(Part):
    """How fast a state estimator on board corrects itself by the position that it is told.

    Errors e of its velocity and d of its attitude: e' = ... - velocity e, d' = -gain (f x e), f the
    specific force, with the gain `tilt` for roll and pitch and `heading` for yaw.
    """

    velocity: Rate = Field(
        Quantity(value=4.0, percent=60.0, unit="1/s"), description="Of velocity [1/s]"
    )
    tilt: Plain = Field(
        Quantity(value=0.05, percent=60.0, unit="s^2/m^2"),
        description="Of roll and pitch by velocity [s^2/m^2]",
    )
    heading: Plain = Field(
        Quantity(value=0.1, percent=60.0, unit="s^2/m^2"),
        description="Of yaw by velocity [s^2/m^2]",
    )


def _map_by_name(what: str, given: Any, names: Sequence[str], counts: Sequence[int]) -> Any:
    """A list of numbers as a mapping."""
    if not isinstance(given, (list, tuple)):
        return given
    if len(given) not in counts:
        raise ValueError(
            f"{what} needs {' or '.join(map(str, counts))} numbers ({', '.join(names)}), "
            f"got {len(given)}"
        )
    return dict(zip(names, given, strict=False))


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
