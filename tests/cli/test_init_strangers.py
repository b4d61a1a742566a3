"""``diffsim diagnose init`` on folders of strangers, each of which it read wrongly once."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim.data import load_study
from diffsim.data.table import open_text
from diffsim.data.table_guess import column_of
from tests.cli.test_diagnose_init import T, init, noisy, write


def three(folder: Path, names=("a", "b", "c"), header="time_s,force_N,position_m") -> None:
    for k, name in enumerate(names):
        write(folder / f"{name}.csv", header, [T, np.sin(T + k), 0.1 * np.cos(T + k) + noisy(k)])


def uses(folder: Path) -> dict[str, str]:
    return {run.name: run.use for run in load_study(folder).runs if run.use != "fit"}


def test_of_poses_in_no_order_no_marker_commands_another_one(tmp_path, capsys):
    """Markers near the base move less, and so does their noise: they were commands."""
    header = "Pose;Zug [N];M1 z [mm];M2 z [mm];M3 z [mm]"
    for k, name in enumerate("abc"):
        pull, at = np.random.default_rng(k).random(len(T)), np.arange(len(T)) + 1
        moved = [far * pull + 0.1 * noisy(k + 7 * far) for far in (5, 40, 90)]
        write(tmp_path / f"{name}.csv", header, [at, pull, *moved], ";")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "clock: column Pose counts" in said
    assert "what is left: Zug, M1_z, M2_z, M3_z" in said


@pytest.mark.parametrize("word", ["test", "holdout", "validation"])
def test_a_recording_that_is_called_so_is_kept_back(tmp_path, capsys, word):
    """It was fitted, and another one was kept back in its place."""
    three(tmp_path, ("fast", "slow", word, "wide"))
    assert init(tmp_path) == 0
    assert uses(tmp_path) == {word: "test"}
    assert f"uses, by words of names: {word} is test" in capsys.readouterr().out


def test_where_all_are_called_tests_none_is_told_by_it(tmp_path):
    three(tmp_path, ("test_1", "test_2", "test_3"))
    assert init(tmp_path) == 0
    assert list(uses(tmp_path).values()) == ["test"]


def test_facts_beside_recordings_are_said_and_those_of_a_run_are_its_own(tmp_path, capsys):
    three(tmp_path)
    sheet = {"rig": {"mass_kg": 1.2, "spring_N_per_m": 40.0}, "operator": "AB", "wet": False}
    (tmp_path / "meta.json").write_text(json.dumps(sheet))
    (tmp_path / "params.yaml").write_text("damping: 0.9 N s/m\n")
    of_b = "load_g: 250\nspecimen: B7\ntravel: 30 mm\nstroke: 5mm\naxes: [1, 0.5]\ntilt: .nan\n"
    (tmp_path / "b.yaml").write_text(of_b)
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "meta.json (rig.mass_kg 1.2, rig.spring_N_per_m 40.0, operator AB, wet false)" in said
    assert "params.yaml (damping 0.9 N s/m)" in said and "not read" not in said
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())
    assert sum("numbers of the model: " in todo for todo in stated["todo"]) == 2
    own = {run.name: run.setup for run in load_study(tmp_path).runs}
    lengths = {"travel": pytest.approx(0.03), "stroke": pytest.approx(0.005)}
    assert own["b"] == {"load": 0.25, "specimen": "B7", "axes": "[1, 0.5]", **lengths}
    assert not own["a"] and not own["c"]


def test_what_a_sheet_states_twice_or_at_length_is_said(tmp_path, capsys):
    three(tmp_path)
    sheet = {"load_g": 250, "load_kg": 0.3, "notes": "warm up the motor for ten minutes " * 3}
    (tmp_path / "b.json").write_text(json.dumps(sheet | {"checked": None, "axes": []}))
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "stated twice and differ, the last one is taken: load of b by b.json\n" in said
    assert "texts and lists of more than 60 letters, no facts: notes of b.json\n" in said
    own = {run.name: run.setup for run in load_study(tmp_path).runs}
    assert own["b"] == {"load": 0.3}


def test_files_that_no_rule_reads_are_named(tmp_path, capsys):
    three(tmp_path)
    (tmp_path / "hop1.c3d").write_bytes(b"\x02\x50")
    (tmp_path / "urdf").mkdir()
    (tmp_path / "urdf" / "arm.urdf").write_text("<robot/>")
    (tmp_path / "README.md").write_text("# rig\n")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "formats that are not read: hop1.c3d; export them as CSV" in said
    assert "other files, not used: urdf/arm.urdf\n" in said
    (tmp_path / "1.c3d").write_bytes(b"\x02\x50")  # ends a name that is said
    (tmp_path / "hop1.c3d").unlink()
    (tmp_path / "hop1.c3d.zip").write_bytes(b"PK")
    assert init(tmp_path, "--force") == 0
    said = capsys.readouterr().out
    assert "formats that are not read: 1.c3d; export them as CSV" in said
    assert "other files, not used: urdf/arm.urdf\n" in said  # and not the study of before


def test_words_of_a_logger_between_rows_are_left_out_and_said(tmp_path, capsys):
    for name in ("a", "b"):
        rows = [f"{20 * i},{0.1 * i:.2f},{i % 7}" for i in range(60)]
        rows[10:10], rows[30:30] = ["OK"], ["ERR 3: i2c, bus timeout"]
        text = ["Booting v1.3 ...", "sensor OK", "", "millis,angle_deg,pwm", *rows]
        (tmp_path / f"{name}.log").write_text("\n".join(text) + "\n")
    assert init(tmp_path) == 0
    assert "lines that are no rows: row 15, 'OK', and 1 more" in capsys.readouterr().out
    assert [len(run.time_s) for run in load_study(tmp_path).runs] == [60, 60]
    with (tmp_path / "a.log").open("a") as file:
        file.write("1523,4")
    init(tmp_path, "--force")
    said = capsys.readouterr().out
    assert "row 67: 2 cells" in said and "it is the last one: was the file cut off?" in said


def test_what_is_no_table_is_shown_with_what_one_is(tmp_path, capsys):
    (tmp_path / "serial.txt").write_text("OK\n" + "t:10 pos:4.5 pwm:7\n" * 30)
    assert init(tmp_path) == 2
    assert "lines such as 't:10 pos:4.5 pwm:7' are no rows" in capsys.readouterr().err


def test_a_row_for_each_reading_is_no_record(tmp_path, capsys):
    """As Grafana and InfluxDB export: it was said to have no rows of numbers."""
    rows = [
        f"2026-11-03T09:00:{i:02d}Z,{name},{i * k}"
        for i in range(50)
        for k, name in enumerate(("pump", "level"))
    ]
    (tmp_path / "export.csv").write_text("time,name,value\n" + "\n".join(rows) + "\n")
    assert init(tmp_path) == 2
    said = capsys.readouterr().err
    assert "a column for each of pump, level" in said and "df.pivot(index='time'" in said


def test_one_cell_that_is_no_number_is_said(tmp_path, capsys):
    """The channel was taken for a text and left out; equal stamps ended the command."""
    for k, name in enumerate("abc"):
        place = [f"{v:.6g}" for v in 0.1 * np.cos(T + k) + noisy(k)]
        stamps = [f"{t:.4f}" for t in T]
        if name == "b":
            place[7], stamps[20] = "inf", stamps[19]
        write(tmp_path / f"{name}.csv", "time_s,force_N,position_m", [stamps, np.sin(T), place])
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "row 9, column position_m: 'inf' is not a finite number; leave the cell empty" in said
    assert "rows with the stamp of another, of which the first is kept: b (1)" in said
    runs = {run.name: run for run in load_study(tmp_path).runs}
    assert len(runs["a"].time_s) == len(runs["b"].time_s) + 1


def test_a_clock_that_wraps_goes_on(tmp_path, capsys):
    for name, start in (("a", 100), ("b", 65_300)):
        stamps = (start + 10 * np.arange(len(T))) % 65_536
        write(tmp_path / f"{name}.csv", "timestamp,stateEstimate.z,motor.m1", [stamps, T**2, T])
    assert init(tmp_path) == 0
    assert "clocks that wrap at 65536 go on by the usual step: b" in capsys.readouterr().out
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["motor_m1"]
    for run in study.runs:
        np.testing.assert_allclose(np.diff(run.time_s), 0.01, atol=1e-9)


@pytest.mark.parametrize(("step", "lost"), [(1000, 0), (10, 500)])
def test_a_clock_that_wraps_is_not_said_to_go_on_where_it_would_not(tmp_path, capsys, step, lost):
    """A jump of few steps stays, and one of many rows that were lost would be closed as well."""
    stamps = 64_000 + step * (np.arange(400) + lost * (np.arange(400) > 300))
    write(tmp_path / "a.csv", "timestamp,z_m,motor.m1", [stamps % 65_536, *np.ones((2, 400))])
    init(tmp_path)
    assert "clocks that wrap" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("header", "base", "unit"),
    [
        ("θ (rad)", "theta", "rad"),
        ("τ_cmd (N·m)", "tau_cmd", "N·m"),
        ("θ̈ (rad/s²)", "theta_ddot", "rad/s²"),
        ("Δx [mm]", "Delta_x", "mm"),
        ("角度[deg]", "角度", "deg"),
        ("Größe [mm]", "Größe", "mm"),
        ("2nd gauge", "c_2nd_gauge", None),
    ],
)
def test_headers_in_any_script_keep_their_names(header, base, unit):
    """They were column, column_1, column_2."""
    found = column_of(header)
    assert (found.base, found.unit) == (base, unit) and found.base.isidentifier()


def test_columns_in_japanese_are_a_study(tmp_path):
    rows = [
        f"{t:.3f},{np.sin(t):.5f},{np.sin(t - 0.1) + e:.5f}"
        for t, e in zip(T, noisy(1), strict=True)
    ]
    for name in ("実験1", "実験2"):
        text = "\n".join(["時間[s],目標角度[deg],角度[deg]", *rows])
        (tmp_path / f"{name}.csv").write_text(text + "\n", "utf-8")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert {one.name for one in (*study.channels, *study.commands)} == {"目標角度", "角度"}


def test_quick_motion_is_no_noise(tmp_path, capsys):
    """Motion of 4 Hz at 100 Hz was taken for noise: sd of 230 um for 30, a torque for a reading."""
    t = 0.01 * np.arange(400)
    for k, name in enumerate(("a", "b", "c")):
        push = np.round(5.0 * np.sin(23.0 * t + k) + 2.0 * np.sin(9.0 * t), 3)
        turn = 40.0 * np.sin(23.0 * t + k) + 0.03 * np.random.default_rng(k).normal(size=len(t))
        write(tmp_path / f"{name}.csv", "t/ms,tau/N.m,angle/deg", [1000.0 * t, push, turn])
    assert init(tmp_path) == 0
    assert "command: tau, by its lack of noise" in capsys.readouterr().out
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())
    assert stated["channels"][0]["sd"] == pytest.approx(0.03, rel=0.1)
    assert stated["commands"][0]["unit"] == "N.m"


@pytest.mark.parametrize("scale, header", [(1.0, "plate t,plate x"), (1e3, "sensor_time,x")])
def test_a_clock_that_counts_coarsely_keeps_its_rows(tmp_path, capsys, scale, header):
    """Equal stamps made it no clock, or ended the command."""
    t = np.arange(380) / 30.0
    stamps = [f"{scale * v:.3g}" for v in t]  # 9.97, 10, 10, 10.1: three rows for each of the last
    write(tmp_path / "a.csv", header, [stamps, noisy(1, num=380)])
    assert init(tmp_path) == 0
    assert "equal stamps spread evenly: a" in capsys.readouterr().out
    run = load_study(tmp_path).runs
    assert sum(len(one.time_s) for one in run) == 380
    steps = np.concatenate([np.diff(one.time_s) for one in run])
    assert (steps > 0.0).all() and np.median(steps) == pytest.approx(1.0 / 30.0, rel=0.02)


def test_a_row_that_the_next_one_overtook_is_put_back(tmp_path, capsys):
    """The first two rows of a thrust stand's sweep of 30."""
    stamps = T.copy()
    stamps[[0, 1]] = stamps[[1, 0]]
    write(tmp_path / "a.csv", "Time (s),Thrust (gf)", [stamps, noisy(1)])
    assert init(tmp_path) == 0
    assert "rows out of order, sorted by their stamps: a (1)" in capsys.readouterr().out


def test_rows_that_a_logger_wrote_again_are_kept_once(tmp_path, capsys):
    again = np.repeat(np.arange(len(T)), 3)
    write(tmp_path / "a.csv", "time_s,u,x_m", [T[again], np.sin(T)[again], noisy(1)[again]])
    assert init(tmp_path) == 0
    assert "rows written more than once, of which the first is kept" in capsys.readouterr().out


def test_a_first_column_without_a_name_is_the_clock_though_rows_are_lost(tmp_path, capsys):
    """Steps that differ once were no clock; runs of other days were joined as sensors of one."""
    for name, lost, width in (("10_14_1", 30, 2), ("10_14_2", 40, 2), ("4_17_1", 20, 3)):
        kept = np.delete(np.arange(len(T)), slice(lost, lost + 5))
        rows = np.stack([T, *(noisy(k) for k in range(width))], axis=1)[kept]
        np.savetxt(tmp_path / f"{name}.dat", rows)
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "clock: column column_1, the first that only grows" in said
    assert "runs: one for each of 2 files" in said and "not used: 4_17_1.dat" in said


def test_rows_that_were_never_filled_are_left_out(tmp_path, capsys):
    """Zeros at the end of an array ended the command, or were a sample at a made-up stamp."""
    for k, name in enumerate(("a", "b", "c")):
        rows = np.stack([1e3 * T + 3.0, np.sin(T), 0.1 * np.cos(T + k) + noisy(k)], axis=1)
        if name == "b":
            rows[-4:] = 0.0
        header = "time,u_V,x_mm"
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.6g", ",", header=header, comments="")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "rows at the end that were not filled, left out: b (4)" in said
    a, b, _ = load_study(tmp_path).runs
    assert len(b.time_s) == len(a.time_s) - 4 and (np.diff(b.time_s) > 0.0).all()
    text = (tmp_path / "study.yaml").read_text()
    (tmp_path / "study.yaml").write_text(text.replace("stamps: {backward: drop}", "every: 1"))
    with pytest.raises(ValueError, match=r"0 from here to the end, 4 rows.*\{backward: drop\}"):
        load_study(tmp_path)


def test_clocks_of_milliseconds_and_of_seconds_in_one_folder(tmp_path, capsys):
    """Runs in seconds were read as milliseconds, a thousand times too quick, and nothing said."""
    for k, (name, unit) in enumerate((("a", 1e3), ("b", 1.0), ("c", 1e3))):
        stamps = [f"{0.01 * unit * t:.6g}" for t in T]
        write(tmp_path / f"{name}.csv", "time,command,speed", [stamps, np.sin(T), noisy(k)])
    assert init(tmp_path) == 0
    assert "clocks in s, by steps far from those in ms: b\n" in capsys.readouterr().out
    for run in load_study(tmp_path).runs:
        assert run.time_s[-1] == pytest.approx(0.01 * T[-1], rel=1e-4)


def test_a_fact_in_the_first_row_alone_is_no_channel(tmp_path):
    """As a test report has the length of its specimen beside the rows."""
    for k, name in enumerate(("a", "b", "c")):
        length = [f"{25.0 + k}", *[""] * (len(T) - 1)]
        columns = [T, np.sin(T), noisy(k), length]
        write(tmp_path / f"{name}.csv", "t (s),force (N),x (mm),length (mm)", columns)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in (*study.channels, *study.commands)] == ["x", "force"]
    assert [run.setup["length"] for run in study.runs] == pytest.approx([0.025, 0.026, 0.027])


@pytest.mark.parametrize(
    ("first", "names"),
    [
        (T, ["t_s", "u", "x", "column_4"]),  # the last was added later
        (np.arange(1, len(T) + 1), ["column_1", "t_s", "u", "x"]),  # rows of R
    ],
)
def test_a_header_of_fewer_names_than_columns_keeps_them(tmp_path, capsys, first, names):
    """They were lost, and the clock with them."""
    columns = [first, *([T] if first is not T else []), np.sin(T), noisy(1)]
    columns += [noisy(2)] if first is T else []
    write(tmp_path / "a.csv", "t_s,u,x", columns)
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    known = ", ".join(names)
    assert f"a.csv and the like have fewer names than columns; columns are {known}\n" in said
    assert "clock: column t_s in s" in said


def test_the_same_columns_below_more_remarks_are_no_other_rig(tmp_path, capsys):
    for name, remarks in (("a", 1), ("b", 1), ("c", 2)):
        header = "# a remark\n" * remarks + "time_s,force_N,position_m"
        write(tmp_path / f"{name}.csv", header, [T, np.sin(T), noisy(1)])
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "the same columns, but not with their names in line 2, not used" in said
    assert "c.csv (line 3)" in said and "another rig" not in said


def test_noise_of_a_sensor_that_rests_is_that_of_its_last_digit(tmp_path):
    """Of more than 2000 readings it was 1e-16: nothing but that of doubles."""
    t = 0.01 * np.arange(9000)
    travel = np.round(np.cumsum((np.arange(9000) % 4 == 0) * 0.001) + 0.001 * (t // 10), 3)
    write(tmp_path / "a.csv", "t (s),force (N),travel (mm)", [t, np.sin(t), travel])
    init(tmp_path)
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text())
    (sd,) = (c["sd"] for c in stated["channels"] if c["name"] == "travel")
    assert sd == pytest.approx(0.001 / np.sqrt(12.0), rel=0.05)


def test_files_that_cannot_be_read_for_one_reason_are_one_sentence(tmp_path, capsys):
    three(tmp_path)
    for name in ("d", "e", "f", "g"):
        np.savez(tmp_path / f"{name}.npz", text=np.array("no table"))
    assert init(tmp_path) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "not read: " in line]
    assert len(said) == 1 and "e.npz and 2 more: holds no table" in said[0]


def test_a_spike_makes_no_reading_smooth(tmp_path, capsys):
    """A load cell that lost its amplifier for a moment was the command, by its lack of noise."""
    for k, name in enumerate(("a", "b")):
        weight = noisy(k, 0.001, 1000)
        weight[[300, 301]] = -384.3
        t, header = 0.1 * np.arange(1000), "time [s],weight [N],way [mm]"
        write(tmp_path / f"{name}.csv", header, [t, weight, noisy(9, num=1000)])
    init(tmp_path)
    assert "by its lack of noise" not in capsys.readouterr().out


def test_a_loggers_cyrillic_letters_and_units_are_read(tmp_path, capsys):
    """Windows writes them in a code page of its own; they were western letters without a unit."""
    for k, name in enumerate("abc"):
        columns = [100.0 * np.arange(60), 30.0 * np.cos(0.1 * T + k) + noisy(k), np.sin(T + k)]
        rows = [
            ";".join(f"{v:.4f}".replace(".", ",") for v in row)
            for row in zip(*columns, strict=True)
        ]
        text = "\n".join(["время (мс);угол (град);напряжение (В)", *rows])
        (tmp_path / f"{name}.csv").write_bytes(text.encode("cp1251"))
    assert init(tmp_path) == 0
    assert "clock: column время (мс) in мс" in capsys.readouterr().out
    study = load_study(tmp_path)
    units = {c.name: c.unit for c in (*study.channels, *study.commands)}
    assert units == {"угол": "rad", "напряжение": "V"}
    assert study.runs[0].time_s[-1] == pytest.approx(5.9)


@pytest.mark.parametrize("header", ["Länge (µm)", "Höhe über Öl²", "déjà créé (°C)"])
def test_western_accents_touch_plain_letters(tmp_path, header):
    (tmp_path / "a.csv").write_bytes(f"{header},b\n1,2\n".encode("cp1252"))
    with open_text(tmp_path / "a.csv") as file:
        assert file.readline() == f"{header},b\n"


def test_a_first_column_without_a_name_that_is_no_count_is_the_clock(tmp_path, capsys):
    """It was left out, and rows were 0.01 s apart; numbers of rows, as pandas has, still are."""
    for k, name in enumerate("abc"):
        columns = [0.05 * np.arange(60), np.sin(T + k), 0.1 * np.cos(T + k) + noisy(k)]
        write(tmp_path / f"{name}.csv", ",force_N,position_m", columns)
    assert init(tmp_path) == 0
    assert "clock: column column_1 in s, steps of 0.05 s" in capsys.readouterr().out
    study = load_study(tmp_path)
    assert study.runs[0].time_s[1] == pytest.approx(0.05)
    assert "column_1" not in {c.name for c in (*study.channels, *study.commands)}


def test_files_with_a_column_in_another_unit_are_told_with_what_takes_them(tmp_path, capsys):
    """They were said to be of another rig."""
    three(tmp_path, ("a", "b"), "time_s,force_N,speed (rad/s)")
    (tmp_path / "c.csv").write_text(
        (tmp_path / "b.csv").read_text().replace("speed (rad/s)", "speed (rpm)")
    )
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if "another unit" in line)
    study = tmp_path / "study.yaml"
    stated = yaml.safe_load(study.read_text())
    stated["runs"] = [{"file": "a.csv"}, {"file": "b.csv"}]
    stated["runs"].append(yaml.safe_load(line.partition("`runs`: ")[2]))
    study.write_text(yaml.safe_dump(stated))
    _, b, c = (run.measured[:, -1] for run in load_study(tmp_path).runs)
    np.testing.assert_allclose(c, np.pi / 30.0 * b, rtol=1e-9)


def test_what_begins_elsewhere_repeats_nothing(tmp_path, capsys):
    """Pendulums under one torque, let go from 115 and from -70 degrees."""
    for name, start in (("a", 2.0), ("b", -1.2), ("c", 2.02)):
        columns = [T, np.sin(T), start * np.cos(0.03 * T) + noisy(len(name))]
        write(tmp_path / f"{name}.csv", "time_s,torque_Nm,angle_rad", columns)
    assert init(tmp_path) == 0
    assert "repeats, by equal commands: c of a\n" in capsys.readouterr().out


@pytest.mark.parametrize("units", [["", "", ""], ["s", "N", "mm"]])
@pytest.mark.parametrize("mark", ["\t", ","])
def test_names_in_remarks_of_numpy_are_names(tmp_path, capsys, mark, units):
    """numpy's ``header="t F x"`` above tabs was a file without names; a remark of as many words
    beside it names nothing."""
    time = 0.02 * np.arange(len(T))
    for k, name in enumerate("abc"):
        rows = np.column_stack([time, np.sin(time + k), 3.0 * np.cos(time + k) + noisy(k)])
        header = "t F x\n" + (" ".join(units) if all(units) else "run of Monday")
        np.savetxt(tmp_path / f"{name}.dat", rows, delimiter=mark, header=header, fmt="%.5f")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.channels] == (["x"] if all(units) else ["F", "x"])
    assert study.channels[-1].unit == ("m" if all(units) else "-")
    assert study.fit_runs[0].time_s[1] == pytest.approx(0.02)


def test_a_sentence_above_the_numbers_names_no_columns(tmp_path):
    """ "measured in the lab today" has as many words as the file columns."""
    time = 0.02 * np.arange(len(T))
    for k, name in enumerate("abc"):
        rows = np.column_stack([time, *(np.sin(time + k + i) + noisy(k + i) for i in range(4))])
        header = "measured in the lab today"
        np.savetxt(tmp_path / f"{name}.dat", rows, delimiter="\t", header=header, fmt="%.5f")
    init(tmp_path)
    assert "lab" not in (tmp_path / "study.yaml").read_text()


def test_liters_a_minute_are_a_flow(tmp_path):
    time = 0.02 * np.arange(len(T))
    for k, name in enumerate("abc"):
        moved = [np.cos(time + k) + noisy(k), np.sin(time) + noisy(k + 9)]
        columns = [time, 4.0 * np.sin(time + k) + noisy(k + 3), *moved]
        write(tmp_path / f"{name}.csv", "t,q_lpm,x_mm,p_bar", columns)
    init(tmp_path)
    assert load_study(tmp_path).channels[0].unit == "m^3/s"
