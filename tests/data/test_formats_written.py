"""Recordings back out as logs: what is written is read again by the format's own library."""

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.data import load_study
from diffsim.data.formats import parts_of, read_columns, renamed, write_columns

TIME = np.arange(12) * 0.125 + np.array([0.0, 1e-6] * 6)  # whole microseconds
NUMBERS = {
    "time_s": TIME,
    "force_n": np.array([np.nan, 1.0 / 3.0, -2e-300, *np.arange(9) / 7.0]),
    "single": (np.arange(12) / 3.0).astype(np.float32),
    "count": np.arange(12) - 2**53 - 1,  # more digits than a float64 has
    "small": np.arange(12).astype(np.uint8),
    "on": np.arange(12) % 2 == 0,
    "q[0]": np.cos(TIME),
    "q[1]": np.sin(TIME),
    "pose.position.x": TIME**2,
    "pose.position.y": -TIME,
    "nothing": np.full(12, np.nan),
}
LIBRARY = {".ulg": "pyulog", ".db3": "rosbags", ".mcap": "mcap"}


@pytest.mark.parametrize("suffix", LIBRARY)
def test_a_log_is_read_back_to_the_last_bit(tmp_path, suffix):
    pytest.importorskip(LIBRARY[suffix])
    path = write_columns(tmp_path / f"log{suffix}", NUMBERS)
    back = read_columns(path)
    if suffix == ".ulg":
        np.testing.assert_array_equal(back.pop("timestamp"), np.round(1e6 * TIME))
    assert list(back) == list(NUMBERS)
    assert renamed(path, NUMBERS) == {}
    for name, values in NUMBERS.items():
        np.testing.assert_array_equal(back[name], values, err_msg=name)
        if suffix == ".ulg" and name != "on":  # the width too; pyulog reads bool as int8
            assert back[name].dtype == values.dtype, name


def test_text_and_names_of_a_bag_and_a_bag_in_place_of_the_older(tmp_path):
    pytest.importorskip("rosbags")
    given = {"t": TIME + 5.0, "Force [N]": TIME, "mode": np.array(["off", "on"] * 6)}
    for _ in range(2):
        path = write_columns(f"{tmp_path}/run.db3#/rig/state", given)
    assert path == tmp_path / "run" / "run.db3"
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["metadata.yaml", "run", "run.db3"]
    assert parts_of(path) == ["/rig/state"]
    assert renamed("run.db3", given) == {"Force [N]": "force_n"}
    back = read_columns(path)
    assert list(back) == ["time_s", "t", "force_n", "mode"]
    np.testing.assert_array_equal(back["time_s"], TIME)  # a log counts from 0
    np.testing.assert_array_equal(back["t"], TIME + 5.0)
    assert back["mode"].tolist() == given["mode"].tolist()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match=r"run: is there and is not this bag"):
        write_columns(tmp_path / "run.db3", given)
    assert (tmp_path / "run" / "notes.txt").is_file()


def test_a_topic_of_a_px4_log_keeps_its_clock_and_name(tmp_path):
    pytest.importorskip("pyulog")
    ticks = 123_000_000 + np.round(1e6 * TIME).astype(np.uint64)
    given = {"time_s": TIME, "timestamp": ticks, "control[0]": TIME.astype(np.float32)}
    path = write_columns(f"{tmp_path}/flight.ulg#actuator_motors", given)
    back = read_columns(f"{path}#actuator_motors")
    assert list(back) == list(given)
    for name, values in given.items():
        np.testing.assert_array_equal(back[name], values, err_msg=name)


@pytest.mark.parametrize(
    ("name", "columns", "message"),
    [
        ("a.ulg", {"time_s": [0.0, 1.0], "mode": ["a", "b"]}, "column mode: PX4 logs hold numbers"),
        ("a.ulg", {"time_s": [0.0, 2e-7]}, "rows 1 and 2 are 2e-07 s apart, but .* steps of 1e-06"),
        ("a.ulg", {"t": [0.0, 1.0], "timestamp": [0, 5]}, None),
        ("a.ulg", {"time_s": [0.0, 1.0], "timestamp": [0, 5]}, "are different clocks: row 1"),
        ("a.ulg", {"time_s": [0.0], "timestamp": [0.5]}, "must hold integers"),
        ("a.ulg", {"force": [0.0]}, "a PX4 log needs a clock: a column time_s, t or time"),
        ("a.ulg#imu.1", {"time_s": [0.0], "x": [0.0]}, r"topic 'imu\.1': PX4 logs take letters"),
        ("a.db3", {"time_s": [0.0], "F": [0.0], "f": [1.0]}, "F and f would both be field f"),
        ("a.db3", {"time_s": [0.0], "a": [0.0], "a.b": [1.0]}, "a and a.b would both be field a"),
        ("a.db3", {"time_s": [0.0], "a.b": [0.0], "a": [1.0]}, "a.b and a would both be field a"),
        ("a.db3#my topic", {"time_s": [0.0], "a": [1.0]}, "topic 'my topic': ROS takes words"),
        ("a.db3", {"time_s": [0.0]}, "needs a column beside the clock"),
        ("a.parquet#part", {"a": [1.0]}, "written as one table"),
        ("a.bag", {"time_s": [0.0]}, "tables are written as .csv, .parquet"),
    ],
)  # fmt: skip
def test_what_a_format_cannot_hold_is_refused(tmp_path, name, columns, message):
    for library in LIBRARY.values():
        pytest.importorskip(library)
    arrays = {column: np.array(values) for column, values in columns.items()}
    if message is None:
        write_columns(f"{tmp_path}/{name}", arrays)
        return
    with pytest.raises(ValueError, match=message):
        write_columns(f"{tmp_path}/{name}", arrays)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".ulg", ".db3", ".mcap"])
def test_a_csv_goes_out_and_comes_in_by_init(tmp_path, capsys, suffix):
    pytest.importorskip(LIBRARY[suffix])
    time = np.arange(60) / 50  # decimals, as a logger writes them
    for run, turn in {"slow": 1.0, "fast": 3.0}.items():
        source = tmp_path / f"{run}.csv"
        rows = zip(time.tolist(), np.cos(turn * time).tolist(), strict=True)
        source.write_text("time_s,angle_rad\n" + "".join(f"{t!r},{a!r}\n" for t, a in rows))
        assert main(["convert", str(source), str(tmp_path / "logs" / f"{run}{suffix}")]) == 0
        assert "60 rows, 2 columns" in capsys.readouterr().out
    assert main(["diagnose", "init", str(tmp_path / "logs")]) == 0, capsys.readouterr().err
    study = load_study(tmp_path / "logs")
    assert [c.unit for c in study.channels] == ["rad"]
    runs = {run.name: run for run in study.runs}
    assert sorted(runs) == ["fast", "slow"]
    np.testing.assert_array_equal(runs["fast"].time_s, time)
    np.testing.assert_array_equal(runs["fast"].measured[:, 0], np.cos(3.0 * time))
