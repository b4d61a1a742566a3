"""Motors with propellers on a thrust stand: static sweeps.

The scatter of a reading grows with the reading, and a channel of a study has one sd: the channels
hold ``scaled`` readings (``diffsim.data.importers.common``).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.data.importers.common import facts, read_columns, read_metadata, scaled
from diffsim.data.study import Channel, Run, Study

Array = NDArray[np.float64]
COMMAND = "esc_signal_us"
RAD_S_PER_RPM = 2.0 * np.pi / 60.0
#: Floor [unit] and share of the scatter. Floors of thrust and torque: resolution of the stand
#: (README), the other two assumed. Shares: rms distance of a reading from the cubic through its
#: four neighbors (log against log, thrust above 0.5 N), of KDE and small motors together.
SCATTER = {
    "thrust_N": (0.005, 0.008),
    "torque_Nm": (0.0005, 0.009),
    "speed_rad_s": (1.0, 0.0033),
    "current_A": (0.02, 0.010),
}
KINDS = {
    "thrust_N": "force",
    "torque_Nm": "torque",
    "speed_rad_s": "velocity",
    "current_A": "current",
}
PROPELLER, DRIVE = ("thrust_N", "torque_Nm"), ("speed_rad_s", "current_A")
INCHES = {"kde2814_10in": 10.0, "kde2814_14in": 14.0}
SMALL_INCHES = 5.0
KDE_NOMINAL_V = 11.1
SECONDS_PER_READING = 0.1
HELD_OUT = ("kde2814_10in_down",)


def import_rotor_bench(folder: Path) -> Study:
    """The propellers: thrust and torque at a measured speed. One run per sweep, up or down."""
    return _study(folder, "rotor_bench", PROPELLER)


def import_rotor_drive(folder: Path) -> Study:
    """The drives: speed and current at a control signal."""
    return _study(folder, "rotor_drive", DRIVE)


def _study(folder: Path, name: str, quantities: tuple[str, ...]) -> Study:
    meta = read_metadata(folder)
    runs = [*_kde(folder, "kde2814_10in"), *_kde(folder, "kde2814_14in"), *_small(folder)]
    columns = [list(SCATTER).index(q) for q in quantities]
    return Study(
        name=name,
        system="copter",
        channels=tuple(Channel(f"scaled_{q}", "-", KINDS[q], 1.0) for q in quantities),
        runs=tuple(
            replace(run, order=order, use=_use(run.name), measured=run.measured[:, columns])
            for order, run in enumerate(runs)
        ),
        metadata=facts(
            meta,
            held_out="kde2814_10in_down: the sweep down of a propeller whose sweep up is fitted; "
            "and, of the small motors, the 11.1 V sweep of propeller 8 on each motor",
            notes="time_s counts the readings of a sweep, 0.1 s each: they are static, real times "
            "(1.8 s apart for the small motors, not recorded for the others) mean nothing, and "
            "what drifts over a sweep does so over several readings. The speed of the small "
            "motors is the electrical one, the mechanical one times an unstated factor. What is "
            "measured is among the commands, too: thrust is predicted from the measured speed, "
            "current from the measured thrust. A voltage "
            "that was not recorded is the nominal one. Where no speed was sensed although the "
            "motor drew current, the reading is left out",
        )
        | {"scatter": {k: list(v) for k, v in SCATTER.items()}},
    )


def _use(name: str) -> str:
    return "test" if name in HELD_OUT or name.endswith("8_11") else "fit"


def _kde(folder: Path, stem: str) -> list[Run]:
    recorded = ("torque_Nm", "thrust_N", "speed_rad_s", "current_A")
    names = [COMMAND, "sample", *recorded]
    data, text = read_columns(folder / f"{stem}.csv", names, ["sweep"])
    sweep = np.array(text["sweep"])
    return [
        _as_run(f"{stem}_{way}", {k: v[sweep == way] for k, v in data.items()}, INCHES[stem])
        for way in dict.fromkeys(text["sweep"])
    ]


def _small(folder: Path) -> list[Run]:
    numbers = ["supply_nominal_V", "time_s", COMMAND, "thrust_N", "voltage_V", "current_A"]
    data, text = read_columns(
        folder / "small_motors.csv", [*numbers, "electrical_speed_rpm"], ["test"]
    )
    data["speed_rad_s"] = data.pop("electrical_speed_rpm") * RAD_S_PER_RPM
    tests = np.array(text["test"])
    turns = data["speed_rad_s"] > 0.0
    return [
        _as_run(name, {k: v[(tests == name) & turns] for k, v in data.items()}, SMALL_INCHES)
        for name in dict.fromkeys(text["test"])
    ]


def _as_run(name: str, data: dict[str, Array], inches: float) -> Run:
    n = len(data[COMMAND])
    supply = float(data["supply_nominal_V"][0]) if "supply_nominal_V" in data else KDE_NOMINAL_V
    speed, reading = data["speed_rad_s"], data.get("sample", np.arange(float(n)))
    stands = speed == 0.0  # no current then, but that of the electronics
    columns = {**data, "current_A": np.where(stands, np.nan, data["current_A"])}
    columns["speed_rad_s"] = np.where(stands, np.nan, speed)
    unknown = np.full(n, np.nan)
    return Run(
        name=name,
        time_s=SECONDS_PER_READING * np.arange(float(n)),
        measured=np.column_stack([scaled(columns.get(c, unknown), *SCATTER[c]) for c in SCATTER]),
        command={
            COMMAND: data[COMMAND],
            "speed_rad_s": speed,
            "thrust_N": data["thrust_N"],
            "current_A": data["current_A"],
            "voltage_V": data.get("voltage_V", np.full(n, supply)),
            "reading": reading,
        },
        group=name,
        setup={
            "propeller_diameter_m": inches * 0.0254,
            "supply_nominal_V": supply,
            "voltage_recorded": float("voltage_V" in data),
        },
    )
