"""Airframes of mirrored rotor pairs at any place and tilt, differentiable in 5 numbers per pair.

After the encoding of arXiv 2510.04724, a hexarotor in 15 numbers: place (r, azimuth, elevation) and
orientation (two Euler angles) of three rotors, the other three mirrored at the xz-plane, spins in
turns around the body. Its ranges and masses are not published; those here are stated as such.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.rotor import RotorModel
from diffsim.core.check import require, require_number
from diffsim.core.rotation import matrix_from_rpy

PER_PAIR = 5
_TORQUE_PER_RADIUS = 0.115  # of the rotors whose torque was measured (kde2814), [-]
_ON_AXIS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # points of a stream's axis held against the cage
_MIRROR = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What an airframe is built of."""

    radius: float = 0.0635  # of the propellers [m]
    max_thrust: float = 4.13  # of a rotor [N]
    torque_ratio: float = 0.0073  # reaction torque per thrust [m]
    rotor_mass: float = 0.038  # motor, propeller and their share of the speed controllers [kg]
    core_mass: float = 0.5  # electronics and battery, a cuboid about the origin [kg]
    cage: tuple[float, float, float] = (0.1, 0.06, 0.05)  # edges of that cuboid, (x, y, z) [m]
    arm_density: float = 0.05  # of the tubes from the origin to the rotors [kg/m]

    def __post_init__(self) -> None:
        for name in ("radius", "max_thrust", "torque_ratio", "rotor_mass", "core_mass"):
            require_number(name, float(getattr(self, name)), above=0.0)
        require_number("arm_density", float(self.arm_density), at_least=0.0)

    @classmethod
    def of(cls, rotor: RotorModel, *, rotor_mass: float, core_mass: float) -> Parts:
        """Parts with a rotor of the catalog; torque that was not measured as of others."""
        radius = float(rotor.radius)
        ratio = rotor.torque_ratio
        return cls(
            radius=radius,
            max_thrust=float(rotor.max_thrust),
            torque_ratio=_TORQUE_PER_RADIUS * radius if ratio is None else float(ratio),
            rotor_mass=rotor_mass,
            core_mass=core_mass,
        )


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """What the numbers 0 and 1 of a design mean."""

    # distance of rotors from the origin, in propeller radii
    reach: tuple[float, float] = (1.5, 5.0)
    # share of a pair's sector of the azimuth that it may use; 1: up to its neighbor's
    sector: float = 1.0
    # largest angle of a place above or below the cage's middle [rad]
    elevation: float = math.radians(40.0)
    # largest of each Euler angle of a rotor's axis, roll then pitch [rad]
    tilt: float = math.radians(45.0)


@dataclass(frozen=True, kw_only=True)
class Airframe:
    """A design space of mirrored pairs.

    Attributes:
        num_pairs: 2, 3 or 4: as many rotors on each side.
        parts: What it is built of.
        ranges: What the numbers of a design mean.
    """

    num_pairs: int = 3
    parts: Parts = Parts()
    ranges: Ranges = Ranges()

    def __post_init__(self) -> None:
        require_number("num_pairs", self.num_pairs, at_least=2, at_most=8)

    @property
    def num_parameters(self) -> int:
        """Length of a design."""
        return PER_PAIR * self.num_pairs

    @property
    def conventional(self) -> Tensor:
        """The flat regular design whose streams just pass each other, (num_parameters,)."""
        spacing = 2.0 * math.sin(0.5 * math.pi / self.num_pairs)
        low, high = self.ranges.reach
        reach = (2.0 * self.stream_radius / spacing / self.parts.radius - low) / (high - low)
        row = torch.full((self.num_pairs, PER_PAIR), 0.5, dtype=torch.float64)
        row[:, 0] = min(1.001 * reach, 1.0)
        return row.flatten()

    @property
    def stream_radius(self) -> float:
        """Radius of the cylinder of air that a rotor keeps for itself [m]."""
        return self.parts.radius + 1e-3

    def rotors(self, xi: Tensor) -> tuple[Tensor, Tensor]:
        """Places relative to the cage's middle and unit directions of thrust.

        Args:
            xi: Design, (num_parameters,) in [0, 1]: per pair distance, azimuth, elevation, roll,
                pitch.

        Returns:
            (n_rotors, 3) [m] and (n_rotors, 3); first the right side from front to back, then the
            left from back to front. Gradient: xi.
        """
        xi = require("xi", xi, (self.num_parameters,), torch.float64)
        r, azimuth, elevation, roll, pitch = xi.view(self.num_pairs, PER_PAIR).unbind(1)
        low, high = self.ranges.reach
        distance = self.parts.radius * (low + (high - low) * r)
        width = math.pi / self.num_pairs
        middle = width * (torch.arange(self.num_pairs, dtype=torch.float64) + 0.5)
        angle = middle + self.ranges.sector * width * (azimuth - 0.5)
        up = self.ranges.elevation * (2.0 * elevation - 1.0)
        flat = distance * up.cos()
        places = torch.stack([flat * angle.cos(), flat * angle.sin(), -distance * up.sin()], -1)
        tilts = self.ranges.tilt * (2.0 * torch.stack([roll, pitch], -1) - 1.0)
        rpy = torch.cat([tilts, torch.zeros_like(tilts[:, :1])], -1)
        axes = torch.stack([-matrix_from_rpy(row)[:, 2] for row in rpy])
        return (
            torch.cat([places, (places * _MIRROR).flip(0)]),
            torch.cat([axes, (axes * _MIRROR).flip(0)]),
        )

    def vehicle(self, xi: Tensor) -> Multicopter:
        """The multicopter of a design, (num_parameters,). Gradient: xi."""
        return self.assembled(*self.rotors(xi))

    def assembled(self, places: Tensor, axes: Tensor) -> Multicopter:
        """A cuboid, slender tubes to the rotors, and rotors as points; spins in turns.

        Args:
            places: Of the rotors relative to the cage's middle, (n_rotors, 3) [m].
            axes: Unit directions of thrust, (n_rotors, 3).
        """
        parts, count = self.parts, len(places)
        tubes = parts.arm_density * places.norm(dim=-1)
        masses = torch.cat([tubes.new_tensor([parts.core_mass]), tubes])
        masses = torch.cat([masses, tubes.new_full((count,), parts.rotor_mass)])
        centers = torch.cat([places.new_zeros(1, 3), 0.5 * places, places])
        mass = masses.sum()
        middle = (masses[:, None] * centers).sum(0) / mass
        a, b, c = (edge**2 for edge in parts.cage)
        own = parts.core_mass / 12.0 * torch.diag(tubes.new_tensor([b + c, a + c, a + b]))
        own = own + (tubes[:, None, None] / 12.0 * _about(places)).sum(0)
        inertia = own + (masses[:, None, None] * _about(centers - middle)).sum(0)
        turns = places.new_tensor([(-1.0) ** k for k in range(count)])
        return Multicopter(
            mass=mass,
            inertia=inertia,
            positions=places - middle,
            directions=axes,
            spins=turns,
            torque_ratios=tubes.new_full((count,), parts.torque_ratio),
            max_thrusts=tubes.new_full((count,), parts.max_thrust),
            radii=tubes.new_full((count,), parts.radius),
        )

    def gaps(self, xi: Tensor) -> Tensor:
        """Room between the streams of every two rotors, and between streams and cage.

        A stream is all points within ``stream_radius`` of an axis two radii long to either side of
        the rotor: the published cylinder of four radii, with round ends, so a little more.

        Returns:
            (n_pairs_of_rotors + n_rotors,) [m]; below 0 where they overlap. Gradient: xi.
        """
        places, axes = self.rotors(xi)
        half = 2.0 * self.parts.radius
        i, j = torch.triu_indices(len(places), len(places), 1)
        apart = _segment_distance(places[i], axes[i], places[j], axes[j], half)
        steps = places.new_tensor(_ON_AXIS)[:, None, None] * half
        points = places + steps * axes
        outside = points.abs() - 0.5 * places.new_tensor(self.parts.cage)
        from_cage = outside.clamp_min(0.0).square().sum(-1).clamp_min(1e-18).sqrt()
        from_cage = from_cage + outside.max(-1).values.clamp_max(0.0)
        return torch.cat(
            [apart - 2.0 * self.stream_radius, from_cage.min(0).values - self.stream_radius]
        )


def _about(r: Tensor) -> Tensor:
    """|r|^2 I - r r', (..., 3, 3)."""
    unit = torch.eye(3, dtype=r.dtype)
    return r.square().sum(-1)[..., None, None] * unit - r[..., :, None] * r[..., None, :]


def _segment_distance(p: Tensor, d: Tensor, q: Tensor, e: Tensor, half: float) -> Tensor:
    """Distances of segments p + s d and q + t e, |s|, |t| <= half, d and e of unit length.

    The closest points of the lines, cut to the segments one after the other (Ericson 2005,
    Real-Time Collision Detection, 5.1.9).
    """
    r = p - q
    b, c, f = (d * e).sum(-1), (d * r).sum(-1), (e * r).sum(-1)
    away = 1.0 - b.square()
    skew = away > 1e-12
    s = torch.where(skew, (b * f - c) / torch.where(skew, away, 1.0), 0.0).clamp(-half, half)
    t = (b * s + f).clamp(-half, half)
    s = (b * t - c).clamp(-half, half)
    return (r + s[:, None] * d - t[:, None] * e).square().sum(-1).clamp_min(1e-18).sqrt()
