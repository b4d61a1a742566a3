"""Libraries of candidate causes by system, imported when asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from diffsim.core.check import require_choice
from diffsim.identify.effect import Effect

_LIBRARIES = {
    "soft_body": ("diffsim.systems.soft_body", "soft_body_library"),
    "copter": ("diffsim.systems.multicopter", "copter_library"),
    "stokes": ("diffsim.systems.flow_network", "stokes_library"),
}


def library(system: str, **options: Any) -> list[Effect]:
    """Candidate causes of a system, to which own ones may be added.

    Args:
        system: "soft_body", "copter" or "stokes".
        **options: Options of that library; "copter" takes num_rotors, 4 by default, "stokes" the
            device.

    Raises:
        ValueError: no such system; the message offers the closest names.
    """
    module, name = _LIBRARIES[require_choice("system", system, _LIBRARIES)]
    return list(getattr(import_module(module), name)(**options))
