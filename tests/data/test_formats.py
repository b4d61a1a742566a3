"""Recordings in labs' formats: every reader against files that the formats' own writers made."""

import json
import struct

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.data.formats import parts_of, read_columns, write_columns
from diffsim.data.study_file import load_study

TIME = np.linspace(0.0, 1.0, 11)
DECIMALS = np.arange(11) / 10  # what whole ticks of a log's clock stand for, to the last bit
COLUMNS = {
    "time_s": TIME,
    "angle": np.where(TIME > 0.85, np.nan, np.sin(TIME)),
    "count": np.arange(11),
    "label": np.array(["a"] * 5 + ["b"] * 6),
}


@pytest.mark.parametrize("suffix", [".parquet", ".h5"])
def test_what_is_written_is_read_back_unchanged(tmp_path, suffix):
    pytest.importorskip("pyarrow" if suffix == ".parquet" else "h5py")
    path = write_columns(tmp_path / f"log{suffix}", COLUMNS)
    back = read_columns(path)
    assert list(back) == list(COLUMNS) if suffix == ".parquet" else set(back) == set(COLUMNS)
    for name in ("time_s", "angle", "count"):
        np.testing.assert_array_equal(back[name], COLUMNS[name])
    assert back["label"].tolist() == COLUMNS["label"].tolist()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_mat_files_by_scipy(tmp_path):
    from scipy.io import savemat

    numbers = {name: COLUMNS[name] for name in ("time_s", "angle")}
    savemat(tmp_path / "log.mat", {**numbers, "gain": 3.0, "run2": {"t": TIME, "q": TIME[None]}})
    assert parts_of(tmp_path / "log.mat") == ["", "run2"]
    back = read_columns(tmp_path / "log.mat#run2")
    np.testing.assert_array_equal(back["q"], TIME)
    assert set(read_columns(tmp_path / "log.mat")) == {"time_s", "angle"}
    savemat(tmp_path / "two.mat", {"run1": {"t": TIME}, "run2": {"t": TIME}})
    with pytest.raises(ValueError, match=r"holds several parts.*two\.mat#run1, two\.mat#run2"):
        read_columns(tmp_path / "two.mat")
    with pytest.raises(ValueError, match=r"has no part 'run3'; did you mean 'run2'"):
        read_columns(tmp_path / "log.mat#run3")


def test_hdf5_groups_and_wide_arrays(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["imu/time_s"] = TIME
        file["imu/gyro"] = np.stack([TIME, -TIME, 2.0 * TIME], axis=1)
        file["imu/rate_hz"] = 100.0
    back = read_columns(tmp_path / "log.h5#imu")
    np.testing.assert_array_equal(back["gyro[2]"], 2.0 * TIME)
    assert set(back) == {"time_s", "gyro[0]", "gyro[1]", "gyro[2]"}


def test_json_messages_of_an_mcap(tmp_path):
    writer_of = pytest.importorskip("mcap.writer")
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        schema = writer.register_schema("pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for k, t in enumerate(TIME):
            stamp = 5_000_000_000 + round(1e9 * t)
            data = json.dumps({"position": {"x": float(t)}, "q": [1, 0, 0, k]}).encode()
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    back = read_columns(f"{path}#/pose")
    np.testing.assert_array_equal(back["time_s"], DECIMALS)
    np.testing.assert_array_equal(back["position.x"], TIME)
    np.testing.assert_array_equal(back["q[3]"], np.arange(11))


def ulog(start_us):
    """A log with one topic, as the format's description says (PX4 user guide, ULog)."""

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start_us) + message("B", bytes(40))
    out += message("F", b"motors:uint64_t timestamp;float[2] control;")
    out += message("A", struct.pack("<BH", 0, 7) + b"motors")
    for k, t in enumerate(TIME):
        row = struct.pack("<HQff", 7, start_us + round(1e6 * t), 0.5 * k, -1.0)
        out += message("D", row)
    return out


def test_px4_logs(tmp_path):
    pytest.importorskip("pyulog")
    (tmp_path / "flight.ulg").write_bytes(ulog(123_000_000))
    back = read_columns(tmp_path / "flight.ulg#motors")
    np.testing.assert_array_equal(back["time_s"], DECIMALS)
    np.testing.assert_array_equal(back["control[0]"], 0.5 * np.arange(11))
    assert back["timestamp"][0] == 123_000_000


def test_ros_2_bags(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    point = store.types["geometry_msgs/msg/Point"]
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        name = "geometry_msgs/msg/Point"
        connection = writer.add_connection("/tip", name, typestore=store)
        for t in TIME:
            raw = store.serialize_cdr(point(x=float(t), y=2.0, z=-1.0), name)
            writer.write(connection, 1_000 + round(1e9 * t), raw)
    (file,) = (tmp_path / "bag").glob("*.db3")
    back = read_columns(f"{file}#/tip")
    np.testing.assert_array_equal(back["time_s"], DECIMALS)
    np.testing.assert_array_equal(back["x"], TIME)


STUDY = """
name: swing
model:
  system: ode
  states: {angle: 1, rate: 0}
  rates: {angle: rate, rate: -stiffness*angle}
  parameters: {stiffness: 1}
  readings: {angle: angle}
channels:
  - {name: angle, unit: rad, sd: 0.01}
runs:
  - {name: one, file: "log.SUFFIX#PART"}
"""


@pytest.mark.parametrize("suffix", ["mat", "h5", "parquet"])
def test_a_study_reads_them_as_it_reads_csv(tmp_path, suffix):
    pytest.importorskip({"mat": "scipy", "h5": "h5py", "parquet": "pyarrow"}[suffix])
    numbers = {"time_s": TIME, "angle": np.cos(TIME)}
    write_columns(tmp_path / f"log.{suffix}", numbers)
    text = STUDY.replace("SUFFIX", suffix).replace("#PART", "")
    (tmp_path / "study.yaml").write_text(text)
    (run,) = load_study(tmp_path / "study.yaml").runs
    np.testing.assert_array_equal(run.time_s, TIME)
    np.testing.assert_array_equal(run.measured[:, 0], np.cos(TIME))


def test_names_that_matlab_does_not_have_are_said(tmp_path, capsys):
    (tmp_path / "run.csv").write_text("time_s,Force [N]\n0,1\n1,2\n")
    assert main(["convert", str(tmp_path / "run.csv"), str(tmp_path / "run.mat")]) == 0
    assert "renamed: Force [N] to Force__N_" in capsys.readouterr().out
    assert set(read_columns(tmp_path / "run.mat")) == {"time_s", "Force__N_"}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.parquet#part", "written as one table"),
        ("a.mcap", r"tables are written as \.csv, \.parquet"),
    ],
)
def test_what_is_not_written_is_refused(tmp_path, name, message):
    with pytest.raises(ValueError, match=message):
        write_columns(f"{tmp_path}/{name}", {"a": np.ones(1)})
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_named(tmp_path):
    (tmp_path / "log.mat").write_bytes(b"not a matrix" * 100)
    with pytest.raises(ValueError, match=r"log\.mat: cannot be read as \.mat"):
        read_columns(tmp_path / "log.mat")
    with pytest.raises(FileNotFoundError, match=r"other\.mat: no such file"):
        read_columns(tmp_path / "other.mat")


def test_convert_shows_and_writes(tmp_path, capsys):
    from scipy.io import savemat

    savemat(tmp_path / "log.mat", {"t": TIME, "force": {"f": 2.0 * TIME, "g": TIME}})
    assert main(["convert", str(tmp_path / "log.mat")]) == 0
    said = capsys.readouterr().out
    assert "log.mat#force: 11 rows" in said and "f: 0 to 2" in said
    assert main(["convert", f"{tmp_path}/log.mat#force", str(tmp_path / "force.csv")]) == 0
    lines = (tmp_path / "force.csv").read_text().splitlines()
    assert lines[0] == "f,g" and lines[2] == "0.2,0.1"
    assert main(["convert", f"{tmp_path}/log.mat#force", str(tmp_path / "force.xlsx")]) == 2
    assert "written as .csv" in capsys.readouterr().err


def test_a_converted_csv_has_every_digit_and_empty_gaps(tmp_path):
    from scipy.io import savemat

    wanted = np.array([1.0 / 3.0, np.nan, -2e-7, 1.7e9 + 1e-6])
    savemat(tmp_path / "log.mat", {"t": np.arange(4.0), "force": wanted})
    assert main(["convert", str(tmp_path / "log.mat"), str(tmp_path / "log.csv")]) == 0
    read = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(read["force"], wanted)
    assert ",\n" in (tmp_path / "log.csv").read_text()


def test_json_logs_of_records_with_facts_beside_them(tmp_path):
    log = {
        "mass": 0.5,
        "motor": "sts3215",
        "position": 7.0,  # the records say it themselves
        "entries": [
            {"timestamp": float(t), "position": 2.0 * t, "enabled": bool(t < 0.5)} for t in TIME
        ],
    }
    (tmp_path / "run.json").write_text(json.dumps(log))
    back = read_columns(tmp_path / "run.json")
    np.testing.assert_array_equal(back["position"], 2.0 * TIME)
    np.testing.assert_array_equal(back["enabled"], TIME < 0.5)
    np.testing.assert_array_equal(back["mass"], np.full(11, 0.5))
    assert set(back["motor"]) == {"sts3215"}
    deep = {"robot": "a", "episode": {"kp": 8, "steps": log["entries"]}, "others": [{"x": 1}]}
    (tmp_path / "deep.json").write_text(json.dumps(deep))
    assert parts_of(tmp_path / "deep.json") == ["episode.steps", "others"]
    facts = read_columns(tmp_path / "deep.json#episode.steps")
    assert set(facts["robot"]) == {"a"}
    assert set(facts["kp"]) == {8}
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(e) + "\n" for e in log["entries"]))
    np.testing.assert_array_equal(read_columns(tmp_path / "log.jsonl")["timestamp"], TIME)


def test_a_folder_of_json_logs_gives_a_first_study(tmp_path, capsys):
    rng = np.random.default_rng(0)
    time_s = 0.01 * np.arange(200)
    for k, mass in enumerate((0.5, 1.0, 1.5)):
        goal = np.sin((3.0 + k) * time_s)
        position = np.roll(goal, 3) / mass + 1e-3 * rng.normal(size=200)
        entries = [
            {"timestamp": t, "goal_position": g, "position": q}
            for t, g, q in zip(time_s.tolist(), goal.tolist(), position.tolist(), strict=True)
        ]
        log = {"mass": mass, "trajectory": "sine", "entries": entries}
        (tmp_path / f"log_{k}.json").write_text(json.dumps(log))
    (tmp_path / "info.json").write_text('{"robot": "arm"}')  # no records: no table
    assert main(["diagnose", "init", str(tmp_path)]) == 0
    study = load_study(tmp_path / "study.yaml")
    assert [c.name for c in study.channels] == ["position"]
    assert {"goal_position"} == set(study.runs[0].command)
    assert [run.setup["mass"] for run in study.runs] == [0.5, 1.0, 1.5]
