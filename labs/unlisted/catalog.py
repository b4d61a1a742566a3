"""Kinds of cases: what is hidden, and in which machines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from labs.unlisted import laws_of_flow_and_sensors as flows
from labs.unlisted import laws_of_moving as moving
from labs.unlisted import laws_of_turning as turning
from labs.unlisted import listed
from labs.unlisted.machine import Law, Machine

UNLISTED, LISTED, SOUND = "unlisted", "listed", "sound"
COLOR, LOST_ROWS, FAR_SHEET, PLAIN = "colored noise", "lost rows", "data sheet off", "plain"


@dataclass(frozen=True)
class Kind:
    """Cases of one kind."""

    group: str  # ``unlisted``, ``listed`` (the library has it) or ``sound`` (nothing is hidden)
    machines: tuple[str, ...]  # machines that may have it, by name
    # draws the hidden law; none: nothing is hidden
    law: Callable[[np.random.Generator, Machine], Law] | None = None
    dirt: str = PLAIN  # trouble of the recordings that is no cause


def _unlisted(law: Callable[[np.random.Generator, Machine], Law], *machines: str) -> Kind:
    return Kind(UNLISTED, machines, law)


ANY = ("cart", "pendulum", "shaft", "hull", "tank", "masses", "vane")
KINDS: Mapping[str, Kind] = {
    "cogging": _unlisted(turning.cogging, "shaft", "pendulum"),
    "unbalance": _unlisted(turning.unbalance, "shaft"),
    "commutation": _unlisted(turning.commutation, "shaft"),
    "encoder_ellipse": _unlisted(turning.encoder_ellipse, "shaft"),
    "gear_ripple": _unlisted(turning.gear_ripple, "shaft", "pendulum"),
    "iron": _unlisted(turning.iron, "shaft", "pendulum"),
    "battery": _unlisted(turning.battery, "shaft", "hull"),
    "wind_direction": _unlisted(turning.wind_direction, "vane"),
    "warm_winding": _unlisted(turning.warm_winding, "coil", "motor"),
    "wire_rope": _unlisted(moving.wire_rope, "cart", "masses"),
    "bouc_wen": _unlisted(moving.bouc_wen, "cart", "masses"),
    "odd_relaxation": _unlisted(moving.odd_relaxation, "cart", "tacho_cart"),
    "slosh": _unlisted(moving.slosh, "cart", "tacho_cart"),
    "flexible_mode": _unlisted(moving.flexible_mode, "cart", "tacho_cart"),
    "magnet": _unlisted(moving.magnet, "cart", "tacho_cart"),
    "wall": _unlisted(moving.wall, "stand"),
    "ground_cushion": _unlisted(moving.ground_cushion, "stand"),
    "cable": _unlisted(moving.cable, "cart", "masses"),
    "unequal_spring": _unlisted(moving.unequal_spring, "cart", "masses"),
    "screw": _unlisted(moving.screw, "cart", "slider"),
    "warm_damping": _unlisted(moving.warm_damping, "cart", "vane"),
    "warm_spring": _unlisted(moving.warm_spring, "cart", "vane"),
    "bellows": _unlisted(moving.bellows, "cart", "tacho_cart"),
    "worn_spring": _unlisted(moving.worn_spring, "cart", "masses"),
    "aging_friction": _unlisted(moving.aging_friction, "slider"),
    "warm_tire": _unlisted(moving.warm_tire, "car"),
    "head_wind": _unlisted(moving.head_wind, "hull"),
    "advance": _unlisted(moving.advance, "hull"),
    "leak_above": _unlisted(flows.leak_above, "tank", "pipe_tank"),
    "relief_valve": _unlisted(flows.relief_valve, "vessel"),
    "floor_hole": _unlisted(flows.floor_hole, "tanks"),
    "thin_oil": _unlisted(flows.thin_oil, "pipe_tank"),
    "radiation": _unlisted(flows.radiation, "plate"),
    "fan": _unlisted(flows.fan, "plate"),
    "cross_talk": _unlisted(flows.cross_talk, "table"),
    "rotated_sensor": _unlisted(flows.rotated_sensor, "table"),
    "skewed_drives": _unlisted(flows.skewed_drives, "table"),
    "creeping_cell": _unlisted(flows.creeping_cell, "press"),
    "sound": Kind(SOUND, ANY),
    "sound_colored": Kind(SOUND, ANY, dirt=COLOR),
    "sound_lost_rows": Kind(SOUND, ANY, dirt=LOST_ROWS),
    "sound_far_sheet": Kind(SOUND, ANY, dirt=FAR_SHEET),
    "dry_friction": Kind(LISTED, ("cart", "pendulum"), listed.dry_friction),
    "lag": Kind(LISTED, ("cart", "pendulum", "vane"), listed.lag),
    "sensor_scale": Kind(LISTED, ("tacho_cart",), listed.sensor_scale),
    "cubic_spring": Kind(LISTED, ("cart", "vane"), listed.cubic_spring),
}
