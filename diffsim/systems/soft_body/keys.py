"""Keys of a described soft body: material, supports, loads, actuators, surroundings."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from diffsim.core.schema import Part
from diffsim.core.schema_numbers import Hertz, KilogramsPerCubicMeter, Meters, Seconds
from diffsim.soft import MATERIALS
from diffsim.soft.materials import CONSTANTS
from diffsim.systems.description import known
from diffsim.systems.quantities import (
    Angle,
    Density,
    Force,
    Length,
    Mass,
    Plain,
    Pressure,
    Rate,
    Speed,
    Time,
)
from diffsim.systems.soft_body.places import Point, Region

Axes = Literal["x", "y", "z", "xy", "xz", "yz", "xyz"]


class Material(Part):
    """Material of the whole body, where no region says otherwise."""

    law: str = Field("pd", description=f"Energy of the solid: {', '.join(MATERIALS)}")
    youngs_modulus: Pressure = Field(description="Young's modulus [Pa]")
    poissons_ratio: Plain = Field(
        known(0.45, "-"), description="Poisson's ratio; cells lock as it nears 0.5"
    )
    density: Density = Field(description="Density [kg/m^3]")
    second_share: Plain = Field(
        known(0.0, "-"),
        description="Of `mooney_rivlin`: share of the shear modulus in the second invariant",
    )
    rayleigh_beta: Time = Field(
        known(0.0, "s"), description="Damping that grows with the frequency: force -beta K v [s]"
    )
    rayleigh_alpha: Rate = Field(
        known(0.0, "1/s"), description="Damping by speed against the room: -alpha M v [1/s]"
    )

    @model_validator(mode="after")
    def _check_constants(self) -> Material:
        has_share = self.second_share.is_fitted or self.second_share.value != 0.0
        if has_share and "second_share" not in CONSTANTS.get(self.law, ()):
            raise ValueError(
                f"second_share is a constant of mooney_rivlin; {self.law} has none, leave it out"
            )
        return self


class MaterialRegion(Part):
    """A part of the body of another material; a stiff dense one is a rigid load."""

    name: str = Field(description="Short name; base parameters are called by it")
    where: Region | None = Field(None, description="Which part: cells whose center lies inside")
    group: str | None = Field(
        None, description="Instead of `where`: name of a region of the body's mesh file"
    )
    youngs_modulus: Pressure | None = Field(None, description="Young's modulus [Pa]")
    poissons_ratio: Plain | None = Field(None, description="Poisson's ratio")
    density: Density | None = Field(None, description="Density [kg/m^3]")

    one_of: ClassVar = ("where", "group")


class Clamp(Region):
    """Nodes that cannot move; a plane of symmetry is one across it."""

    axes: Axes = Field("xyz", description="Along which axes they are held")


class Gravity(Part):
    """Gravity, perhaps not quite along the axes of the model."""

    vector: tuple[float, float, float] = Field(
        (0.0, 0.0, -9.81), description="Acceleration of free fall along x, y, z [m/s^2]"
    )
    roll: Angle = Field(known(0.0, "rad"), description="Turned about x by this [rad]")
    pitch: Angle = Field(known(0.0, "rad"), description="Turned about y by this [rad]")


class Load(Part):
    """A mass attached to the body."""

    name: str = Field("load", description="Short name; base parameters are called by it")
    where: Region = Field(description="Nodes that carry it, each its share")
    mass: Mass | None = Field(None, description="Mass [kg]")
    mass_from: str | None = Field(
        None, description="Instead of `mass`: the fact of the runs' `setup` that holds it [kg]"
    )
    share: Plain = Field(
        known(1.0, "-"), description="Factor on the mass: a hook and a string weigh something"
    )
    acts_as: Literal["mass", "weight"] = Field(
        "mass",
        description="`mass`: it weighs and is inert. `weight`: a constant force, as of something "
        "that hangs by a long soft spring; its inertia is then a cause to be found, load_inertia",
    )

    one_of: ClassVar = ("mass", "mass_from")


class Drive(Part):
    """What tendons, muscles and chambers share: the command that drives them."""

    name: str = Field(description="Short name; base parameters are called by it")
    command: str = Field(description="Name of the command that drives it")
    gain: Plain = Field(
        known(1.0, "-"), description="Factor on the command: radius of a pulley, unit of a scale"
    )


class DescribedTendon(Drive):
    """A cable through the body."""

    path: tuple[Point, ...] = Field(
        min_length=2, description="Corners of its path in the body at rest [m]"
    )
    means: Literal["shortening", "share", "length", "force"] = Field(
        "shortening",
        description="What the command says: by how much the cable is drawn in [m], that as a share "
        "of its length, its length [m], or its tension [N]",
    )
    axial_stiffness: Force | None = Field(
        None, description="Force per strain, E A [N]; not for means: force"
    )
    full_length: Meters | None = Field(
        None, gt=0, description="Length that strain refers to [m]; default: that of the path"
    )
    pushes: bool = Field(False, description="A rod, which pushes, too, and never hangs slack")
    part: float = Field(
        1.0, gt=0, le=1, description="Share of the cable in the model: 0.5 on a plane of symmetry"
    )

    @model_validator(mode="after")
    def _check_stiffness(self) -> DescribedTendon:
        if (self.axial_stiffness is None) == (self.means != "force"):
            raise ValueError("give axial_stiffness, except where the command means the force")
        return self


class DescribedMuscle(Drive):
    """Fibers that contract: an active part of the body."""

    where: Region = Field(description="Which part: cells whose center lies inside")
    direction: tuple[float, float, float] = Field(description="Direction of the fibers at rest")
    stiffness: Pressure = Field(description="Stiffness of the fibers [Pa]")
    means: Literal["shortening", "length"] = Field(
        "shortening", description="The command is the share by which they shorten, or their length"
    )


class Chamber(Drive):
    """A cavity under pressure; the command is its gauge pressure [Pa]."""

    cavity: int = Field(0, ge=0, description="Which void of the mesh, 0 the largest")


class Water(Part):
    """A fluid around the body."""

    density: KilogramsPerCubicMeter = Field(1000.0, gt=0, description="Density [kg/m^3]")
    drag: Plain = Field(known(1.0, "-"), description="Factor on the published drag coefficients")
    thrust: Plain = Field(
        known(1.0, "-"), description="Factor on the published thrust coefficients"
    )
    added_mass: Plain = Field(
        known(1.0, "-"), description="Inertia of the fluid, as a share of what the body displaces"
    )
    current: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="Velocity of the fluid [m/s]"
    )
    buoyant: bool = Field(False, description="Whether the fluid carries what it displaces")


class Wall(Part):
    """A flat obstacle: everything on its far side is solid."""

    normal: tuple[float, float, float] = Field(description="Out of the solid")
    offset: Meters = Field(0.0, description="Its distance from the origin along normal [m]")
    friction: float = Field(0.0, ge=0, description="Coefficient of friction")


class Stop(Part):
    """A stop that may be in the way, a candidate cause: one_sided_stop."""

    where: Region = Field(description="Nodes that meet it")
    direction: tuple[float, float, float] = Field(description="Direction in which it stops them")
    gap: Meters = Field(description="How far they move freely, on average [m]")


class Support(Part):
    """The recorded motion of what holds the body."""

    x: str = Field(description="Command with its place along x [m]")
    z: str = Field(description="Command with its place along z [m]")
    faster_than: Hertz | None = Field(
        None, gt=0, description="Noise above this is taken out [Hz]: accelerations act"
    )


class Vibration(Part):
    """An oscillation of the base that nobody recorded, a candidate cause: base_vibration."""

    frequency: Hertz = Field(gt=0, description="Its frequency [Hz]")
    axes: Axes = Field("xyz", description="Along which axes the base may shake")


class Start(Part):
    """How the body begins."""

    shape: Literal["equilibrium", "rest", "held"] = Field(
        "equilibrium",
        description="At rest under the first command, in the unstrained shape, or with some nodes "
        "held where they are in it until the start, and then let go",
    )
    where: Region | None = Field(None, description="For held: the nodes that are held")
    axes: Axes = Field("xyz", description="For held: along which axes")
    direction: tuple[float, float, float] = Field(
        (0.0, 0.0, 1.0), description="For held: direction of `offset` and `speed`"
    )
    offset: Length = Field(
        known(0.0, "m"), description="For held: how far from the unstrained place [m]"
    )
    speed: Speed = Field(
        known(0.0, "m/s"), description="For held: speed with which they are let go [m/s]"
    )
    at: Seconds | None = Field(
        None, description="Time on the run's clock; default: its first sample [s]"
    )
    lead_in: Seconds = Field(
        0.0,
        ge=0,
        description="Simulated before the first sample, while the command comes up from zero [s]: "
        "for bodies that have no equilibrium, and for commands with a past",
    )

    @model_validator(mode="after")
    def _check_held_somewhere(self) -> Start:
        if (self.shape == "held") != (self.where is not None):
            raise ValueError("shape: held needs where, the nodes that are held; others have none")
        return self


class Numerics(Part):
    """How it is simulated."""

    motion: Literal["dynamic", "quasi_static"] = Field(
        "dynamic",
        description="`quasi_static`: at every sample in equilibrium under its command, for slow "
        "motions and for poses; a hundred times quicker",
    )
    time_step: Seconds = Field(5e-3, gt=0, description="Time step [s]")
    integrator: Literal["implicit_midpoint", "bdf2", "implicit_euler", "semi_implicit_euler"] = (
        Field("implicit_midpoint", description="Implicit midpoint has no damping of its own")
    )
    element: Literal["standard", "assumed_strain"] = Field(
        "standard",
        description="`assumed_strain`: cells of six faces that bend like beams at any Poisson's "
        "ratio, where standard ones are too stiff",
    )
    tolerance: float = Field(1e-8, gt=0, lt=1, description="Relative tolerance of every step")
    correct_mesh: bool = Field(
        True,
        description="Multiply Young's modulus by what coarse cells bend too little, so that it "
        "means the same on every mesh",
    )
    poses: int = Field(
        24,
        ge=5,
        le=10_000,
        description="quasi_static with one command: poses that others lie between",
    )
