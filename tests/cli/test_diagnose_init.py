"""``diffsim diagnose init``: a stranger's folder becomes a study that is read at once."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim import cli
from diffsim.data import load_study
from diffsim.data.formats import write_columns
from diffsim.data.study_check import TODO
from diffsim.data.table_guess import column_of
from diffsim.systems.registry import DESCRIPTIONS


def write(path: Path, header: str, columns, mark: str = ",", point: str = ".") -> None:
    rows = zip(*columns, strict=True)
    lines = [mark.join(_cell(c, point) for c in row) for row in rows]
    path.write_bytes(("\n".join([header, *lines]) + "\n").encode("cp1252"))


def _cell(value, point: str) -> str:
    return value if isinstance(value, str) else f"{value:.9g}".replace(".", point)


def init(folder: Path, *more: str) -> int:
    return cli.main(["diagnose", "init", str(folder), *more])


T = np.arange(60) * 10.0


def noisy(seed: int, size: float = 0.1, num: int = 60):
    return size * np.random.default_rng(seed).normal(size=num)


@pytest.fixture
def steps(tmp_path):
    """Four files of a logger: two commands, one of them twice; a payload that is constant."""
    for seed, (name, level, load) in enumerate(
        [("slow_1", 1.0, 0.2), ("slow_2", 1.0, 0.2), ("fast", 2.0, 0.2), ("heavy", 2.0, 0.5)]
    ):
        force = np.where(T > 200.0, level, 0.0) + np.where(T > 400.0, 0.5, 0.0)
        x = 30.0 * force + noisy(seed)
        write(
            tmp_path / f"{name}.csv",
            "Zeit (ms);Weg [mm];F_N;Nutzlast (kg);frame",
            [T, x, force, np.full(60, load), np.arange(60.0)],
            mark=";",
            point=",",
        )
    return tmp_path


def test_a_loggers_folder_becomes_a_study(steps, capsys):
    assert init(steps) == 0
    out = capsys.readouterr().out
    study = load_study(steps)
    assert [c.name for c in study.channels] == ["Weg"]
    assert (study.channels[0].unit, study.channels[0].shown_unit) == ("m", "mm")
    assert study.channels[0].sd == pytest.approx(1e-4, rel=0.5)
    assert [(c.name, c.unit, c.upper) for c in study.commands] == [("F_N", "N", 2.5)]
    runs = {r.name: r for r in study.runs}
    assert list(runs) == ["fast", "heavy", "slow_1", "slow_2"]
    assert runs["slow_2"].group == runs["slow_1"].group == "slow_1"
    assert runs["heavy"].group == "heavy"  # the same force, but another payload
    assert [r.use for r in study.runs] == ["fit", "test", "fit", "fit"]  # repeats tell the noise
    assert runs["heavy"].setup == {"Nutzlast": 0.5}
    np.testing.assert_allclose(runs["fast"].time_s, T * 1e-3, rtol=1e-12)
    assert "guessed: command: F_N, held for many samples" in out
    assert "guessed: repeats, by equal commands: slow_2 of slow_1" in out
    assert "counters and flags, not used (see missing_if): frame" in out


def test_what_is_to_be_filled_in_is_told_by_check(steps, capsys):
    assert init(steps, "--system", "outside") == 0
    text = (steps / "study.yaml").read_text()
    assert "simulator: TODO" in text and "# workers: 1 (whole number)" in text
    capsys.readouterr()
    assert cli.main(["diagnose", "check", str(steps)]) == 2
    out = capsys.readouterr().out
    assert "error: model.simulator: is still to be filled in: TODO" in out
    assert out.count("model.simulator") == 1
    assert "warning: study: still to be stated: sd of each channel" in out


def test_a_file_that_is_there_is_kept(steps, capsys):
    (steps / "study.yaml").write_text("mine")
    assert init(steps) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert (steps / "study.yaml").read_text() == "mine"
    assert init(steps, "--force") == 0
    assert load_study(steps).runs


def test_a_study_elsewhere_finds_its_files(steps, tmp_path_factory):
    out = tmp_path_factory.mktemp("elsewhere") / "deep" / "my.yaml"
    assert init(steps, "--out", str(out)) == 0
    assert len(load_study(out).runs) == 4
    assert not (steps / "study.yaml").exists()


def test_one_file_of_many_trials(tmp_path):
    trials = [str(k) for k in (3, 4, 7, 9, 12, 15, 20) for _ in range(60)]
    t = np.tile(T * 1e-3, 7)
    x = np.concatenate([np.sin(k + T / 100.0) + noisy(k, 1e-3) for k in range(7)])
    write(tmp_path / "all.csv", "trial,time,angle_deg,temp_C", [trials, t, x, x**2])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [r.name for r in study.runs][:2] == ["all_3", "all_4"]
    assert [r.use for r in study.runs] == ["fit"] * 3 + ["select"] + ["fit"] * 2 + ["test"]
    assert [(c.name, c.unit) for c in study.channels] == [("angle", "rad"), ("temp", "K")]
    assert study.commands == ()
    assert any("no column looks commanded" in sentence for sentence in study.todo)


def test_what_two_runs_share_to_the_digit_is_commanded(tmp_path):
    wave = np.round(np.sin(T / 70.0) + noisy(0, 1e-3), 4)  # too rough to look computed
    for seed, (name, size) in enumerate(
        [("sine_a", 1), ("sine_b", 1), ("large", 2), ("sine_c", 1)]
    ):
        write(tmp_path / f"{name}.csv", "t (ms),x (mm),F (N)", [T, noisy(seed), size * wave])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["F"] and [c.name for c in study.channels] == ["x"]
    assert {r.name: (r.group, r.use) for r in study.runs} == {
        "large": ("large", "test"),
        "sine_a": ("sine_a", "fit"),
        "sine_b": ("sine_a", "fit"),
        "sine_c": ("sine_a", "fit"),
    }


def test_copies_of_a_run_make_nothing_a_command(tmp_path):
    for name in "ab":
        write(tmp_path / f"{name}.csv", "t (ms),x (mm),y (mm)", [T, noisy(1), noisy(2)])
    assert init(tmp_path) == 0
    assert load_study(tmp_path).commands == ()


def test_what_drives_without_noise_looks_commanded(tmp_path):
    t = np.linspace(0.0, 2.0, 60)
    smooth = np.sin(t * 1e-3 + 2.0)
    for seed, name in enumerate("ab"):
        columns = [t, smooth + noisy(seed, 1e-3), smooth, smooth + 1e-3 * seed * t]
        write(tmp_path / f"{name}.csv", "t (s),x (m),Kraft (N),angle (rad)", columns)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["Kraft"]
    assert [c.name for c in study.channels] == ["x", "angle"]  # motions may be smooth


def test_a_sweep_in_frequency_with_five_digits_looks_commanded(tmp_path):
    t = 0.01 * np.arange(800)
    for seed, name in enumerate("ab"):
        sweep = np.round((0.35 - 0.1 * seed) * np.sin(2.0 * np.pi * (0.2 + 0.12 * t) * t), 5)
        columns = [t, sweep, 1.3 * sweep + noisy(seed, 1e-3, 800), sweep + noisy(seed, 1e-4, 800)]
        write(tmp_path / f"{name}.csv", "t[s],torque[Nm],angle[rad],sensed[Nm]", columns)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["torque"]
    assert [c.name for c in study.channels] == ["angle", "sensed"]


def test_one_long_run_is_cut_into_blocks(tmp_path):
    write(tmp_path / "long.csv", "t,u,y", [T * 1e-3, np.repeat(np.arange(6.0), 10), noisy(0)])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [r.use for r in study.runs] == ["fit", "fit", "fit", "select", "fit", "test"]
    assert [c.name for c in study.commands] == ["u"] and [c.name for c in study.channels] == ["y"]
    assert any(sentence.startswith("time.unit: column t states none") for sentence in study.todo)
    assert "units, which the header does not state: u, y" in study.todo


def test_a_row_of_units_and_lines_before_the_header(tmp_path):
    lines = ["Logger 3", "", "time,pos,cmd", "s,mm,N", *(f"{k / 100},{k % 7},0" for k in range(40))]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert (study.channels[0].name, study.channels[0].shown_unit) == ("pos", "mm")
    assert sum(len(r.time_s) for r in study.runs) == 40


@pytest.mark.parametrize(
    ("header", "names"),
    [
        (  # as Motive writes rigid bodies
            [
                "Format Version,1.23,Length Units,Meters",
                "",
                ",Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body",
                ",,Rotation,Rotation,Position,Position,Marker Size",
                "Frame,Time (Seconds),X,Y,X,Y,",
            ],
            ["Rotation_X", "Rotation_Y", "Position_X", "Position_Y", "Marker_Size"],
        ),
        (  # as Motive writes one marker: its axes alone are enough
            [
                "Take,7",
                "",
                ",Type,Marker,Marker,Marker,Marker,Marker",
                ",,Position,Position,Position,Position,Position",
                "Frame,Time (Seconds),X,Y,Z,V,W",
            ],
            ["X", "Y", "Z", "V", "W"],
        ),
        (  # as Vicon Nexus writes trajectories: a name stands in the first of its columns
            [
                "Trajectories",
                "100",
                ",,box:M1,,box:M2,,",
                "Frame,Time,X,Y,X,Y,Z",
                ",s,mm,mm,mm,mm,mm",
            ],
            ["box_M1_X", "box_M1_Y", "box_M2_X", "box_M2_Y", "Z"],
        ),
    ],
)
def test_headers_of_several_lines_as_motion_capture_has_them(tmp_path, header, names):
    values = [noisy(k) for k in range(5)]
    rows = [
        ",".join([str(k), f"{k / 100:.2f}", *(f"{v[k]:.4f}" for v in values)])
        for k in range(len(T))
    ]
    (tmp_path / "Take 1.csv").write_text("\n".join([*header, *rows]) + "\n")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.channels] == names
    assert study.runs[-1].time_s[-1] == pytest.approx((len(T) - 1) / 100)
    assert study.channels[0].shown_unit == ("mm" if "mm" in header[-1] else None)
    where = {c.name: k for k, c in enumerate(study.channels)}
    read = np.concatenate([run.measured for run in study.runs])
    scale = 1e-3 if "mm" in header[-1] else 1.0
    np.testing.assert_allclose(read[:, where[names[3]]], scale * values[3], atol=1e-4)


def test_numbers_in_file_names_are_facts(tmp_path):
    for level in (100, 150):
        write(tmp_path / f"step_{level}mbar.csv", "time_s,x_m", [T * 1e-3, noisy(level)])
    assert init(tmp_path) == 0
    assert [r.setup for r in load_study(tmp_path).runs] == [
        {"mbar_in_name": 10000.0},
        {"mbar_in_name": 15000.0},
    ]


def test_a_folder_without_recordings(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("we pulled\nand it moved\n")
    assert init(tmp_path) == 2
    assert "it has notes.txt: a table is a CSV file, or one of" in capsys.readouterr().err
    (tmp_path / "runs.zip").write_bytes(b"PK")
    (tmp_path / "a.parquet").write_bytes(b"none")
    assert init(tmp_path) == 2
    said = capsys.readouterr().err
    assert "notes.txt, runs.zip: unpack runs.zip first" in said and "a.parquet: cannot be" in said


@pytest.mark.parametrize("system", sorted(DESCRIPTIONS))
def test_a_first_study_of_any_system_is_read(steps, system):
    assert init(steps, "--system", system) == 0
    study = load_study(steps)
    assert study.system == system
    assert TODO in str(study.model) and not empty(study.model)


def empty(stated) -> bool:
    """Whether a block is there without anything in it."""
    inner = stated.values() if isinstance(stated, dict) else stated
    return stated is None or (isinstance(stated, (dict, list)) and any(map(empty, inner)))


def test_a_camera_slower_than_the_log_and_a_clock_since_1970(tmp_path, capsys):
    """Rows whose last cell is empty are rows; times are counted from the start of each run."""
    stamps = [f"{1.7e9 + 0.01 * i:.3f}" for i in range(60)]
    for name, seed in (("a", 1), ("b", 2)):
        x = [f"{v:.3f}" if i % 3 == 2 else "" for i, v in enumerate(noisy(seed, 2.0))]
        write(tmp_path / f"{name}.csv", "stamp,u,cart/x", [stamps, noisy(5), x])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.channels] == ["cart_x"]
    assert study.channels[0].sd == pytest.approx(2.0, rel=0.5)  # from what was seen, not rounding
    assert study.runs[0].time_s[0] == 0.0
    assert "every run starts at 0 s" in capsys.readouterr().out


def test_a_table_of_labels_without_a_clock(tmp_path, capsys):
    """A thrust stand: propeller and trial divide the table, remarks are said to be unused."""
    rows = [(p, k, i) for p in ("APC 5x3", "HQ 5x4.5") for k in (1, 2) for i in range(15)]
    columns = [
        [p for p, _, _ in rows],
        [str(k) for _, k, _ in rows],
        [10.0 * i for *_, i in rows],
        [1200.0 * i + 7.0 * k for _, k, i in rows],
        [3.3 * i + n for (*_, i), n in zip(rows, noisy(3), strict=True)],
        ["" for _ in rows],
    ]
    write(tmp_path / "all.csv", "Propeller,Run,Throttle %,rpm,Thrust (gf),Remarks", columns)
    assert init(tmp_path, "--system", "bench") == 0
    study = load_study(tmp_path)
    assert [r.name for r in study.runs] == ["APC 5x3 1", "APC 5x3 2", "HQ 5x4.5 1", "HQ 5x4.5 2"]
    assert study.runs[0].setup == {"Propeller": "APC 5x3"}
    assert [(c.name, c.shown_unit) for c in study.commands] == [("Throttle", "%")]
    assert [(c.name, c.shown_unit) for c in study.channels] == [("rpm", "rpm"), ("Thrust", "gf")]
    assert "texts and empty columns, not used: Remarks" in capsys.readouterr().out


def test_throws_whose_frames_are_counted(tmp_path):
    """A counter of frames is a clock with seconds for each count, also where frames are missing."""
    throw = [str(k) for k in (1, 2, 3) for _ in range(20)]
    frame = [str(start + i + (i > 9)) for start in (5000, 17, 300) for i in range(20)]
    write(tmp_path / "tracks.csv", "throw,frame,px,py", [throw, frame, noisy(1), noisy(2)])
    assert init(tmp_path, "--system", "rigid_body") == 0
    assert "{column: frame, step: 0.01}" in (tmp_path / "study.yaml").read_text()
    run = load_study(tmp_path).runs[1]
    assert len(run.time_s) == 20
    np.testing.assert_allclose(run.time_s[[0, -1]], [0.17, 0.37])


def test_a_speed_that_a_bench_sweeps_is_no_clock(tmp_path):
    """Of fans its speeds [rpm] were taken for milliseconds; a run down did not grow."""
    speed = np.linspace(1000.0, 8000.0, 30)
    for seed, name in enumerate(("up", "again")):
        write(
            tmp_path / f"{name}.csv",
            "speed_rpm,thrust_N",
            [speed, 1e-7 * speed**2 + noisy(seed, num=30)],
        )
    assert init(tmp_path, "--system", "bench") == 0
    text = yaml.safe_load((tmp_path / "study.yaml").read_text("utf-8"))
    assert text["time"] == {"step": 0.01}
    assert [c["column"] for c in text["commands"]] == ["speed_rpm"]


def test_a_counter_of_any_name_is_the_clock(tmp_path):
    shot = [str(k) for k in (1, 2, 3) for _ in range(20)]
    frame = [str(1000 + i) for _ in range(3) for i in range(20)]
    write(tmp_path / "table.csv", "shot,Bild,px,py", [shot, frame, noisy(1), noisy(2)])
    assert init(tmp_path, "--system", "rigid_body") == 0
    assert "{column: Bild, step: 0.01}" in (tmp_path / "study.yaml").read_text()
    run = load_study(tmp_path).runs[1]
    np.testing.assert_allclose(run.time_s[[0, -1]], [10.0, 10.19])


def test_a_systime_is_a_clock_before_frame_numbers_and_a_throttle_dt_no_step(tmp_path):
    """As a motion capture room logs an airplane: dt is the throttle, of which all stay full."""
    frame, seconds = (
        [str(442_245 + i) for i in range(60)],
        [f"{2.9 + 0.01 * i:.3f}" for i in range(60)],
    )
    full = ["1"] * 60
    write(tmp_path / "a.csv", "FrameNumber,Systime,dt,px", [frame, seconds, full, noisy(1)])
    assert init(tmp_path) == 0
    assert "time: {column: Systime, unit: s}" in (tmp_path / "study.yaml").read_text()
    (tmp_path / "study.yaml").unlink()
    write(tmp_path / "a.csv", "FrameNumber,dt,px", [frame, full, noisy(1)])
    assert init(tmp_path) == 0  # of the throttle no second a row
    assert "{column: FrameNumber, step: 0.01}" in (tmp_path / "study.yaml").read_text()
    (tmp_path / "study.yaml").unlink()
    write(tmp_path / "a.csv", "FrameNumber,dt,px", [frame, ["0.005"] * 60, noisy(1)])
    assert init(tmp_path) == 0
    assert "{column: FrameNumber, step: 0.005}" in (tmp_path / "study.yaml").read_text()


def test_a_channel_with_marks_of_missing_values_is_a_channel(tmp_path):
    seen = ["---" if i % 9 == 4 else f"{0.1 * i:.3f}" for i in range(60)]
    write(tmp_path / "a.csv", "t_ms,tip_mm,mid_mm", [map(str, range(60)), seen, noisy(1)])
    assert init(tmp_path, "--system", "rigid_body") == 0
    assert "column: tip_mm" in (tmp_path / "study.yaml").read_text()


def test_minutes_are_a_clock_and_a_wall_temperature_is_none(tmp_path):
    wall = 20.0 + np.arange(60) + noisy(1)
    heater = np.where(T > 300.0, 80.0, 20.0)
    write(tmp_path / "a.csv", "T_wall [°C],heater [%],min", [wall, heater, T / 60.0])
    assert init(tmp_path) == 0
    text = (tmp_path / "study.yaml").read_text()
    assert "time: {column: min, unit: min}" in text
    study = load_study(tmp_path)
    assert [c.name for c in study.channels] == ["T_wall"]


@pytest.mark.parametrize(
    ("header", "unit", "step"), [("tempo (s)", "s", 2.0), ("ts_us", "us", 1e4)]
)
def test_what_grows_in_a_unit_of_time_is_the_clock(tmp_path, header, unit, step):
    """In any language, whatever rows were lost or written with the stamp of another."""
    stamps = (1.7645e15 if unit == "us" else 0.0) + step * np.arange(120.0)
    stamps[[9, 30, 77]] = stamps[[8, 29, 76]]
    kept = np.delete(np.arange(120), [20, 51, 52, 90])
    texts = [f"{v:.0f}" for v in stamps[kept]]
    write(tmp_path / "a.csv", f"{header},x (mm)", [texts, noisy(1, num=120)[kept]])
    assert init(tmp_path, "--system", "ode") == 0
    stated = yaml.safe_load((tmp_path / "study.yaml").read_text("utf-8"))
    assert stated["time"]["column"] == header and stated["time"]["unit"] == unit
    assert [c["name"] for c in stated["channels"]] == ["x"]


def test_valves_beside_one_that_is_called_so_are_commands(tmp_path):
    """Of two chambers inlets became channels, whose closed state stood for nothing measured."""
    rng = np.random.default_rng(4)
    valves = np.repeat(rng.integers(0, 2, (4, 12)), 10, axis=1).astype(float)
    warm = np.round(np.linspace(20.0, 21.0, 120), 1)  # rests, too, but is in a unit of its own
    columns = [np.arange(120.0), noisy(1, num=120), *valves, warm]
    header = "t (s),p (kPa),in1,in2,valve1,valve2,wall (°C)"
    write(tmp_path / "a.csv", header, columns)
    assert init(tmp_path, "--system", "ode") == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["in1", "in2", "valve1", "valve2"]
    assert [c.name for c in study.channels] == ["p", "wall"]


def test_a_column_of_dates_is_a_clock_before_a_counter(tmp_path):
    dates = [f"2026-03-01 09:{k // 30:02d}:{2 * k % 60:02d}" for k in range(60)]
    number = np.arange(60.0)
    write(tmp_path / "a.csv", "No.,Date,x (mm)", [number, dates, noisy(1)])
    assert init(tmp_path) == 0
    assert "time: {column: Date, unit: clock}" in (tmp_path / "study.yaml").read_text()


def test_a_file_that_goes_back_in_time_is_told_line_by_line(tmp_path, capsys):
    back = np.where(T == 300.0, 0.0, T)
    for name in "ab":
        write(tmp_path / f"{name}.csv", "t (s),x (mm)", [back, noisy(1)])
    assert init(tmp_path) == 2
    told = capsys.readouterr()
    assert "study.yaml was written, but must be mended" in told.err
    rows = [line for line in told.err.splitlines() if "time must increase" in line]
    assert [row.strip()[-200:].count("row 32") for row in rows] == [1, 1]


@pytest.mark.parametrize(
    "header, unit",
    [
        ("t/min", "min"),
        ("F/N", "N"),
        ("Throttle %", "%"),
        ("gyro deg/s", "deg/s"),
        ("gyro_x_dps", "deg/s"),
        ("pwm1_pct", "%"),
        ("cart/x", None),
        ("AccLat_mps2", "m/s^2"),
        ("Speed_kmh", "km/h"),
        ("out_mV_V", "mV/V"),
        ("stiffness_N_mm", None),
        ("F_min_N", "N"),
    ],
)
def test_units_as_headers_write_them(header, unit):
    assert column_of(header).unit == unit


def test_motors_look_commanded_and_quaternions_have_no_unit(tmp_path):
    write(tmp_path / "a.csv", "t_s,m1,m2,qw", [T * 1e-3, noisy(1), noisy(2), noisy(3)])
    assert init(tmp_path, "--system", "multicopter") == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["m1", "m2"]
    units = [s for s in study.todo if s.startswith("units")]
    assert units == ["units, which the header does not state: m1, m2"]


def test_an_index_in_brackets_is_no_unit():
    assert (column_of("hand_mm[1]").base, column_of("hand_mm[1]").unit) == ("hand_1", "mm")
    assert (column_of("q[0]").base, column_of("q[0]").unit) == ("q_0", None)
    assert column_of("cov[2][1]").base == "cov_2_1"
    assert column_of("force [N]").unit == "N"


SWING = np.sin(0.3 * np.arange(60)) + noisy(0)


def test_sweeps_of_a_test_stand_are_runs(tmp_path):
    rows = [
        f"{prop},{sweep},{1000 + 100 * k},{0.1 * k * sweep + 0.003 * (k % 3)}"
        for prop in ("7x4", "8x4")
        for sweep in (1, 2, 3)
        for k in range(12)
    ]
    (tmp_path / "all.csv").write_text("Propeller,Sweep,rpm,Thrust (g)\n" + "\n".join(rows) + "\n")
    assert init(tmp_path, "--system", "bench") == 0
    study = load_study(tmp_path)
    assert [r.name for r in study.runs][:2] == ["7x4 1", "7x4 2"] and len(study.runs) == 6
    assert not any("Sweep" in c.name for c in (*study.commands, *study.channels))


def test_parquet_files_become_a_study(tmp_path):
    pytest.importorskip("pyarrow")
    for run in ("one", "two"):
        columns = {"t_ms": T, "angle [deg]": SWING, "u": np.sign(np.sin(0.2 * T))}
        write_columns(tmp_path / f"{run}.parquet", columns)
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [r.name for r in study.runs] == ["one", "two"]
    assert [c.name for c in study.channels] == ["angle"] and [c.name for c in study.commands] == [
        "u"
    ]
    np.testing.assert_allclose(study.runs[0].time_s, 1e-3 * T)


def test_structs_of_one_mat_file_are_runs(tmp_path):
    from scipy.io import savemat

    part = {"time_s": 1e-3 * T, "x_mm": SWING, "force_N": np.where(T > 200.0, 1.0, 0.0)}
    savemat(tmp_path / "day.mat", {"slow": part, "fast": part | {"x_mm": 2.0 * SWING}})
    assert init(tmp_path) == 0
    text = (tmp_path / "study.yaml").read_text()
    assert "day.mat#slow" in text and "day.mat#fast" in text
    study = load_study(tmp_path)
    assert [r.name for r in study.runs] == ["day_slow", "day_fast"]
    assert study.runs[0].measured[3, 0] == pytest.approx(1e-3 * SWING[3])


def mcap(path: Path) -> None:
    """A log with a pose, a command and a topic that nobody needs, each with a clock of its own."""
    writer_of = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        topics = {
            "/robot/odom": (0, lambda k: {"pose": {"x": float(SWING[k])}}),
            "/robot/cmd_vel": (2, lambda k: {"linear": {"x": float(k // 20)}}),
            "/battery": (5, lambda k: {"volts": 12.0 - 0.01 * k, "amps": k, "cells": [3, 3]}),
        }
        for topic, (late_ms, content) in topics.items():
            channel = writer.register_channel(topic, "json", schema)
            for k, t in enumerate(T):
                stamp = round(1e6 * (t + late_ms))
                writer.add_message(channel, stamp, json.dumps(content(k)).encode(), stamp)
        writer.finish()


def test_topics_of_a_log_the_record_and_what_was_commanded(tmp_path, capsys):
    for name in ("a", "b"):
        mcap(tmp_path / f"{name}.mcap")
    assert init(tmp_path) == 0
    said = capsys.readouterr().out
    assert "topics: /robot/odom and /robot/cmd_vel" in said and "other topics: /battery" in said
    study = load_study(tmp_path)
    assert [c.name for c in study.channels] == ["pose_x"]
    assert [c.name for c in study.commands] == ["linear_x"]
    assert study.runs[0].name == "a"
    # the command, 2 ms later, at the clock of the record
    assert study.runs[0].command["linear_x"][30] == pytest.approx(1.0)
    assert init(tmp_path, "--force", "--part", "/battery") == 0
    assert {c.name for c in load_study(tmp_path).channels} >= {"volts", "amps"}
    capsys.readouterr()
    assert init(tmp_path, "--force", "--part", "/baterry") == 2
    assert "--part: no table '/baterry'; did you mean '/battery'" in capsys.readouterr().err


def test_a_file_that_cannot_be_read_is_told(steps, capsys):
    (steps / "broken.mat").write_bytes(b"no MAT file at all")
    assert init(steps) == 0
    assert "not read: " in (out := capsys.readouterr().out) and "broken.mat" in out


def test_speeds_of_motors_are_commands_in_rpm(tmp_path):
    rng = np.random.default_rng(0)
    speeds = [4000.0 + 300.0 * rng.normal(size=60) for _ in range(2)]
    for run in ("a", "b"):
        write(tmp_path / f"{run}.csv", "time,height,rpm1,rpm2", [T, noisy(3), *speeds])
    assert init(tmp_path, "--system", "multicopter") == 0
    said = (tmp_path / "study.yaml").read_text()
    for name in ("rpm1", "rpm2"):
        assert f"- {{name: {name}, unit: rpm, " in said.split("\ncommands:")[1]


def two_instruments(folder: Path, names=("hop", "turn"), first="mocap", second="fcu", late=0.0):
    """A camera at 100 Hz and a controller at 50 Hz, each with a file and a clock of its own."""
    for seed, run in enumerate(names):
        slow = 20.0 * np.arange(40) + 5.0
        place = np.sin(0.01 * T) + noisy(seed, 0.01)
        write(folder / f"{run}_{first}.csv", "Zeit (ms),z_m", [T + late, place])
        throttle = np.where(slow > 300.0, 0.6 + 0.1 * seed, 0.4)
        rate = np.cos(0.01 * slow) + noisy(seed)[:40]
        write(folder / f"{run}_{second}.csv", "stamp_ms,p_dps,throttle", [slow, rate, throttle])


def test_files_of_two_instruments_are_one_run(tmp_path, capsys):
    """Of each flight two files: those of one instrument had become the runs, the others nothing."""
    two_instruments(tmp_path)
    assert init(tmp_path) == 0
    assert "hop_mocap.csv with hop_fcu.csv" in capsys.readouterr().out
    study = load_study(tmp_path)
    assert [run.name for run in study.runs] == ["hop", "turn"]
    assert [c.name for c in study.channels] == ["z_m", "p"]
    assert [c.name for c in study.commands] == ["throttle"]
    run = study.runs[0]
    assert len(run.time_s) == 60 and run.time_s[1] == pytest.approx(0.01)
    at = 20.0 * np.arange(40) + 5.0
    expected = np.interp(T, at, np.deg2rad(np.cos(0.01 * at) + noisy(0)[:40]), np.nan)
    np.testing.assert_allclose(run.measured[:, 1], expected, atol=1e-8)
    # held between its own samples, and before the first; a jump in the middle of a row is halved
    throttle = run.command["throttle"]
    assert sorted(set(throttle.round(12))) == [0.4, 0.5, 0.6]
    jumps = np.flatnonzero(np.abs(throttle - 0.5) < 1e-12)
    assert set(throttle) - set(throttle[jumps]) == {0.4, 0.6}
    assert (throttle[jumps - 1] != throttle[jumps + 1]).all()


def test_a_command_that_ramps_is_straight_between_the_samples_of_its_instrument(tmp_path):
    two_instruments(tmp_path)
    slow = 20.0 * np.arange(40) + 5.0
    for path in tmp_path.glob("*_fcu.csv"):
        ramp = np.clip(0.002 * (slow - 100.0), 0.0, 0.4)
        write(path, "stamp_ms,p_dps,throttle", [slow, np.cos(slow), ramp])
    assert init(tmp_path) == 0
    assert "fill: linear" in (tmp_path / "study.yaml").read_text()
    expected = np.interp(T, slow, np.clip(0.002 * (slow - 100.0), 0.0, 0.4))
    run = load_study(tmp_path).runs[0]
    np.testing.assert_allclose(run.command["throttle"], expected, atol=1e-4)


def test_an_instrument_may_stand_first_in_the_name_and_one_run_is_enough(tmp_path):
    two_instruments(tmp_path, names=("hop",))
    for path in list(tmp_path.iterdir()):
        run, tag = path.stem.split("_")
        path.rename(tmp_path / f"{tag}-{run}.csv")
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert {run.name.partition("_")[0] for run in study.runs} == {"hop"}
    assert [c.name for c in study.channels] == ["z_m", "p"]


@pytest.mark.parametrize(
    "change", [{"late": 1e6}, {"first": "1", "second": "2", "names": ("hop",)}]
)
def test_files_that_are_not_of_one_run_stay_apart(tmp_path, capsys, change):
    """Clocks that do not meet; numbers count runs, whatever their columns."""
    two_instruments(tmp_path, **change)
    assert init(tmp_path) == 0
    assert "files with other columns, not used" in capsys.readouterr().out


def test_what_is_not_used_is_named_with_its_folder(tmp_path, capsys):
    """Of four folders it said: not used: data_desired.csv."""
    for run in ("slow", "fast"):
        folder = tmp_path / run
        folder.mkdir()
        rows = np.column_stack([T, np.sin(T), np.cos(T)])
        np.savetxt(folder / "data.csv", rows, delimiter=",", header="t,x,u", comments="")
        late = rows[:9, :2] + 1e6  # a clock that meets no other
        np.savetxt(folder / "wanted.csv", late, delimiter=",", header="t,w", comments="")
    init(tmp_path)
    said = capsys.readouterr().out
    assert "files with other columns, not used: fast/wanted.csv, slow/wanted.csv" in said


@pytest.mark.parametrize(
    "name",
    ["z_m", "p_dps", "gyro_x (deg/s)", "roll_deg", "vx_mps", "Position (mm)", "az_mps2",
     "body_rate_y (deg/s)", "joint angle 1 [deg]", "battery_voltage_V"],
)  # fmt: skip
def test_what_is_called_a_measurement_is_a_channel(tmp_path, name):
    """Held between slow samples, they had become commands."""
    for k in range(2):
        held = np.repeat(np.sin(0.7 * np.arange(12) + k), 5)
        force = np.where(T > 200.0, 1.0 + k, 0.0)
        write(tmp_path / f"r{k}.csv", f"t (ms),{name},cmd_1,pos_x (mm)", [T, held, force, noisy(k)])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["cmd_1"] and len(study.channels) == 2


@pytest.mark.parametrize(
    "name",
    ["motor_voltage (V)", "pwm_1", "Throttle %", "z_setpoint (m)", "cmd_vx (m/s)", "u",
     "torque_cmd (N m)", "pressure_set (bar)", "roll_ref (deg)"],
)  # fmt: skip
def test_what_is_called_a_command_is_one(tmp_path, name):
    for k in range(2):
        asked = np.sin(0.01 * T) + noisy(k + 3)
        write(tmp_path / f"r{k}.csv", f"t (ms),{name},x (mm)", [T, asked, noisy(k)])
    assert init(tmp_path) == 0
    study = load_study(tmp_path)
    assert len(study.commands) == 1 and [c.name for c in study.channels] == ["x"]


def test_a_current_that_is_set_drives_and_the_voltage_that_answers_does_not(tmp_path, capsys):
    """Set in steps in one run and swept in the other; U [V] is also what a command is called."""
    rng, time = np.random.default_rng(5), np.arange(0.0, 400.0)
    steps = np.repeat(rng.uniform(-5.0, 20.0, 10), 40)
    for name, current in (("steps", steps), ("sweep", 8.0 + 6.0 * np.sin(0.02 * time))):
        voltage = 48.0 - 0.03 * current + rng.normal(0.0, 0.01, len(time))
        write(tmp_path / f"{name}.csv", "t (s),I (A),U (V)", [time, current, voltage])
    assert init(tmp_path) == 0
    said = capsys.readouterr()
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["I"]
    assert [c.name for c in study.channels] == ["U"]
    assert "shows no more" not in said.out + said.err


@pytest.mark.parametrize("scatter", [0.0, 0.2])
def test_what_was_set_has_no_flat_top_and_headers_without_units_no_slip(tmp_path, capsys, scatter):
    """With scatter in one run the force is taken for a channel, else for a command."""
    rng, time = np.random.default_rng(6), np.arange(0.0, 20.0, 0.05)
    steps = np.repeat(rng.uniform(0.0, 60.0, 10), 40)
    sweep = 30.0 + 20.0 * np.sin(0.5 * time) + rng.normal(0.0, scatter, len(time))
    for name, force in (("steps", steps), ("sweep", sweep)):
        speed = force / 25.4 + rng.normal(0.0, 0.02, len(time))
        write(tmp_path / f"{name}.csv", "t (s),push,speed", [time, force, speed])
    assert init(tmp_path) == 0
    assert "record:" not in capsys.readouterr().out
    commands = [c.name for c in load_study(tmp_path).commands]
    assert commands == ([] if scatter else ["push"])


@pytest.mark.parametrize(
    ("names", "uses"),
    [
        (("train_a", "train_b", "test_a"), {"test_a": "test"}),
        (("ident_1", "val_1", "Testing_1"), {"val_1": "select", "Testing_1": "test"}),
        (("training_1", "validation_2"), {"validation_2": "test"}),
        (("train1", "train2", "test1"), {"test1": "test"}),
        (("train_1", "train_2", "test_1", "test_2"), {"test_1": "test", "test_2": "test"}),
        (("test_1", "test_2", "test_3"), {"test_3": "test"}),  # they number runs
    ],
)
def test_runs_that_are_called_kept_back_are(tmp_path, names, uses):
    """Of train and test, test was fitted, and train was the test."""
    for k, name in enumerate(names):
        force = np.where(100.0 + 50.0 * k < T, 1.0 + k, 0.0)
        write(tmp_path / f"{name}.csv", "t (ms),x (mm),force_N", [T, noisy(k), force])
    assert init(tmp_path) == 0
    runs = load_study(tmp_path).runs
    assert {run.name: run.use for run in runs} == {name: uses.get(name, "fit") for name in names}
    assert not any(run.setup for run in runs)  # train and test are no specimens


@pytest.mark.parametrize("seed", range(3))
def test_set_points_that_rest_are_commands_though_one_run_has_small_steps(tmp_path, seed, capsys):
    """They were channels, and each step of theirs a marker that slipped."""
    rng = np.random.default_rng(seed)
    for k, size in enumerate((0.4, 14.0, 11.0, 18.0)):
        levels = 40.0 + np.array([0.0, size, -size * rng.uniform(0.2, 0.8)])
        aim = np.repeat(np.round(levels, 2), 20)
        heat = np.repeat(np.where(rng.uniform(size=15) > 0.5, 100.0, 0.0), 4)
        is_aim = [T, aim + noisy(k), heat, aim]
        write(tmp_path / f"r{k}.csv", "t (ms),temp,Q1,aim", is_aim)
    assert init(tmp_path) == 0
    assert {c.name for c in load_study(tmp_path).commands} == {"Q1", "aim"}
    assert "slipped" not in capsys.readouterr().out


@pytest.mark.parametrize(("rows", "are_sorted"), [((7,), True), ((5, 20, 40), False)])
def test_a_row_out_of_order_is_sorted_and_told(tmp_path, rows, are_sorted, capsys):
    """A thrust stand wrote its first row twice; the study that was guessed could not be read."""
    for k in range(2):
        time = np.arange(150) * 10.0
        for row in rows if k else ():
            time[row] -= 14.0
        x = noisy(k, num=150)
        write(tmp_path / f"r{k}.csv", "t (ms),x (mm),force_N", [time, x, np.sign(x)])
    assert init(tmp_path) == (0 if are_sorted else 2)
    assert ("rows out of order, sorted by their stamps: r1 (1)" in capsys.readouterr().out) == (
        are_sorted
    )
    if are_sorted:
        assert all((np.diff(run.time_s) > 0.0).all() for run in load_study(tmp_path).runs)


def test_recordings_one_after_another_are_not_sorted_into_each_other(tmp_path, capsys):
    """Their clock goes back twice in 240 rows; sorted, rows of three recordings took turns."""
    time = np.concatenate([k + np.arange(80) * 10.0 for k in range(3)])
    for k in range(2):
        x = noisy(k, num=240)
        write(tmp_path / f"r{k}.csv", "t (ms),x (mm),force_N", [time, x, np.sign(x)])
    assert init(tmp_path) == 2
    assert "sorted" not in capsys.readouterr().out


def test_a_unit_of_the_clock_that_is_guessed_says_how_long_runs_would_be(tmp_path):
    """Whole seconds of a heater, taken for milliseconds: 1.2 s for 20 minutes."""
    for k in range(2):
        write(tmp_path / f"r{k}.csv", "Time,x (mm),force_N", [T, noisy(k), np.where(T > 200, k, 1)])
    assert init(tmp_path) == 0
    said = next(one for one in load_study(tmp_path).todo if one.startswith("time.unit"))
    assert said == (
        "time.unit: column Time states none; ms is a guess by its steps: r0.csv would take 0.59 s"
    )


def test_the_last_word_of_a_clock_may_be_its_unit(tmp_path, capsys):
    """Steps of 2 s of a hopper, whose header said so, were taken for milliseconds."""
    for k in range(2):
        clock = 2.0 * np.arange(len(T))
        write(tmp_path / f"r{k}.csv", "elapsed s,x (mm),force_N", [clock, noisy(k), T > 200])
    assert init(tmp_path) == 0
    assert "clock: column elapsed s in s, steps of 2 s" in capsys.readouterr().out
    assert not any(one.startswith("time.unit") for one in load_study(tmp_path).todo)


def test_a_serial_log_with_remarks_is_a_table(tmp_path):
    """A banner above the names, a remark between rows: `.log` was no table, a remark an error."""
    rows = [f"{2000 * k},{20.0 + 0.1 * (k % 7):.2f},{0.6 * (k % 9 < 4):.1f}" for k in range(60)]
    rows.insert(31, "# wifi reconnect, 2 tries")
    text = "\n".join(["boot: mode 3", "millis,probe_C,pwm", *rows]) + "\n"
    (tmp_path / "boiler.log").write_text(text)
    assert init(tmp_path, "--system", "ode") == 0
    text = (tmp_path / "study.yaml").read_text()
    assert "file: boiler.log" in text and "{name: pwm" in text.partition("commands:")[2]


def test_a_temperature_beside_a_motor_is_no_command(tmp_path):
    """It rose by its last digit: "held for many samples", and all runs were repeats of one."""
    for k in range(4):
        current = 2.0 * np.sin(0.03 * (k + 1) * T) + noisy(k, 0.01)
        speed = np.cumsum(current) + noisy(9 + k, 0.5)
        warm = np.round(24.0 + 5e-4 * T, 1)
        columns = (T, speed, current, warm)
        names = "Zeit [s];Drehzahl [1/min];Strom [A];Temperatur [°C]"
        write(tmp_path / f"Messung_{k}.csv", names, columns, ";", ",")
    assert init(tmp_path, "--system", "ode") == 0
    stated = load_text(tmp_path)
    assert [c["name"] for c in stated["commands"]] == ["Strom"]
    assert not any("repeat_of" in run for run in stated["runs"])


@pytest.mark.parametrize(("seconds", "every"), [(40.0, 2), (0.1, 1)])
def test_samples_are_left_out_where_the_course_is_seen_without_them(
    tmp_path, seconds, every, capsys
):
    """Flights of 100 Hz were thinned to 4 Hz, and their commands with them."""
    t = 0.01 * np.arange(105_000.0)
    wave = np.sin(2.0 * np.pi * t / seconds)
    np.savez(tmp_path / "a.npz", time_s=t, x_m=wave, y_m=np.sin(0.1 * t))
    assert init(tmp_path, "--system", "ode") == 0
    assert load_text(tmp_path).get("defaults", {}).get("every", 1) == every
    said = "one of 2 is used" if every > 1 else "all are used"
    assert f"210000 samples cost time: {said}" in capsys.readouterr().out


def load_text(folder: Path) -> dict:
    return yaml.safe_load((folder / "study.yaml").read_text())
