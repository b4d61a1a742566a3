"""All cases by name, and the package that each needs."""

from __future__ import annotations

from collections.abc import Mapping

from labs.outside.arms import ARMS
from labs.outside.case import Maker
from labs.outside.flights import FLIGHTS
from labs.outside.mechanisms import MECHANISMS
from labs.outside.rods import RODS

CASES: Mapping[str, tuple[str, Maker]] = {
    **{name: ("mujoco", make) for name, make in MECHANISMS.items()},
    **{name: ("mujoco", make) for name, make in ARMS.items()},
    **{name: ("rotorpy", make) for name, make in FLIGHTS.items()},
    **{name: ("elastica", make) for name, make in RODS.items()},
}
