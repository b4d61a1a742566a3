"""The virtual channel network (``labs.virtual.NetworkLab``) on the Stokes simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.causes.listing import list_causes
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.schema import read_part
from diffsim.data.study import Run, Study
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.description import chosen_effects
from diffsim.systems.flow_network.device_description import FlowDeviceDescription
from labs.systems.unknown_pressure import unknown_pressure

PUMP, BACK_PRESSURES = "pump_m3_s", ("outlet_1_Pa", "outlet_2_Pa", "outlet_3_Pa")
CHANNELS = ("outlet_1_m3_s", "outlet_2_m3_s", "outlet_3_m3_s", "pump_Pa", "tap_Pa")
CELLS_PER_WIDTH = 6.8
"""Of the narrowest channel: 50 um."""
NUM_KNOTS = 7


def setup(
    study: Study,
    *,
    cells_per_width: float = CELLS_PER_WIDTH,
    corrected: bool = True,
    effects: Sequence[str] | None = None,
    accept_numerics: bool = False,
) -> DiagnosisSetup:
    """Model, causes and runs to record next for a study of the channel network.

    Args:
        study: Study made by the laboratory, with its facts in the metadata.
        cells_per_width: Grid cells across the narrowest channel.
        corrected: Correct the flows' resistance for the cell size once, from a finer grid.
        effects: Names of the candidate causes; None: all.
        accept_numerics: Go on although the numerics gate fails.
    """
    for channel in study.channels:
        require_choice(f"study {study.name}: channel", channel.name, CHANNELS)
    described = read_part(
        FlowDeviceDescription,
        {
            **describe(study.metadata, cells_per_width),
            "is_corrected": corrected,
            "effects": {} if effects is None else {"only": list(effects)},
        },
        "network",
    )
    until = max(float(run.time_s[-1]) for run in study.runs)
    effect = unknown_pressure(NUM_KNOTS, until, BACK_PRESSURES)
    knots = smooth_covariance(np.linspace(0.0, until, NUM_KNOTS), 2.0 * until / (NUM_KNOTS - 1))
    covariance: Array = np.kron(np.eye(len(BACK_PRESSURES)), knots).astype(np.float64)
    unknown = UnknownForce(effect, covariance, "unknown pressure")
    causes = list_causes(described.plant(study))
    return DiagnosisSetup(
        described.model(study),
        chosen_effects(causes, described.effects),
        (unknown,),
        bank(study),
        DiagnosisSettings(accept_numerics=accept_numerics),
    )


def describe(facts: Mapping[str, Any], cells_per_width: float = CELLS_PER_WIDTH) -> dict[str, Any]:
    """``model:`` of a study whose metadata are the laboratory's facts."""
    geometry, known, spread = facts["geometry"], facts["base_priors"], facts["nuisances"]

    def sized(value: float, name: str) -> dict[str, float]:
        return {"value": float(value), "percent": 100.0 * float(known[name]["relative_sd"])}

    channels = geometry["channels"]
    spacing = min(float(c["width_m"]) for c in channels.values()) / cells_per_width
    return {
        "system": "flow_device",
        "network": {
            "nodes": geometry["position_m"],
            "channels": [
                {
                    "name": name,
                    "from": c["start"],
                    "to": c["end"],
                    "width": sized(c["width_m"], f"width_{name}"),
                }
                for name, c in channels.items()
            ],
            "outlets": [f"outlet_{i}" for i in (1, 2, 3)],
            "tap": geometry["tap_share"],
            "size": geometry["box_m"],
            "cells": [round(x / spacing) for x in geometry["box_m"]],
            "depth": geometry["depth_m"],
        },
        "viscosity": sized(known["viscosity"]["value"], "viscosity"),
        "density": facts["density_kg_m3"],
        "shear_rate": facts["thinning_rate_1_s"],
        "drives": [PUMP],
        "back_pressures": list(BACK_PRESSURES),
        "flows": list(CHANNELS[:3]),
        "pressures": list(CHANNELS[3:]),
        "nuisances": {
            "pump_gain": spread["pump_gain_sd"],
            "flow_gain": spread["meter_gain_sd"],
            "pressure_zero": spread["pressure_zero_sd_Pa"],
        },
    }


def bank(study: Study) -> tuple[Run, ...]:
    """Runs that could be recorded next: drive over two decades, backwards, back pressures on every
    outlet, and one closed by the pressure behind it."""
    time = np.arange(60.0)
    width = len(study.channels)
    top = max(float(np.abs(r.command[PUMP]).max()) for r in study.runs)
    steps = np.repeat(np.linspace(1.0 / 6.0, 1.0, 6), 10)

    def run(name: str, drive: Array, **back: Array) -> Run:
        command = {PUMP: drive, **back}
        return Run(name, time, np.zeros((len(time), width)), command, name, use="fit")

    rising = 40.0 * steps
    return (
        run("drive_tiny", 0.01 * top * steps),
        run("drive_low", 0.1 * top * steps),
        run("drive_full", top * steps),
        run("drive_double", 2.0 * top * steps),
        run("drive_back", -top * steps),
        run("back_pressure_1", 0.5 * top * np.ones(60), outlet_1_Pa=rising),
        run("back_pressure_2", 0.5 * top * np.ones(60), outlet_2_Pa=rising),
        run("back_pressure_3", 0.5 * top * np.ones(60), outlet_3_Pa=rising),
        run("pump_off", np.zeros(60), outlet_1_Pa=rising, outlet_3_Pa=-rising),
        run("outlet_2_held_shut", 0.5 * top * np.ones(60), outlet_2_Pa=2.0 * rising),
    )
