"""Connecting patches: where parts may be attached to each other (thesis 3.2.1, Fig. 3-2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from diffsim.copter.vehicle.geometry import LinearPoints, frame_of, rotation_about
from diffsim.core.arrays import Array


@dataclass(frozen=True, eq=False)
class Slide:
    """A direction in which a connection may wander over its patch.

    |offset along direction| <= half_extent, which is linear in the part's parameters.
    """

    direction: Array  # unit vector in the part's frame, (3,)
    half_extent: float  # constant [m]
    half_extent_basis: Array  # per parameter of the part, (num_parameters,)


@dataclass(frozen=True, eq=False)
class Patch:
    """A place of a part where another part fits."""

    # "circular" (around ``axis``) or "flat" (``axis`` is its outward normal)
    shape: Literal["circular", "flat"]
    # what is attached here, the key of the rule table: "rod", "plate", "motor", "mount" (a face of
    # an adapter), "shaft" (motor to propeller)
    fitting: str
    center: LinearPoints  # linear in the part's parameters, (3,) [m], in the part's frame
    axis: Array  # unit main axis or outward normal, (3,)
    reference: Array  # unit vector perpendicular to ``axis`` from which angles count, (3,)
    radius: float = 0.0  # radius of a circular patch [m]
    slides: tuple[Slide, ...] = ()  # directions in which a connection may wander
    slides_by_default: bool = False  # whether it does when the design does not say


def aligning_rotation(host: Patch, host_rotation: Array, guest: Patch, *, degrees: float) -> Array:
    """Rotation that turns a part so that its patch faces a placed one.

    Circular patches share their axis; normals of flat ones oppose; the normal of a flat patch on a
    circular one is perpendicular to the axis (thesis Fig. 3-2). References coincide after a turn
    of ``degrees`` about the placed patch's axis.

    Returns:
        (3, 3), design frame from the guest part's frame.
    """
    axis = host_rotation @ host.axis
    reference = rotation_about(axis, degrees) @ (host_rotation @ host.reference)
    if host.shape == guest.shape:
        guest_axis = guest.axis if host.shape == "circular" else -guest.axis
        return frame_of(axis, reference) @ frame_of(guest_axis, guest.reference).T
    # one circular, one flat: the normal lies in the plane across the axis
    if host.shape == "circular":
        return frame_of(axis, reference) @ frame_of(guest.reference, -guest.axis).T
    return frame_of(-axis, reference) @ frame_of(guest.reference, guest.axis).T


def misalignment(host: Patch, host_rotation: Array, guest: Patch, guest_rotation: Array) -> float:
    """Angle by which two placed patches fail to face each other [deg]."""
    a, b = host_rotation @ host.axis, guest_rotation @ guest.axis
    along = float(np.clip(a @ b, -1.0, 1.0))
    if host.shape == guest.shape == "circular":
        along = abs(along)
    elif host.shape == guest.shape:
        along = -along
    else:
        return float(np.rad2deg(np.arcsin(abs(along))))
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), along)))
