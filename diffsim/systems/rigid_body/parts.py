"""Blocks of the description of rigid bodies: their keys, and what the keys say together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.inertia import inertia_mistake
from diffsim.core.schema import Part
from diffsim.core.schema_numbers import Kilograms, KilogramSquareMeters, Meters, Radians, Seconds
from diffsim.core.schema_paths import PathInside
from diffsim.data.study import Run
from diffsim.systems.description import Description, Quantity
from diffsim.systems.quantities import Acceleration, Length, Pixels, Plain, PositiveLength, Speed

GROUND = "ground"
AXES = ("x", "y", "z")
_RHO_AIR = 1.2  # [kg/m^3]
_DRAG_OF_BOX, _DRAG_OF_SPHERE = 1.0, 0.5
#: Turn from the recorded frame to the one whose z points up, as a rotation vector [rad].
UP = {
    "z": (0.0, 0.0, 0.0),
    "-z": (np.pi, 0.0, 0.0),
    "y": (0.5 * np.pi, 0.0, 0.0),
    "-y": (-0.5 * np.pi, 0.0, 0.0),
    "x": (0.0, -0.5 * np.pi, 0.0),
    "-x": (0.0, 0.5 * np.pi, 0.0),
}


class Start(Part):
    """First guess of a ball's start, where the recording does not give it."""

    place: tuple[Length, ...] = Field((), description="Its center: x, y and, in flight, z")
    velocity: tuple[Speed, ...] = Field((), description="Along the same axes")
    roll: tuple[Speed, ...] = Field(
        (), description="Velocity at which it would roll with its spin: x and y"
    )


class Body(Part):
    """One rigid body."""

    name: str = Field(description="Name of the body")
    box: tuple[PositiveLength, ...] | None = Field(
        None, description="Lengths of a box's three edges, or one for a cube"
    )
    sphere: PositiveLength | None = Field(None, description="Diameter of a ball")
    like: str | None = Field(
        None, description="Another ball that this one equals: the same diameter and inertia"
    )
    mass: Kilograms | None = Field(None, gt=0, description="Mass; sizes what air may do")
    inertia: tuple[KilogramSquareMeters, ...] | None = Field(
        None, description="Moments of inertia about the body's x, y, z; needs mass"
    )
    inertia_ratio: float | None = Field(
        None, gt=0, description="Of a ball: I / (m r^2); solid 0.4 (default), thin shell 0.67 [-]"
    )
    begins: Literal["flying", "on_ground", "at_rest"] = Field(
        "flying", description="flying, on_ground (it slides or rolls) or at_rest (on the ground)"
    )
    start: Start = Field(Start(), description="First guess of a ball's start; default: the data's")

    @model_validator(mode="after")
    def _check_one_shape(self) -> Body:
        shapes = [k for k in ("box", "sphere", "like") if getattr(self, k) is not None]
        if len(shapes) > 1:
            raise ValueError(f"give one of box, sphere and like, got {' and '.join(shapes)}")
        if self.box is not None and len(self.box) not in (1, 3):
            raise ValueError(f"box has three edges, or one for a cube, got {len(self.box)}")
        if not shapes and self.inertia is None:
            raise ValueError("give a box, a sphere, or mass and inertia")
        if self.inertia is not None and (self.mass is None or len(self.inertia) != 3):
            raise ValueError("inertia needs three moments and the mass")
        if self.inertia is not None and (
            said := inertia_mistake(
                (*self.inertia, 0.0, 0.0, 0.0), [f"inertia[{k}]" for k in (0, 1, 2, "", "", "")]
            )
        ):
            raise ValueError(said)
        return self

    @property
    def is_ball(self) -> bool:
        """Whether its turn does not matter."""
        return self.sphere is not None or self.like is not None

    @property
    def edges(self) -> tuple[Quantity, ...]:
        """Three edges of a box."""
        box = self.box or ()
        return box * 3 if len(box) == 1 else box

    def volume_and_area(self) -> tuple[float, float]:
        """Volume [m^3], and area against the air times its coefficient [m^2]; 0 if unknown."""
        if self.sphere is not None:
            d = self.sphere.value
            return math.pi / 6.0 * d**3, _DRAG_OF_SPHERE * math.pi / 4.0 * d**2
        if self.box is not None:
            a, b, c = (q.value for q in self.edges)
            # mean shadow of a box that tumbles: a quarter of its surface
            return a * b * c, _DRAG_OF_BOX * 0.5 * (a * b + b * c + c * a)
        return 0.0, 0.0

    def in_air(self) -> tuple[float, float] | None:
        """Share of the weight that air carries, added mass included [-], and deceleration over
        speed squared [1/m]; None where mass or shape is not stated."""
        volume, area = self.volume_and_area()
        if self.mass is None or volume == 0.0:
            return None
        return 1.5 * _RHO_AIR * volume / self.mass, 0.5 * _RHO_AIR * area / self.mass


class Ground(Part):
    """The plane below, level unless an effect tilts it."""

    height: Meters = Field(0.0, description="Height of the plane in the recorded frame")


class Contact(Part):
    """What two bodies, or a body and the ground, do where they touch."""

    between: tuple[str, str] = Field(description="Two bodies, or a body and `ground`")
    restitution: Plain = Field(
        Quantity(value=0.5, sd=0.25, lower=0.0, upper=1.0),
        description="Speed of separation over that of approach [-]",
    )
    friction: Plain | None = Field(
        None, description="Coulomb coefficient [-]; left out: none, but a candidate cause"
    )


class Measure(Part):
    """Which channels show what of a body; give one of its keys beside `body`."""

    body: str = Field(description="Name of the body")
    position: dict[str, str] = Field({}, description="Channel of its center by axis: {x: x_m}")
    velocity: dict[str, str] = Field({}, description="Channel of its velocity by axis")
    quaternion: tuple[str, ...] = Field((), description="Four channels, scalar part first")
    angles: dict[str, str] = Field(
        {}, description="Channels by roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll) [rad]"
    )
    spin: dict[str, str] = Field({}, description="Channels of the body rates by body axis [rad/s]")
    pixels: tuple[str, ...] = Field((), description="Channels u (right) and v (down) of a camera")

    @model_validator(mode="after")
    def _check_complete(self) -> Measure:
        given = [k for k in KINDS if getattr(self, k)]
        if len(given) != 1:
            raise ValueError(
                f"give one of {', '.join(KINDS)} per entry, got {', '.join(given) or 'none'}"
            )
        for key, count in (("quaternion", 4), ("pixels", 2)):
            names = getattr(self, key)
            if names and len(names) != count:
                raise ValueError(f"{key} needs {count} channels, got {len(names)}")
        for key, axes in _BY_AXIS.items():
            for axis in getattr(self, key):
                if axis not in axes:
                    raise ValueError(f"{key} has no {axis!r}; known: {', '.join(axes)}")
        return self

    def rows(self) -> Iterator[tuple[str, int, str]]:
        """Kind, component and channel of every entry."""
        for key, axes in _BY_AXIS.items():
            for axis, channel in getattr(self, key).items():
                yield key, axes.index(axis), channel
        for key in ("quaternion", "pixels"):
            for i, channel in enumerate(getattr(self, key)):
                yield key, i, channel


KINDS = ("position", "velocity", "quaternion", "angles", "spin", "pixels")
ANGLES = ("roll", "pitch", "yaw")
_BY_AXIS = {"position": AXES, "velocity": AXES, "spin": AXES, "angles": ANGLES}


class Points(Part):
    """Points whose places are known, clicked in a picture of the camera."""

    file: PathInside = Field(description="CSV beside the recordings")
    columns: tuple[str, str, str, str, str] = Field(
        ("u_px", "v_px", "x_m", "y_m", "z_m"), description="Columns of u, v [px] and x, y, z [m]"
    )
    sd: float = Field(1.0, gt=0, description="How well a point is clicked [px]")


class Camera(Part):
    """A pinhole: Y = turn R p + shift, u = u0 + f Y0 / Y2, v = v0 - f Y1 / Y2 (Y2 < 0 in front)."""

    size: tuple[float, float] = Field(description="Width and height of the picture [px]")
    focal: Pixels | None = Field(None, description="Focal length [px]; default: by points")
    rotation: tuple[tuple[float, float, float], ...] | None = Field(
        None, description="First guess of R, rows of three; default: by points"
    )
    shift: tuple[Length, ...] | None = Field(
        None, description="First guess of the shift; default: by points"
    )
    turn_sd: Radians = Field(0.1, gt=0, description="How far R may be off, about each axis [rad]")
    points: Points | None = Field(None, description="Clicked points that calibrate it")

    @property
    def is_stated(self) -> bool:
        """Whether a first guess of all of it is stated."""
        return None not in (self.focal, self.rotation, self.shift)

    @model_validator(mode="after")
    def _check_camera(self) -> Camera:
        if not self.is_stated and self.points is None:
            raise ValueError("give focal, rotation and shift, or points to find them by")
        if self.rotation is not None and len(self.rotation) != 3:
            raise ValueError(f"rotation needs three rows, got {len(self.rotation)}")
        return self


class Starts(Part):
    """Which runs share the state that their motion starts from."""

    per: str = Field(
        "run",
        description="run: each its own; once: all runs are parts of one motion; or a fact of the "
        "runs' setup: one for each of its values",
    )
    at: Seconds = Field(
        0.0, description="Time of the start where runs share it; else each run's first sample"
    )


class Window(Part):
    """How much of a toss counts; it ends where the body's next contact is not modeled."""

    until: Literal["touch", "rebound"] = Field(
        "touch",
        description="touch: just before the first contact; rebound: through the impact of the "
        "corner that hits first, until another one comes down",
    )
    near: Meters | None = Field(
        None, gt=0, description="Height of a corner that counts as touching; default: 3 % of edge"
    )
    spared: int = Field(1, ge=0, description="Frames left out before the touch")
    rest_frames: int = Field(
        0,
        ge=0,
        description="Number of frames at the end in which the body rests on the ground: their "
        "median height counts as one more sample; 0: none",
    )
    rest_sd: Meters | None = Field(
        None, gt=0, description="Noise of that height; default: its scatter over the runs"
    )


class RigidBodyKeys(Description):
    """All keys of described rigid bodies."""

    bodies: tuple[Body, ...] = Field(min_length=1, description="The bodies")
    gravity: Acceleration = Field(
        Quantity(value=9.81), description="Gravity, known to 0.3 % everywhere on earth"
    )
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field(
        "z", description="Axis of the recorded frame that points up"
    )
    ground: Ground | None = Field(Ground(), description="The plane below; null: none")
    contacts: tuple[Contact, ...] = Field((), description="Which bodies touch, and how")
    measures: tuple[Measure, ...] = Field(min_length=1, description="What the channels show")
    window: Window | None = Field(
        None, description="How much of a toss counts; default: all of it, in free flight"
    )
    starts: Starts = Field(Starts(), description="Which runs share a start of their balls")
    camera: Camera | None = Field(None, description="Camera of the channels in pixels")

    @model_validator(mode="after")
    def _check_names(self) -> RigidBodyKeys:
        known = [b.name for b in self.bodies]
        for body in self.bodies:
            if body.like is not None:
                _require_known(f"bodies: like of {body.name}", body.like, known)
        for i, contact in enumerate(self.contacts):
            for name in contact.between:
                _require_known(f"contacts[{i}].between", name, [*known, GROUND])
        for i, measure in enumerate(self.measures):
            _require_known(f"measures[{i}].body", measure.body, known)
            if measure.pixels and self.camera is None:
                raise ValueError(f"measures[{i}] is in pixels; describe the ``camera``")
        return self

    @property
    def height(self) -> float:
        """Height of the ground [m]."""
        return 0.0 if self.ground is None else self.ground.height

    @property
    def turn(self) -> Rotation:
        """From the recorded frame to the one whose z points up."""
        return Rotation.from_rotvec(UP[self.up])

    def places(self, run: Run, names: Sequence[str], body: str) -> Array:
        """Places that a run shows of a body in the recorded frame, (num_samples, 3) [m].

        Args:
            names: Names of its channels.
            body: Name of the body; NaN where nothing shows it.
        """
        place = np.full((len(run.time_s), 3), np.nan)
        for measure in (m for m in self.measures if m.body == body):
            for axis, channel in measure.position.items():
                place[:, "xyz".index(axis)] = run.measured[:, names.index(channel)]
        return place

    def upright(self, places: Array) -> Array:
        """Places (num_samples, 3) of the recorded frame in the one whose z points up."""
        rows = self.turn.as_matrix().round()
        along = np.abs(rows).argmax(axis=1)
        return np.asarray(rows[range(3), along] * places[:, along])


def _require_known(where: str, name: str, known: list[str]) -> None:
    if name not in known:
        raise ValueError(f"{where}: no {name!r}{did_you_mean(name, known)}; known: {known}")
