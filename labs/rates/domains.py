"""Domains by name: rigs of one kind, and which of them can be recorded here."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

from diffsim.core.check import require_choice
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


def rigs_of(domain: str) -> list[Rig]:
    """Rigs of a domain that can be recorded here.

    Args:
        domain: One of ``DOMAINS``.

    Raises:
        ValueError: no such domain.
    """
    every = DOMAINS[require_choice("domain", domain, DOMAINS)]
    return [rig for rig in every if missing_package(rig) is None]
