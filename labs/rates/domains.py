"""Domains by name: rigs of one kind, and which of them can be recorded here."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

from labs.rates.bench import BENCH
from labs.rates.equations import ODE, TOY
from labs.rates.foreign import FOREIGN_FLIGHT, OUTSIDE
from labs.rates.laboratories import BEAM, FLIGHT, NETWORK
from labs.rates.rig import Rig
from labs.rates.rods import ROD

#: Linear equations; nonlinear ones; other people's simulators; force stands; multicopters; soft
#: rods; networks of channels; soft beams.
DOMAINS: Mapping[str, tuple[Rig, ...]] = {
    "toy": TOY,
    "ode": ODE,
    "outside": OUTSIDE,
    "bench": BENCH,
    "flight": (*FLIGHT, *FOREIGN_FLIGHT),
    "rod": ROD,
    "network": NETWORK,
    "beam": BEAM,
}


def missing_package(rig: Rig) -> str | None:
    """Package that a rig needs and that is not installed."""
    package: str | None = getattr(rig, "package", None)
    return package if package and importlib.util.find_spec(package) is None else None
