"""How to put it together: where connectors go on their rods, and the steps in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffsim.copter.design.design import Design
from diffsim.copter.fabrication.materials import PLATES
from diffsim.copter.fabrication.motors import MotorPlan
from diffsim.copter.fabrication.printable import clip_angles, clip_middle, has_screw_holes
from diffsim.copter.fabrication.rods import RodCut
from diffsim.copter.vehicle.geometry import UP
from diffsim.core.arrays import Array

_SAME_AXIS = 1e-6  # [m]


@dataclass(frozen=True)
class ConnectorPlace:
    """A connector on a rod."""

    # connector, rod: names of the parts
    connector: str
    rod: str
    label: str  # label of the rod's cut
    start: str  # end of the rod from which distances count, its -x end: ``rear``, ``left``, ...
    from_start: float  # distance of the connector's middle from there [m]
    roll: float  # turn of the connector's top about the rod's axis, 0 facing up [deg]


def connector_places(
    design: Design, values: Mapping[str, float], cuts: Sequence[RodCut]
) -> tuple[ConnectorPlace, ...]:
    """Every connector whose bore holds a rod, rod by rod from its start."""
    labels = {name: cut.label for cut in cuts for name in cut.names}
    places = []
    for rod in (p for p in design.parts if p.name in labels):
        origin = np.array([values[n] for n in rod.position_names])
        axis = rod.rotation[:, 0]
        contacts = []
        for connector in (p for p in design.parts if p.part.kind == "round_connector"):
            offset = np.array([values[n] for n in connector.position_names]) - origin
            along = float(offset @ axis)
            half = 0.5 * values[rod.shape_names[0]]
            beside = float(np.linalg.norm(offset - along * axis))
            parallel = float(np.linalg.norm(np.cross(connector.rotation[:, 0], axis)))
            if beside < _SAME_AXIS and parallel < 1e-9 and abs(along) <= half + _SAME_AXIS:
                roll = _roll(connector.rotation @ UP, axis)
                label, start = labels[rod.name], _end_name(-axis)
                contacts.append(
                    ConnectorPlace(connector.name, rod.name, label, start, half + along, roll)
                )
        places += sorted(contacts, key=lambda c: c.from_start)
    return tuple(places)


def steps(
    design: Design,
    motors: Sequence[MotorPlan],
    places: Sequence[ConnectorPlace],
    values: Mapping[str, float],
) -> tuple[str, ...]:
    """What to do, in order."""
    kinds = {p.part.kind for p in design.parts}
    done = []
    if any(p.part.source == "printed" for p in design.parts):
        done.append("Print the parts as they stand in their files; weigh them against the bill.")
    if any(p.part.rod_parameter is not None for p in design.parts):
        done.append(
            "Cut the rods, letter them and mark their start. Deburr, and keep the dust wet: carbon "
            "dust harms lungs and shorts electronics."
        )
    if places:
        done.append(
            "Slide every connector to its place of the table below, all of one rod before the "
            "next, turned as listed; fix with epoxy only when the whole skeleton fits dry."
        )
    if kinds & set(PLATES):
        done.append(
            "Screw the plates to the connectors, two M3 screws each, holes drilled through."
        )
    done += _joints(design)
    done += [_mount(design, motor) for motor in motors]
    done.append(
        "Wire every speed controller to the output of its motor's number. Without propellers, "
        "check each motor's sense; swap any two of its three wires if it turns the wrong way."
    )
    done.append(
        f"Before the first flight lift the copter at its center of mass, "
        f"{_balance(design, values)}. It must hang level; move the battery if not."
    )
    done.append("Mount the propellers last, the printed side facing the thrust.")
    return tuple(done)


def _balance(design: Design, values: Mapping[str, float]) -> str:
    """Where the center of mass is, from the middle of the first part."""
    com = design.center_of_mass().tolist()
    first = design.parts[0]
    words = (("behind", "in front of"), ("left of", "right of"), ("above", "below"))
    places = [
        f"{1e3 * abs(offset):.0f} mm {pair[offset > 0.0]}"
        for name, value, pair in zip(first.position_names, com, words, strict=True)
        if abs(offset := value - values[name]) >= 5e-4
    ]
    return f"{', '.join(places) or 'at'} the middle of {first.name}"


def _mount(design: Design, motor: MotorPlan) -> str:
    side = "upside down below" if motor.pusher else "on"
    text = f"Motor {motor.number}, {motor.name}: "
    if motor.clip is None:
        return text + f"screw it {side} its carrier, square."
    clip = next(p for p in design.parts if p.name == motor.clip)
    x, y, _ = clip.rotation[:, 0]
    notch = float(np.rad2deg(np.arctan2(y, x)) % 360.0)
    holes = has_screw_holes(*clip_angles(clip), clip_middle(clip))
    fix = "screw both down" if holes else "glue both, too steep for through screws"
    return text + (
        f"put its clip (number {motor.number}) {side} the carrier, notch {notch:.0f} deg clockwise "
        f"from the front seen from above, {fix}. The thrust leans {motor.tilt:.1f} deg from up "
        f"towards {motor.azimuth:.0f} deg."
    )


def _joints(design: Design) -> list[str]:
    """What is fixed to what, besides rods and motors, which have tables and steps of their own."""
    own = {p.name for p in design.parts if p.part.rod_parameter is not None}
    own |= set(design.rotor_names)
    done = []
    for connection in design.spec.connections:
        (host, _, face), (guest, _, back) = (
            text.partition(".") for text in (connection.host, connection.guest)
        )
        if not own & {host, guest}:
            done.append(f"Fix {guest} ({back or 'closest side'}) to {host} ({face or 'there'}).")
    return done


def _end_name(direction: Array) -> str:
    """Where an end of a rod points in the copter."""
    names = (("rear", "front"), ("left", "right"), ("upper", "lower"))
    axis = int(np.abs(direction).argmax())
    return names[axis][int(direction[axis] > 0.0)]


def _roll(top: Array, axis: Array) -> float:
    """Angle of a connector's top about the rod, from up, or the front where the rod is upright."""
    reference = UP if abs(axis @ UP) < 0.99 else np.array([1.0, 0.0, 0.0])
    side = np.cross(axis, reference)
    angle = float(np.rad2deg(np.arctan2(top @ side, top @ reference)))
    return round(angle, 6) % 360.0
