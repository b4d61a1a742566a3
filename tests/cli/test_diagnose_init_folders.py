"""``diffsim diagnose init`` on folders as they are downloaded: runs in folders, files of one run.

The small folders have the layouts of published ones; the published ones are opened, too, where
they are on this machine.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim.data import find_dataset, load_study
from diffsim.data.folder_rules import guess_study
from diffsim.data.formats import parts_of, read_columns, write_columns
from tests.cli.test_diagnose_init import T, init, noisy, write

STEPS = np.repeat([0.0, 1.0, -1.0], 20)


def names(of) -> list[str]:
    return [one.name for one in of]


def arm(folder: Path, num: int) -> None:
    """Of each run goals, their durations and what was read, all in columns of the same names."""
    for k in range(num):
        run = folder / "runs" / f"fixed_{chr(97 + k)}"
        run.mkdir(parents=True)
        start = 1658378094.76436 + 3600.0 * k
        goals = [300.0 + 40.0 * k, 600.0, 333.0, 500.0]
        stamps = [f"{start + 2.01 * i:.5f}" for i in range(4)]
        times = [800.0, 1600.0, 400.0, 1200.0]
        header = "timestamp,motor_1,motor_2"
        write(run / "watch_cmd.csv", header, [stamps, goals, goals[::-1]])
        write(run / "watch_cmd_duration.csv", header, [stamps, times, times[::-1]])
        clock = [f"{start + 1.0 + 0.1 * i:.5f}" for i in range(60)]
        read = [450.0 + noisy(5 * k + j, 9.0).round() for j in range(2)]
        write(run / "watch_position.csv", header, [clock, *read])


@pytest.mark.parametrize("num", [4, 14])
def test_goal_duration_and_reading_of_a_run_have_a_folder(tmp_path, num):
    arm(tmp_path, num)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert names(study.channels) == ["motor_1", "motor_2"]
    assert names(study.commands) == [
        f"motor_{k}_{what}" for what in ("cmd", "cmd_duration") for k in (1, 2)
    ]
    assert names(study.runs) == [f"fixed_{chr(97 + k)}" for k in range(num)]
    assert ("{run}" in (tmp_path / "study.yaml").read_text()) == (num == 14)
    run = study.runs[1]
    np.testing.assert_allclose(run.time_s, 0.1 * np.arange(60), atol=1e-5)
    goal = run.command["motor_1_cmd"]  # rests until the next, half a row of it beside each jump
    assert goal[[0, 9, 13, 51, 59]].tolist() == [340.0, 340.0, 600.0, 500.0, 500.0]
    assert study.runs[-1].use == "test"


def test_a_list_of_the_runs_is_told_with_what_takes_its_facts(tmp_path, capsys):
    arm(tmp_path, 3)
    (tmp_path / "labels.csv").write_text("run,label\nfixed_a,healthy\nfixed_b,stuck\nfixed_c,off\n")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if "labels.csv lists the runs" in line)
    study = tmp_path / "study.yaml"
    stated = yaml.safe_load(study.read_text())
    study.write_text(yaml.safe_dump({**stated, **yaml.safe_load(line.partition("write ")[2])}))
    assert [run.setup for run in load_study(study).runs] == [
        {"label": label} for label in ("healthy", "stuck", "off")
    ]


def test_lists_in_cells_goals_and_states_with_the_same_columns(tmp_path):
    for k, name in enumerate(("chirp", "prbs", "step")):
        (tmp_path / name).mkdir()
        stamps = 5.0 + 20060.0 * np.arange(60)
        goal = np.sin(0.002 * T + k)
        for file, kind, seed in (("control", "CONTROL", None), ("state_motor", "STATE", k)):
            q = goal if seed is None else goal + noisy(seed, 0.01)
            cells = [f'"[{a:.6f}, {-a:.6f}]"' for a in q]
            more, torque = (
                ("", []) if seed is None else (",torques", [[f'"[{a * a}, {abs(a)}]"' for a in q]])
            )
            header = f"type,timestamp,positions{more}"
            write(tmp_path / name / f"{file}.csv", header, [[kind] * 60, stamps, cells, *torque])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert names(study.commands) == ["positions_0_control", "positions_1_control"]
    assert names(study.channels) == [f"{n}_{k}" for n in ("positions", "torques") for k in (0, 1)]
    run = study.runs[2]
    np.testing.assert_allclose(run.time_s, 1e-6 * (5.0 + 20060.0 * np.arange(60)), rtol=1e-9)
    np.testing.assert_allclose(
        run.command["positions_1_control"], -np.sin(0.002 * T + 2), atol=1e-6
    )
    np.testing.assert_allclose(run.measured[:, 0], np.sin(0.002 * T + 2), atol=0.05)
    assert not any(run.setup for run in study.runs)  # `type` is the same in all


def test_files_without_a_header_of_which_one_is_the_clock(tmp_path):
    for k in range(3):
        run = tmp_path / f"measurement_{8 + k}"
        run.mkdir()
        speed = np.linspace(0.3, 0.4 + 0.1 * k, 60)
        (run / "time.csv").write_text("\n".join(f"{v:g}" for v in 0.025 * np.arange(60)))
        write(run / "input.csv", f"{0.1 * k},0.3", [np.full(58, 0.1 * k), speed[1:59]])
        write(run / "trajectory.csv", "0,0,0", [noisy(k, num=59), noisy(9 + k, num=59), speed[1:]])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert names(study.runs) == ["measurement_8", "measurement_9", "measurement_10"]
    assert names(study.channels) == ["trajectory_1", "trajectory_2", "trajectory_3"]
    assert names(study.commands) == ["input_1", "input_2"]  # constant in a run, and commanded
    run = study.runs[2]
    np.testing.assert_allclose(run.time_s, 0.025 * np.arange(60), rtol=1e-9)
    np.testing.assert_allclose(run.command["input_1"], 0.2)
    assert (
        run.command["input_2"][-1] == run.command["input_2"][-2] == pytest.approx(0.595, rel=1e-3)
    )
    assert any(s.startswith("columns of `table`: the files name none") for s in study.todo)


def test_a_torque_drives_where_nothing_was_commanded(tmp_path):
    (tmp_path / "metadata.yaml").write_text("name: a folder, and no bag\n")
    for k, name in enumerate(("pd", "swing")):
        q, tau = np.sin(0.01 * T) + noisy(k, 0.01), np.cos(0.01 * T) + noisy(k + 5, 0.05)
        write(tmp_path / f"{name}.csv", "time,position,torque", [1e-3 * T, q, tau])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert names(study.runs) == ["pd", "swing"] and names(study.channels) == ["position"]
    assert [(c.name, c.is_measured) for c in study.commands] == [("torque", True)]


@pytest.mark.story  # published sets
@pytest.mark.parametrize(
    "name, runs, channels, commands",
    [
        ("armpi_faults", 89, 6, ["motor_1_cmd", "motor_6_cmd_duration"]),
        ("so101", 5, 18, ["positions_0_control", "positions_5_control"]),
        ("f1tenth_car", 21, 4, ["input_1", "input_2"]),
        ("motor_pendulum", 4, 2, ["torque", "torque"]),
    ],
)
def test_published_folders_open_as_they_are(tmp_path, name, runs, channels, commands):
    folder = find_dataset(name)
    if folder is None:
        pytest.skip(f"set DIFFSIM_DATA to the folder that holds {name}/")
    out = tmp_path / "study.yaml"
    assert init(folder, "--out", str(out)) == 0
    study = load_study(out)
    assert (len(study.runs), len(study.channels)) == (runs, channels)
    assert [study.commands[0].name, study.commands[-1].name] == commands
    assert all(np.isfinite(v).all() for run in study.runs for v in run.command.values())


def _npz(path: Path, columns) -> None:
    np.savez(path, **columns)


def _jsonl(path: Path, columns) -> None:
    rows = zip(*columns.values(), strict=True)
    lines = (json.dumps(dict(zip(columns, map(float, row), strict=True))) for row in rows)
    path.write_text("\n".join(lines))


def _xlsx(path: Path, columns) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (list(columns), *zip(*(v.tolist() for v in columns.values()), strict=True)):
        book.active.append(row)
    book.save(path)


def _csv(path: Path, columns) -> None:
    write(path, ",".join(columns), list(columns.values()))


def _by_library(library: str):
    def write_one(path: Path, columns) -> None:
        pytest.importorskip(library)
        write_columns(path, columns)

    return write_one


FORMATS = {
    "csv": _csv,
    "npz": _npz,
    "jsonl": _jsonl,
    "xlsx": _xlsx,
    "parquet": _by_library("pyarrow"),
    "h5": _by_library("h5py"),
}


@pytest.mark.parametrize("ending", FORMATS)
def test_all_formats_guess_alike(tmp_path, ending):
    """Goals and readings in a file each, and what drives in one file."""
    for k in range(2):
        goal, read = np.sin(0.01 * T + k), np.sin(0.01 * T + k - 0.05) + noisy(k, 0.01)
        run = tmp_path / "two" / f"r{k}"
        run.mkdir(parents=True)
        FORMATS[ending](run / f"control.{ending}", {"t_ms": T + 2.0, "pos": goal})
        torque = noisy(k + 5, 0.2)
        FORMATS[ending](run / f"state.{ending}", {"t_ms": T, "pos": read, "torque": torque})
        (tmp_path / "one").mkdir(exist_ok=True)
        one = {"t_ms": T, "pos": read, "torque": torque}
        FORMATS[ending](tmp_path / "one" / f"r{k}.{ending}", one)
    two, one = guess_study(tmp_path / "two"), guess_study(tmp_path / "one")
    assert names(two.those("command")) == ["pos_control"]
    assert names(two.those("channel")) == ["pos", "torque"]
    assert names(one.those("command")) == ["torque"] and names(one.those("channel")) == ["pos"]
    assert two.runs[0].files == (f"r0/state.{ending}", f"r0/control.{ending}")
    assert init(tmp_path / "two") == 0


def test_one_file_may_hold_the_files_of_all_runs(tmp_path):
    """Groups of an HDF5 file in groups, one for each run."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "day.h5", "w") as file:
        for k, run in enumerate(("slow", "fast")):
            for kind, seed in (("cmd", 0), ("pose", 5)):
                file[f"{run}/{kind}/t_ms"] = T
                file[f"{run}/{kind}/x"] = noisy(seed + k)
                file[f"{run}/{kind}/y"] = noisy(seed + k + 2)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert names(study.runs) == ["fast", "slow"]
    assert names(study.commands) == ["x_cmd", "y_cmd"] and names(study.channels) == ["x", "y"]
    np.testing.assert_allclose(study.runs[1].command["x_cmd"], noisy(0))


@pytest.mark.parametrize("clock", ["time_s", "Zeit [s]"])
def test_clocks_of_their_own_are_told_with_what_joins_them(tmp_path, capsys, clock):
    for k, name in enumerate(("a", "b", "c")):
        push = np.sin(0.02 * T + k)
        write(tmp_path / f"{name}_actuators.csv", "stamp_us,torque_Nm", [1e9 + 1e3 * T, push])
        write(tmp_path / f"{name}_rates.csv", f"{clock},rate_rad_s", [52.37 + 1e-3 * T, noisy(k)])
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    why = next(line for line in said.splitlines() if "clocks do not meet" in line)
    assert "52.37 to 52.96 s" in why and "1000 to 1000.59 s" in why
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())
    stated["time"] = yaml.safe_load(why.partition("time: ")[2].partition(" and file")[0])
    stated["commands"] = [{"name": "torque_Nm", "unit": "N m"}]
    for name, run in zip("abc", stated["runs"], strict=True):
        run["file"] = [f"{name}_rates.csv", f"{name}_actuators.csv"]
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(stated))
    run = load_study(tmp_path).runs[2]
    np.testing.assert_allclose(run.command["torque_Nm"], np.sin(0.02 * T + 2), atol=1e-8)


def test_dates_in_two_files_say_which_began_first(tmp_path):
    """Each had counted from its own first row."""
    late = 0.25
    for name, first in (("read", 0.0), ("goal", late)):
        dates = [f"2026-03-01T09:00:{first + 0.01 * k:09.6f}" for k in range(60)]
        write(tmp_path / f"run_{name}.csv", "Date,x (mm)", [dates, 100.0 * (first + 1e-3 * T)])
    assert init(tmp_path) == 0
    run = load_study(tmp_path).runs[0]
    known = slice(25, None)
    np.testing.assert_allclose(run.command["x_goal"][known], run.measured[known, 0], atol=1e-6)


@pytest.mark.parametrize(
    "start, unit", [(1.7e9, "s"), (1.7e12, "ms"), (1.7e15, "us"), (1.7e18, "ns")]
)
@pytest.mark.parametrize("step", [0.01, 2.0])
def test_a_date_tells_the_unit_of_a_clock_whatever_its_steps(tmp_path, start, unit, step):
    stamps = [f"{start + step * start / 1.7e9 * k:.3f}" for k in range(60)]
    write(tmp_path / "a.csv", "timestamp,u,x", [stamps, STEPS, noisy(1)])
    guess = guess_study(tmp_path)
    assert guess.time == [{"column": "timestamp", "unit": unit}] and guess.is_late
    assert not any("time.unit" in sentence for sentence in guess.todo)


@pytest.mark.parametrize(
    "files, num_runs",
    [
        (["test_cold.csv", "test_hot.csv"], 2),  # a word, and the runs differ in it
        (["test_cmd.csv", "test_position.csv"], 1),
        (["goals/test.csv", "states/test.csv"], 1),
        (["cold/slow.csv", "cold/fast.csv", "hot/slow.csv", "hot/fast.csv"], 4),
        (["run1_cmd.csv", "run1_meas.csv", "run2_cmd.csv", "run2_meas.csv", "run3_cmd.csv"], 2),
    ],
)
def test_files_of_one_run_are_told_from_several_runs(tmp_path, files, num_runs):
    for seed, file in enumerate(files):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        write(tmp_path / file, "t_ms,x_mm,y_mm", [T, noisy(seed), noisy(seed + 9)])
    guess = guess_study(tmp_path)
    unclear = "runs: cold/fast.csv, cold/slow.csv have the same columns and no name that says"
    assert any(s.startswith(unclear) for s in guess.said) == (num_runs == 4)
    assert len(guess.runs) == num_runs
    joined = len(guess.runs[0].files) == 2
    assert joined == (num_runs < len(files)) and len(guess.those("command")) == 2 * joined
    assert len(set(names(guess.runs))) == num_runs


@pytest.mark.parametrize(
    "header, commands",
    [
        ("q_des,q_meas", ["q_des"]),
        ("goalPosition,presentPosition", ["goalPosition"]),
        ("torque,torque_measured", ["torque"]),
        ("actual_vel_rad_s,target_vel_rad_s", ["target_vel_rad_s"]),
        ("q_d[0],q[0]", ["q_d_0"]),
        ("joint_velocity_1,joint_velocity_2", []),
        ("coil_d,coil_q", []),
    ],
)
def test_what_was_desired_is_told_from_what_was_measured(tmp_path, header, commands):
    columns = [np.sin(0.01 * T) + noisy(k, 0.02) for k in (1, 2)]
    write(tmp_path / "a.csv", f"t_ms,{header}", [T, *columns])
    guess = guess_study(tmp_path)
    assert names(guess.those("command")) == commands
    assert len(guess.those("channel")) == 2 - len(commands)


def test_a_controllers_file_may_hold_what_was_measured_too(tmp_path):
    for k in range(2):
        controller = [T, noisy(k), noisy(k + 2), noisy(k + 4)]
        write(tmp_path / f"r{k}_control.csv", "t_ms,goal_a,actual_a,error_a", controller)
        write(tmp_path / f"r{k}_imu.csv", "t_ms,x_mm", [T, noisy(k + 6)])
    guess = guess_study(tmp_path)
    assert names(guess.those("command")) == ["goal_a"]
    assert names(guess.those("channel")) == ["x", "actual_a"]


@pytest.mark.parametrize("lag, commands", [(3, ["angle_2"]), (-3, [])])
def test_a_command_of_no_name_is_what_a_motion_follows(tmp_path, lag, commands):
    """A filtered reading has no noise, either, but comes later."""
    for k in range(2):
        wave = np.sin(0.006 * np.arange(-30, 630, 10) + k) + 0.5 * np.sin(
            0.017 * np.arange(-30, 630, 10)
        )
        smooth, read = wave[3:63], wave[3 - lag : 63 - lag] + noisy(k, 0.02)
        columns = [T, read, np.round(smooth, 5)]
        write(tmp_path / f"r{k}.csv", "t (ms),angle_1 (rad),angle_2 (rad)", columns)
    assert names(guess_study(tmp_path).those("command")) == commands


def test_a_file_of_another_length_without_a_clock_is_told(tmp_path, capsys):
    for k in range(2):
        (tmp_path / f"r{k}").mkdir()
        write(tmp_path / f"r{k}" / "state.csv", "time,x", [1e-3 * T, noisy(k)])
        write(
            tmp_path / f"r{k}" / "input.csv", "push,pull", [noisy(k, num=30), noisy(k + 3, num=30)]
        )
    assert init(tmp_path) == 0
    assert (
        "r0/input.csv has no clock and 30 rows, r0/state.csv 60: not joined"
        in capsys.readouterr().out
    )


@pytest.mark.filterwarnings("error")
def test_a_file_that_is_damaged_or_empty_in_part_warns_nobody(tmp_path, capsys):
    empty = ["" for _ in T]
    for k in range(3):
        gap = [f"{v:.3f}" if i > 55 else "" for i, v in enumerate(noisy(k))]
        write(tmp_path / f"r{k}.csv", "t_ms,u,x,y,z", [T, STEPS, noisy(k), empty, gap])
    (tmp_path / "r3.csv").write_text("t_ms,u,x,y,z\n0,1,2,,\n10,1,2\n20,1,3,,\n")
    write(tmp_path / "r9.csv", "t_ms,u,x,y,z", [T, STEPS, noisy(7), empty, empty])
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "not read: " in said and "r3.csv, row 3: 3 cells" in said
    assert names(load_study(tmp_path).runs) == ["r0", "r1", "r2", "r9"]


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("mark", [" ", ",", "\t"])
def test_tables_as_numpy_writes_them(tmp_path, named, mark):
    """Blanks that line numbers up, and # before the header or none."""
    for k in range(2):
        table = np.column_stack([1e-3 * T, STEPS * (k + 1), noisy(k)])
        header = mark.join(("t", "cmd", "x")) if named else ""
        np.savetxt(tmp_path / f"r{k}.txt", table, delimiter=mark, header=header, fmt="%12.6f")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    expected = (["cmd"], ["x"]) if named else (["column_2"], ["column_3"])
    assert (names(study.commands), names(study.channels)) == expected
    np.testing.assert_allclose(study.runs[1].time_s, 1e-3 * T, atol=1e-9)
    np.testing.assert_allclose(study.runs[1].measured[:, 0], noisy(1), atol=1e-6)


def test_a_folder_in_which_nothing_moves_says_so(tmp_path):
    write(tmp_path / "a.csv", "t,x,y", [1e-3 * T, np.ones(60), np.full(60, 2.0)])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert study.channels == () and study.runs[0].setup["y"] == 2.0
    assert any("no column changes in any run" in sentence for sentence in study.todo)


def test_words_that_some_runs_share_are_facts_and_other_specimens_no_repeats(tmp_path, capsys):
    ramp = np.round(np.linspace(0.0, 4.0, len(T)), 2)
    for day, names in (
        ("Tag1", ("01_A1", "02_A2", "03_A3")),
        ("Tag2", ("04_A3", "05_A2", "06_A1")),
    ):
        (tmp_path / day).mkdir()
        for name in names:
            write(
                tmp_path / day / f"{name}.csv", "time_s,way_mm,F_N", [T, ramp, noisy(int(name[1]))]
            )
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "facts, by words in the names of several runs: folder (Tag1, Tag2), label_2 (A1" in said
    study = load_study(tmp_path)
    assert [run.setup["label_2"] for run in study.runs] == ["A1", "A2", "A3", "A3", "A2", "A1"]
    assert study.runs[3].setup["folder"] == "Tag2"
    assert len({run.group for run in study.runs}) == 6  # none repeats another


def test_loads_in_the_names_of_folders_are_facts_and_counted_runs_none(tmp_path):
    for load in ("20g", "50g"):
        (tmp_path / f"load {load}").mkdir()
        for k in (1, 2):
            path = tmp_path / f"load {load}" / f"run{k}.csv"
            write(path, "time_s,x_m", [T * 1e-3, noisy(k)])
    assert init(tmp_path) == 0
    facts = [run.setup for run in load_study(tmp_path).runs]
    assert [one["g_in_name"] for one in facts] == pytest.approx([0.02, 0.02, 0.05, 0.05])
    assert [sorted(one) for one in facts] == [["folder", "g_in_name"]] * 4


def test_numbers_with_a_unit_are_facts_once(tmp_path):
    for k, load in enumerate(("0g", "5g", "0g", "5g")):
        write(tmp_path / f"clip{k}_{load}.csv", "time_s,x_m", [T * 1e-3, noisy(k)])
    assert init(tmp_path) == 0
    assert [sorted(r.setup) for r in load_study(tmp_path).runs] == [["g_in_name"]] * 4


def test_letters_of_repeats_are_no_facts(tmp_path):
    ramp = np.round(np.linspace(0.0, 4.0, len(T)), 2)
    for name, command in (("slow", ramp), ("fast", ramp**2)):
        for k, letter in enumerate("ab"):
            write(tmp_path / f"{name}_{letter}.csv", "time_s,u,y_m", [T * 1e-3, command, noisy(k)])
    assert init(tmp_path) == 0
    runs = {run.name: run for run in load_study(tmp_path).runs}
    assert runs["slow_b"].setup == {"label_1": "slow"}
    assert runs["slow_b"].group == runs["slow_a"].group is not None
    assert runs["fast_b"].group == runs["fast_a"].group != runs["slow_a"].group


def exported(folder: Path, log: str, topic: str, columns: dict[str, np.ndarray]) -> None:
    """A topic of a log of PX4 as ulog2csv writes it."""
    count = len(next(iter(columns.values())))
    clock = 31_000_000 + np.round(4e6 * np.arange(count) / count)
    stamps = {"timestamp": clock, "timestamp_sample": clock - 200.0}
    table = np.column_stack([*stamps.values(), *columns.values()])
    path = folder / f"{log}_{topic}_0.csv"
    np.savetxt(path, table, "%.8g", ",", header=",".join([*stamps, *columns]), comments="")


def test_topics_of_px4_that_were_exported_are_one_flight(tmp_path, capsys):
    """Stamps of two kinds are no columns that runs share, and most motors are not there."""
    for k in range(3):
        log = f"log_{12 + k}_2026-11-0{k + 2}-10-11-12"
        pose = {n: noisy(10 * k + i, num=200) for i, n in enumerate(("x", "y", "z"))}
        exported(tmp_path, log, "vehicle_local_position", {**pose, "heading": noisy(k, num=200)})
        attitude = {f"q[{i}]": noisy(70 + 4 * k + i, num=400) for i in range(4)}
        exported(tmp_path, log, "vehicle_attitude", attitude)
        motors = {f"control[{i}]": noisy(30 + 10 * k + i, num=400) for i in range(4)}
        none = {f"control[{i}]": np.full(400, np.nan) for i in range(4, 12)}
        exported(tmp_path, log, "actuator_motors", motors | none)
        exported(tmp_path, log, "battery_status", {"voltage_v": noisy(50 + k, num=8) + 15.0})
        exported(tmp_path, log, "cpuload", {"load": noisy(60 + k, num=8)})
    assert init(tmp_path, "--system", "multicopter") == 0
    said = capsys.readouterr().out
    assert "other topics: battery_status" in said and "cpuload" in said
    study = load_study(tmp_path)
    assert names(study.channels) == ["x", "y", "z", "q_0", "q_1", "q_2", "q_3"]
    assert [c.unit for c in study.channels[:4]] == ["m", "m", "m", "-"]
    assert names(study.commands) == [f"control_{k}" for k in range(4)]
    assert names(study.runs) == [f"log_{12 + k}_2026_11_0{k + 2}" for k in range(3)]
    assert np.median(np.diff(study.runs[0].time_s)) == pytest.approx(0.02)


def test_messages_of_several_topics_are_one_record(tmp_path, capsys):
    """Lines of JSON at different rates, each with the topic that tells its fields."""
    for k in range(2):
        lines = []
        for i in range(240):
            stamp = round(1.79e9 + 100 * k + 0.005 * i, 4)
            pitch = {"pitch": float(np.sin(0.03 * i)) + 1e-3 * float(noisy(i, num=1)[0])}
            lines.append({"topic": "/imu", "t": stamp, "data": pitch})
            if i % 4 == 0:
                lines.append({"topic": "/cmd/torque", "t": stamp, "data": {"torque": i % 7}})
            if i % 80 == 0:
                lines.append({"topic": "/battery", "t": stamp, "data": {"voltage": 24.1}})
        text = "\n".join(map(json.dumps, lines))
        (tmp_path / f"session_{k + 1}.jsonl").write_text(text)
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "topics: /imu and /cmd/torque" in said and "other topics: /battery" in said
    study = load_study(tmp_path)
    assert names(study.channels) == ["data_pitch"] and names(study.commands) == ["data_torque"]
    assert names(study.runs) == ["session_1", "session_2"]
    whole = read_columns(tmp_path / "session_1.jsonl")  # as studies of before name it
    assert len(whole["t"]) == 303 and set(whole["topic"]) == {"/imu", "/cmd/torque", "/battery"}
    run = study.runs[0]
    assert len(run.time_s) == 240 and run.time_s[0] == 0.0
    assert run.command["data_torque"][[0, 3, 4, 9]].tolist() == [0.0, 0.0, 4.0, 1.0]


def test_records_that_differ_in_fields_but_not_by_a_topic_stay_one_table(tmp_path):
    """A reading that some records lack, beside a text that says nothing of it."""
    lines = [
        {"t": 0.1 * i, "state": ("a", "b")[i // 20 % 2], "x": float(i % 5)}
        | ({"y": 1.0 * i} if i % 3 else {})
        for i in range(60)
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert parts_of(tmp_path / "log.jsonl") == [""]


def test_files_of_another_rig_and_packed_ones_are_said(tmp_path, capsys):
    for k in range(3):
        write(tmp_path / f"pend_{k}.csv", "time_s,angle_rad", [T, noisy(k)])
    write(tmp_path / "oven.csv", "time_s,temp_degC,heater_W", [T, noisy(8), noisy(9)])
    (tmp_path / "more.zip").write_bytes(b"PK")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "packed files, not looked into; unpack them first: more.zip" in said
    assert "not used: oven.csv; recordings of another rig need a folder" in said


def test_dates_with_the_day_first_are_a_clock(tmp_path):
    """A trend of a PLC, in UTF-16, over midnight."""
    for k in range(3):
        stamps = [f"{24 + k}.10.2026 23:59:{i:02d}" for i in range(60)]
        stamps += [f"{25 + k}.10.2026 00:00:{i:02d}" for i in range(20)]
        read = [f"{20.5 + value:.2f}".replace(".", ",") for value in noisy(k, num=80)]
        cells = zip(stamps, read, "0123" * 20, strict=True)
        rows = [";".join(row) for row in cells]
        text = "\r\n".join(["Anlage: WT-07", "", "Zeitstempel;Temperatur [°C];Freigabe", *rows])
        (tmp_path / f"Trend_{k}.csv").write_bytes(text.encode("utf-16"))
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    np.testing.assert_allclose(study.runs[0].time_s, np.arange(80.0))
