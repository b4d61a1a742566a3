"""The virtual channel network (``labs.virtual.NetworkLab``) on the Stokes simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.core.check import require_choice
from diffsim.data.study import Array, Run, Study
from diffsim.identify import Parameter
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.flow_network import (
    NetworkDevice,
    Segment,
    network_base,
    network_library,
    network_model,
)
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
    device = device_of(study.metadata, cells_per_width)
    base = base_of(study, device)
    library = network_library(device)
    if effects is not None:
        library = tuple(e for e in library if e.name in effects)
    until = max(float(run.time_s[-1]) for run in study.runs)
    effect = unknown_pressure(NUM_KNOTS, until, len(device.outlets))
    knots = smooth_covariance(np.linspace(0.0, until, NUM_KNOTS), 2.0 * until / (NUM_KNOTS - 1))
    covariance: Array = np.kron(np.eye(len(device.outlets)), knots).astype(np.float64)
    unknown = UnknownForce(effect, covariance, "unknown pressure")
    return DiagnosisSetup(
        network_model(
            device,
            base,
            pump=PUMP,
            back_pressures=BACK_PRESSURES,
            columns=columns_of(study),
            corrected=corrected,
        ),
        library,
        (unknown,),
        bank(study),
        DiagnosisSettings(accept_numerics=accept_numerics),
    )


def columns_of(study: Study) -> tuple[int, ...]:
    """Which of the model's channels the study holds."""
    return tuple(
        CHANNELS.index(require_choice(f"study {study.name}: channel", c.name, CHANNELS))
        for c in study.channels
    )


def device_of(facts: Mapping[str, Any], cells_per_width: float = CELLS_PER_WIDTH) -> NetworkDevice:
    """The device that a study's metadata describes."""
    geometry = facts["geometry"]
    channels = {name: dict(c) for name, c in geometry["channels"].items()}
    spacing = min(float(c["width_m"]) for c in channels.values()) / cells_per_width
    box = tuple(float(x) for x in geometry["box_m"])
    return NetworkDevice(
        nodes={n: (float(x), float(y)) for n, (x, y) in geometry["position_m"].items()},
        segments=tuple(
            Segment(n, c["start"], c["end"], float(c["width_m"])) for n, c in channels.items()
        ),
        outlets=tuple(f"outlet_{i}" for i in (1, 2, 3)),
        tap=float(geometry["tap_share"]),
        size=(box[0], box[1]),
        cells=(round(box[0] / spacing), round(box[1] / spacing)),
        depth=float(geometry["depth_m"]),
        viscosity=float(facts["base_priors"]["viscosity"]["value"]),
        shear_rate=float(facts["thinning_rate_1_s"]),
        density=float(facts["density_kg_m3"]),
        throat=float(geometry["blockage_share"]),
    )


def base_of(study: Study, device: NetworkDevice) -> tuple[Parameter, ...]:
    """Base parameters with the study's priors; nuisances as its facts state them."""
    facts = study.metadata
    known, nuisances = facts["base_priors"], facts["nuisances"]
    spread = {"pump_gain": "pump_gain_sd", "flow_gain": "meter_gain_sd"}
    out = []
    for p in network_base(device, [r.name for r in study.runs]):
        sd = p.sd
        if p.name in known:
            sd = float(known[p.name]["relative_sd"])
        elif p.name.startswith("pressure_zero"):
            sd = float(nuisances["pressure_zero_sd_Pa"])
        else:
            stem = p.name.split("@")[0].rstrip("_0123456789")
            sd = float(nuisances[spread[stem]])
        out.append(Parameter(p.name, p.value, sd, p.unit, p.log))
    return tuple(out)


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
