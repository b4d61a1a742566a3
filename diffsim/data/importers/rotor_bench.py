"""Motors with propellers on a thrust stand: static sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

COMMAND = "esc_signal_us"
RAD_S_PER_RPM = 2.0 * np.pi / 60.0
CHANNELS = (
    Channel("thrust_N", "N", "force", 0.005),  # resolution of the stand (README)
    Channel("torque_Nm", "N m", "torque", 0.0005),
    Channel("speed_rad_s", "rad/s", "velocity"),
    Channel("current_A", "A", "current"),
    Channel("voltage_V", "V", "voltage"),
    Channel("electrical_speed_rad_s", "rad/s", "velocity"),
)
INCHES = {"kde2814_10in": 10.0, "kde2814_14in": 14.0}
SMALL_INCHES = 5.0
HELD_OUT = ("kde2814_10in_down",)


def import_rotor_bench(folder: Path) -> Study:
    """Sweeps up and down, one run each; what a stand did not record is missing."""
    meta = read_metadata(folder)
    runs = [*_kde(folder, "kde2814_10in"), *_kde(folder, "kde2814_14in")]
    runs += _small(folder, first_order=len(runs))
    return Study(
        name="rotor_bench",
        system="copter",
        channels=CHANNELS,
        runs=tuple(
            Run(**{**vars(run), "order": order, "use": _use(run.name)})
            for order, run in enumerate(runs)
        ),
        metadata=facts(
            meta,
            held_out="kde2814_10in_down: the sweep down of a propeller whose sweep up is fitted; "
            "and, of the small motors, the 11.1 V sweep of propeller 8 on each motor",
            notes="time_s of the kde2814 runs is the number of the reading: the stand recorded no "
            "time; the readings are static, so only their order matters; the electrical speed is "
            "the mechanical one times an unstated number of pole pairs; speed, current and "
            "voltage have no stated noise",
        )
        | {"hardware_kde": meta["hardware_kde"], "hardware_small": meta["hardware_small"]},
    )


def _use(name: str) -> str:
    return "holdout" if name in HELD_OUT or name.endswith("8_11") else "fit"


def _kde(folder: Path, stem: str) -> list[Run]:
    recorded = ("torque_Nm", "thrust_N", "speed_rad_s", "current_A")
    data, text = read_columns(folder / f"{stem}.csv", [COMMAND, *recorded], ["sweep"])
    sweep = np.array(text["sweep"])
    return [
        _as_run(f"{stem}_{way}", {k: v[sweep == way] for k, v in data.items()}, INCHES[stem])
        for way in dict.fromkeys(text["sweep"])
    ]


def _small(folder: Path, first_order: int) -> list[Run]:
    numbers = ["supply_nominal_V", "time_s", COMMAND, "thrust_N", "voltage_V", "current_A"]
    data, text = read_columns(
        folder / "small_motors.csv", [*numbers, "electrical_speed_rpm"], ["test"]
    )
    data["electrical_speed_rad_s"] = data.pop("electrical_speed_rpm") * RAD_S_PER_RPM
    tests = np.array(text["test"])
    return [
        _as_run(name, {k: v[tests == name] for k, v in data.items()}, SMALL_INCHES)
        for name in dict.fromkeys(text["test"])
    ]


def _as_run(name: str, data: dict[str, np.ndarray], inches: float) -> Run:
    n = len(data[COMMAND])
    unknown = np.full(n, np.nan)
    setup = {"propeller_diameter_m": inches * 0.0254}
    if "supply_nominal_V" in data:
        setup["supply_nominal_V"] = float(data["supply_nominal_V"][0])
    return Run(
        name=name,
        time_s=data.get("time_s", np.arange(float(n))),
        measured=np.column_stack([data.get(c.name, unknown) for c in CHANNELS]),
        command={COMMAND: data[COMMAND]},
        group=name,
        setup=setup,
    )
