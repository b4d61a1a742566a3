"""Populations of recordings: what studies and formats make of files that are written here."""

from collections.abc import Mapping
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffsim import cli
from diffsim.data import load_study
from diffsim.data.formats import left_out_of, parts_of, read_columns, write_columns
from diffsim.data.study import Study
from tests.known.fingerprint import numbers_in

FILE = {"name": "a", "file": "a.csv"}
EACH = {"name": "r{trial}", "file": "all.csv", "split": "trial"}
MM = {"column": "pos (mm)", "unit": "mm"}
#: keys of a study beside those of ``tests.data.test_study_mapping``
MAPPINGS: dict[str, dict[str, Any]] = {
    "plain": {"runs": [FILE]},
    "split": {
        "runs": [
            EACH
            | {
                "use": {"test": [3], "select": 2},
                "group": "rig {rig}",
                "setup": {"trial": "column", "level": {"value": "{trial}", "unit": "mbar"}},
            }
        ]
    },
    "some": {"runs": [{"file": "all.csv", "split": ["rig", "trial"], "where": {"trial": [1, 3]}}]},
    "window": {"runs": [FILE | {"from_s": 0.1, "until_s": 0.3, "zero_time": "start"}]},
    "windows by run": {"runs": [EACH | {"until_s": {2: 0.1}, "from_s": {3: 0.2}}]},
    "trigger": {
        "runs": [
            FILE | {"zero_when": "`pos (mm)` > 200", "before_zero_s": 0.02, "after_zero_s": 0.05}
        ]
    },
    "every": {"runs": [FILE | {"every": {0: 2, 0.2: 10}}]},
    "mean": {"runs": [FILE | {"every": 4, "average": True}]},
    "missing": {"runs": [FILE | {"missing_if": "t > 0.25"}]},
    **{
        f"stamps {key} {how}": {"runs": [{"file": f"{key}.csv", "stamps": {key: how}}]}
        for key, how in (
            ("missing", "line"),
            ("missing", "drop"),
            ("backward", "sort"),
            ("backward", "drop"),
            ("jumps", "close"),
        )
    },
    **{
        f"duplicates {how}": {"runs": [{"file": "twice.csv", "duplicates": how}]}
        for how in ("first", "last", "mean", "spread")
    },
    "blocks": {"runs": [FILE | {"blocks": {"num": 4, "use": {"select": [3], "test": [4]}}}]},
    "long blocks": {"runs": [FILE | {"blocks": {"length_s": 0.15, "restart_time": True}}]},
    "repeat": {"runs": [FILE, {"name": "b", "file": "a.csv", "repeat_of": "a"}]},
    "step": {"time": {"step": 0.5}, "runs": [FILE]},
    "formulas": {
        "channels": [
            {"name": "middle", "formula": "0.5*(`pos (mm)` + `right 2`)", "unit": "mm"},
            {"name": "moved", "zero_s": [0.0, 0.02], **MM},
            {"name": "seen", "formula": "`pos (mm)` if trial < 2 else nan", "unit": "mm"},
            {"name": "half", "scale": 0.5, "offset": 1.0, **MM},
            {"name": "turned", "decode": {"wrap": 60}, **MM},
            {"name": "coded", "decode": {"missing": 21}, **MM},
        ],
        "commands": [{"name": "pressure", "formula": "level*(t >= 0.1)"}],
        "defaults": {"setup": {"level": {"value": 2, "unit": "mbar"}}, "until_s": 0.2},
        "runs": [EACH],
    },
    **{
        f"fill {fill}": {
            "commands": [{"name": "sent", "unit": "N", "fill": fill, "column": "sent"}],
            "runs": [{"name": "a", "file": ["a.csv", "sent.csv"]}],
        }
        for fill in ("hold", "linear")
    },
}


def mappings(folder: Path) -> dict[str, Any]:
    """Studies of one set of files, described in every way."""
    from tests.data import test_study_mapping as files

    files.write_csv(folder / "a.csv", files.rows(1))
    lines = [*files.rows(1), *files.rows(2, "B"), *files.rows(3)]
    files.write_csv(folder / "all.csv", lines)
    for name, rows in spoiled(files.rows(1)).items():
        files.write_csv(folder / f"{name}.csv", rows)
    sent = [[i * 20 + 1, i**2 if i % 7 else ""] for i in range(20)]
    files.write_csv(folder / "sent.csv", sent, ["t (ms)", "sent"])
    return {name: facts_of(files.load(folder, **keys)) for name, keys in MAPPINGS.items()}


def spoiled(rows: list[list[Any]]) -> dict[str, list[list[Any]]]:
    """A table with stamps that cannot be right, by what is wrong with them."""
    times = [row[0] for row in rows]
    wrong = {
        "missing": ["" if k in (5, 6, 20) else t for k, t in enumerate(times)],
        "backward": [*times[:14], times[15], times[14], *times[16:]],
        "jumps": [t + 3.6e6 * (k > 29) for k, t in enumerate(times)],
        "twice": [times[k - (k % 10 == 3)] for k in range(len(times))],
    }
    return {
        name: [[t, *row[1:]] for t, row in zip(stamps, rows, strict=True)]
        for name, stamps in wrong.items()
    }


def facts_of(study: Study) -> list[Any]:
    """All of a study that is a number or a word of its own."""
    runs = [
        [r.name, r.use, r.group, r.order, r.setup, r.time_s, r.measured, r.command, r.columns]
        for r in study.runs
    ]
    channels = [(c.name, c.unit, c.kind, c.sd, c.sensor, c.shown_unit) for c in study.channels]
    commands = [(c.name, c.unit, c.lower, c.upper, c.rate) for c in study.commands]
    return [runs, channels, commands, len(study.left_out)]


def formats(folder: Path) -> dict[str, Any]:
    """Columns of every format, as the library of the format writes them."""
    import h5py
    import openpyxl
    from scipy.io import savemat

    from tests.data import flight_logs
    from tests.data import test_formats as files
    from tests.systems import small_copter

    for suffix in ("parquet", "h5", "mat"):
        write_columns(folder / f"log.{suffix}", files.COLUMNS)
    time = files.TIME
    savemat(folder / "two.mat", {"gain": 3.0, "q": time[None], "run2": {"t": time, "q": time}})
    np.savez(folder / "log.npz", t=time, q=np.stack([time, -time], 1), gain=3.0)
    with h5py.File(folder / "deep.h5", "w") as file:
        file["t"], file["angle"], file["gain"] = time, 2.0 * time, 3.0
        file["angle"].attrs["units"] = "deg"
        file["imu/gyro"] = np.stack([time, 1.0 - time], 1)
        file["camera"] = np.zeros((11, 8, 9), dtype=np.uint8)
        file["slow/time"], file["slow/volts"] = time, time**2
    book = openpyxl.Workbook()
    for row in (["Bench"], [], ["time_s", "Force [N]"], *([t, t**2] for t in time.tolist())):
        book.active.append(row)
    book.save(folder / "log.xlsx")
    files.write_mcap(folder / "log.mcap")
    flight = small_copter.fly("circle", small_copter.Causes(), seconds=0.4, fine=1)
    flight_logs.write_ulog(folder / "log.ulg", flight)
    flight_logs.write_rosbag(folder / "bag", flight)
    out: dict[str, Any] = {}
    found = sorted([*folder.glob("*.*"), *(folder / "bag").glob("*.db3")])
    for path in found:
        for part in parts_of(path):
            whole = f"{path}#{part}"
            out[f"{path.name}#{part}"] = [dict(read_columns(whole)), len(left_out_of(whole))]
    return out


def damaged(folder: Path, first: int = 0) -> dict[str, Any]:
    """What is said of records with faults, of every second kind."""
    from labs.records.__main__ import told
    from labs.records.damages import DAMAGES, damaged

    out = {}
    for damage in DAMAGES[first::2]:
        _, record = damaged(np.random.default_rng(3), damage)
        said = told(record, folder / damage.name)
        out[damage.name] = [(rule, numbers_in(text), stops) for rule, text, stops in said]
    return out


def jumping(folder: Path) -> dict[str, Any]:
    """Commands that jump off and back, or stay; what is made of them."""
    from diffsim.data.command_jumps import jumps_of, without_jumps
    from tests.data import test_command_jumps as case

    out = {}
    for name, rows, off in (
        ("back", [60, 200, 201], [9e-4, -6e-4, -6e-4]),
        ("lasting", slice(260, None), 8e-4),
        ("both", [*range(30, 500), 100], [8e-4] * 470 + [2e-3]),
    ):
        values = case.SWAY + case.NOISE
        values[rows] += off
        for is_measured in (True, False):
            jumps = jumps_of(values, is_measured=is_measured, times=case.TIME)
            mended = without_jumps(values, case.TIME, jumps)
            out[f"{name} {is_measured}"] = [jumps.back, jumps.lasting, jumps.size, mended]
    return out


def exports(folder: Path) -> dict[str, Any]:
    """The answer about a servo in every language, and what each carries."""
    from tests.cli import test_diagnose_export_to as servo

    for name, goal in servo.GOALS.items():
        table = np.column_stack([servo.TIME, goal, 0.5 * goal, servo.POWER[name]])
        head = "time_s,goal,position,powered"
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=head, comments="")
    (folder / "study.yaml").write_text(yaml.safe_dump(servo.SERVO))
    servo.write_answer(folder, servo.NUMBERS, servo.CAUSES)
    out = {}
    for target in ("mujoco", "bam", "urdf", "yaml"):
        place, said = folder / target, StringIO()
        place.mkdir()
        (place / "extended_model.yaml").write_text(
            (folder / "answer" / "extended_model.yaml").read_text()
        )
        words = f"diagnose export {folder} --to {target} --out {place}".split()
        with redirect_stdout(said):
            status = cli.main(words)
        out[target] = [status, numbers_in(said.getvalue().replace(str(folder), ""))]
        for path in sorted(place.iterdir()):
            out[f"{target} {path.name}"] = numbers_in(path.read_text("utf-8"))
    return out


def _logger(folder: Path) -> None:
    """Files of a logger with German headers, units and marks."""
    from tests.cli.test_diagnose_init import T, noisy, write

    for seed, (name, level, load) in enumerate((("slow", 1.0, 0.2), ("heavy", 2.0, 0.5))):
        force = np.where(T > 200.0, level, 0.0) + np.where(T > 400.0, 0.5, 0.0)
        columns = [T, 30.0 * force + noisy(seed), force, np.full(60, load), np.arange(60.0)]
        head = "Zeit (ms);Weg [mm];F_N;Nutzlast (kg);frame"
        write(folder / f"{name}.csv", head, columns, mark=";", point=",")


def _trials(folder: Path) -> None:
    """One file of many trials, with dates, a counter and a column that is degrees."""
    from tests.cli.test_diagnose_init import noisy, write

    days = [f"2024-05-01 12:00:{0.1 * k:06.3f}" for k in range(60)]
    trial = np.repeat([1.0, 2.0, 3.0], 20)
    angle = 400.0 * np.sin(0.3 * np.arange(60)) + noisy(1)
    drive = np.repeat([0.0, 2.0, 1.0, 3.0, 0.0, 1.0], 10)
    write(folder / "all.csv", "date,trial,angle_deg,volts (V)", [days, trial, angle, drive])


def _hours(folder: Path) -> None:
    """Times of day beside a command that steps."""
    from tests.cli.test_diagnose_init import noisy, write

    clock = [f"{11 + k // 40}:{59 * (k < 40):02d}:{(20 + 1.01 * k) % 60:05.2f}" for k in range(60)]
    drive = np.repeat([0.0, 2.0, 1.0, 3.0, 0.0, 1.0], 10)
    write(folder / "day.csv", "clock,volts (V),x [mm]", [clock, drive, 5.0 * drive + noisy(2)])


def _arm(folder: Path) -> None:
    from tests.cli.test_diagnose_init_folders import arm

    arm(folder, 4)


def _instruments(folder: Path) -> None:
    from tests.cli.test_diagnose_init import two_instruments

    two_instruments(folder, late=0.3)


FOLDERS = {
    "logger": _logger,
    "trials": _trials,
    "hours": _hours,
    "arm": _arm,
    "instruments": _instruments,
}


def first_studies(folder: Path) -> dict[str, Any]:
    """What a first look makes of folders of strangers."""
    out: dict[str, Any] = {}
    for name, write in FOLDERS.items():
        place, said = folder / name, StringIO()
        place.mkdir()
        write(place)
        with redirect_stdout(said):
            status = cli.main(["diagnose", "init", str(place)])
        study = load_study(place)
        out[name] = facts_of(study)
        told = said.getvalue().replace(str(folder), "")
        out[f"{name} said"] = [status, len(study.todo), told.count("\n"), numbers_in(told)]
        out[f"{name} file"] = yaml.safe_load((place / "study.yaml").read_text("utf-8"))
    return out


def columns_beside(folder: Path) -> dict[str, Any]:
    """Columns that a study does not mention."""
    from tests.data import test_columns_beside as files

    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        more = {"rpm": 60.0 * rng.normal(size=files.COUNT), "state": [seed] * files.COUNT}
        files.write(folder / f"{name}.csv", files.columns_of(seed) | more)
    (folder / "study.yaml").write_text(yaml.safe_dump(files.STUDY))
    study = load_study(folder)
    return {"columns": [vars(c) for c in study.columns], "study": facts_of(study)}


RECORDS: Mapping[str, Any] = {
    "mappings": mappings,
    "formats": formats,
    "damaged": damaged,
    "damaged otherwise": partial(damaged, first=1),
    "jumping": jumping,
    "exports": exports,
    "columns": columns_beside,
    "first studies": first_studies,
}
