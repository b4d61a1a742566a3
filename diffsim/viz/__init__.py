"""Figures, HTML reports and rerun scenes; imported by entry points, never by the simulator.

Needs the packages of the extra ``viz``. Importing this room needs nothing; what is
missing is named when it is used. Its modules are its API, with every name that has no underscore:
``figures``, ``report`` and ``scene`` are for anything, the others draw one kind of result.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffsim.core.lazy import offered

if TYPE_CHECKING:
    from diffsim.viz import (
        device_evolution,
        device_files,
        device_picture,
        diagnosis_charts,
        diagnosis_recording,
        diagnosis_report,
        fabrication_figures,
        fabrication_page,
        figures,
        fit_report,
        flight_figures,
        flight_scene,
        flow,
        flow_scene,
        frames,
        palette,
        report,
        rotors,
        scene,
    )

__all__ = [
    "device_evolution",
    "device_files",
    "device_picture",
    "diagnosis_charts",
    "diagnosis_recording",
    "diagnosis_report",
    "fabrication_figures",
    "fabrication_page",
    "figures",
    "fit_report",
    "flight_figures",
    "flight_scene",
    "flow",
    "flow_scene",
    "frames",
    "palette",
    "report",
    "rotors",
    "scene",
]
if not TYPE_CHECKING:  # to a type checker, any name would be one
    __getattr__, __dir__ = offered(__name__, {name: f"{__name__}.{name}" for name in __all__})
