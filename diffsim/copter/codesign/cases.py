"""The flight cases that a metric asks for: what the rotors must be able to do at the same time."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diffsim.copter.codesign.wrench import Case, Rotors
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.core.checked import checked


@checked
@dataclass(frozen=True, kw_only=True)
class Demands:
    """What is asked of a design besides its metrics.

    Attributes:
        authority: Torques about x, y, z that must be left, in every combination of signs, while
            the weight of the payload metric is lifted [N m]; None: none.
        load: Extra mass carried in the authority and response metrics [kg].
        authority_box: Torques whose multiple the authority metric makes large [N m].
        response_angle: Turned by in the response metric [rad].
    """

    authority: tuple[float, float, float] | None = None
    load: float = 0.0
    authority_box: tuple[float, float, float] = (1.0, 1.0, 0.1)
    response_angle: float = 0.5

    def __post_init__(self) -> None:
        if self.authority is not None:
            if len(self.authority) != 3:
                raise ValueError(
                    "authority must be torques about x, y, z [N m], got "
                    f"{len(self.authority)} values"
                )
            for torque in self.authority:
                require_number("authority", float(torque), at_least=0.0)
            object.__setattr__(self, "authority", tuple(float(t) for t in self.authority))
        require_number("load", float(self.load), at_least=0.0)
        require_number("response_angle", float(self.response_angle), above=0.0, below=np.pi)


def flight_cases(
    weights: Mapping[str, float], demands: Demands, rotors: Rotors, radii: Array
) -> list[Case]:
    """Hover first, or the loaded flight that hover is a scaled copy of, then what else is asked.

    A design that lifts W overall does so with thrusts u; v = (u / u_max) m0 g / W carry m0 g, so
    the payload metric E = max v = m0 g / W, and a torque tau kept at the weight W is E tau.
    """
    unit = rotors.weight * rotors.length
    payload = "payload" in weights
    cases = [Case("loaded", cap="payload", fixed_weight=True) if payload else Case("hover")]
    corners = [np.array(signs) for signs in itertools.product((1.0, -1.0), repeat=3)]
    load = demands.load * GRAVITY / rotors.weight
    if demands.authority is not None:
        for corner in corners:
            torque = _corner(corner, demands.authority, unit)
            cap = "payload" if payload else None
            cases.append(
                Case(
                    f"torque {torque}",
                    lift_only=True,
                    torque=torque,
                    aux=cap,
                    cap=cap,
                    fixed_weight=payload,
                )
            )
    if "authority" in weights:
        for corner in corners:
            torque = _corner(corner, demands.authority_box, unit)
            name = f"authority {torque}"
            cases.append(Case(name, lift_only=True, torque=torque, aux="authority", load=load))
    if "one_rotor_out" in weights:
        for i in range(len(radii)):
            name = f"without rotor {i}"
            cases.append(
                Case(
                    name,
                    lift_only=True,
                    axes=(0, 1),
                    cap="one_rotor_out",
                    fixed_weight=True,
                    dead_rotor=i,
                )
            )
    if "response" in weights:
        for axis in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
            name = f"turn about {axis}"
            cases.append(Case(name, lift_only=True, aux="response", inertia_axis=axis, load=load))
    return cases


def _corner(signs: Array, box: tuple[float, float, float], unit: float) -> tuple[float, ...]:
    return tuple((signs * np.array(box) / unit).tolist())
