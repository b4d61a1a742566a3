"""Recordings in labs' formats: every reader against files that the formats' own writers made."""

import json
import struct

import numpy as np
import pytest
import scipy.io

from diffsim.cli import main
from diffsim.data.formats import left_out_of, parts_of, read_columns, write_columns
from diffsim.data.study_file import load_study
from diffsim.data.table_guess import column_of

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


def _element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def test_mat_files_hold_runs_in_cells_and_in_arrays_of_structs(tmp_path):
    from scipy.io import savemat

    cells = np.empty((2, 2, 1), dtype=object)
    runs = np.empty((1, 2), dtype=[("t", object), ("q", object)])
    for k, length in enumerate((30, 40)):
        cells[:, k, 0] = [np.arange(length)[:, None], np.ones((3, length))]
        runs[0, k] = (np.arange(length), np.ones(length))
    savemat(tmp_path / "cells.mat", {"t": cells[0], "y": cells[1], "dt": 0.01})
    savemat(tmp_path / "structs.mat", {"runs": runs})
    assert parts_of(tmp_path / "cells.mat") == ["t(1)", "t(2)"]
    back = read_columns(tmp_path / "cells.mat#t(2)")
    assert list(back) == ["t", "y[0]", "y[1]", "y[2]"] and len(back["t"]) == 40
    assert parts_of(tmp_path / "structs.mat") == ["runs(1)", "runs(2)"]
    assert len(read_columns(tmp_path / "structs.mat#runs(2)")["q"]) == 40


def test_signals_that_simulink_and_dspace_saved_are_columns_of_one_run(tmp_path):
    """Each signal was a run of its own, called signal_1; of dSPACE nothing was read."""
    from scipy.io import savemat

    def saved(values, label=""):
        return {"time": TIME, "signals": {"values": values, "label": label}, "blockName": ""}

    many = {"x": saved(TIME), "q": saved(2.0 * TIME), "u": saved(3.0 * TIME, "voltage")}
    savemat(tmp_path / "sim.mat", many)
    assert parts_of(tmp_path / "sim.mat") == [""]
    back = read_columns(tmp_path / "sim.mat")
    assert set(back) == {"time", "x", "q", "voltage"}
    np.testing.assert_array_equal(back["q"], 2.0 * TIME)
    assert set(read_columns(tmp_path / "sim.mat#x")) == {"time", "x"}  # as a study may have it
    with pytest.raises(ValueError, match=r"has no part 'y'.*name one as FILE#PART: sim\.mat$"):
        read_columns(tmp_path / "sim.mat#y")
    savemat(tmp_path / "runs.mat", {f"run{k}": saved(TIME + k) for k in (1, 2)})
    assert parts_of(tmp_path / "runs.mat") == ["run1", "run2"]

    signals = np.zeros(2, dtype=[("Name", object), ("Data", object)])
    signals[0] = ('Model Root/Motor/"u[V]"', TIME)
    signals[1] = ("Model Root/Encoder/Out1", 2.0 * TIME)
    axes = np.zeros(1, dtype=signals.dtype)
    axes[0] = ("", TIME)
    savemat(tmp_path / "rec.mat", {"rec": {"X": axes, "Y": signals, "Description": ""}})
    assert set(read_columns(tmp_path / "rec.mat#rec")) == {"time", "u[V]", "Out1"}


def test_objects_of_matlab_are_told_with_a_way_out(tmp_path, recwarn):
    """Tables of MATLAB are no arrays: "variable None: no table", below two warnings of SciPy."""
    from scipy.io import savemat

    savemat(tmp_path / "log.mat", {"inner": TIME})
    whole = (tmp_path / "log.mat").read_bytes()
    flags = _element(6, struct.pack("<II", 17, 0))
    words = b"".join(_element(1, word) for word in (b"T", b"MCOS", b"table"))
    opaque = _element(14, flags + words + whole[128:])
    (tmp_path / "log.mat").write_bytes(whole[:128] + opaque + opaque)
    with pytest.raises(ValueError, match=r"objects of MATLAB \(a table, .*writetable"):
        read_columns(tmp_path / "log.mat")
    (tmp_path / "log.mat").write_bytes(whole + opaque)
    assert set(read_columns(tmp_path / "log.mat")) == {"inner"}
    assert any("writetable" in said for said in left_out_of(tmp_path / "log.mat"))
    assert not recwarn.list


def test_hdf5_groups_and_wide_arrays(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["imu/time_s"] = TIME
        file["imu/gyro"] = np.stack([TIME, -TIME, 2.0 * TIME], axis=1)
        file["imu/rate_hz"] = 100.0
    back = read_columns(tmp_path / "log.h5#imu")
    np.testing.assert_array_equal(back["gyro[2]"], 2.0 * TIME)
    assert set(back) == {"time_s", "gyro[0]", "gyro[1]", "gyro[2]"}


def test_hdf5_says_units_and_what_it_leaves_out(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"], file["angle"], file["gain"] = TIME, TIME, 3.0
        file["angle"].attrs["units"] = "deg"
        file["imu/gyro"] = np.zeros((11, 2))
        file["imu/gyro"].attrs["unit"] = b"rad/s"
        file["camera"] = np.zeros((11, 8, 9), dtype=np.uint8)
        file["other"] = np.zeros(5)
        file["slow/time"], file["slow/volts"] = TIME, TIME  # a clock of its own
    path = tmp_path / "log.h5"
    assert parts_of(path) == ["", "slow"]
    assert set(read_columns(f"{path}#")) == {
        "t", "angle [deg]", "imu.gyro[0] [rad/s]", "imu.gyro[1] [rad/s]"
    }  # fmt: skip
    units = {n: column_of(n).unit for n in read_columns(f"{path}#")}
    assert units == {"t": None, "angle [deg]": "deg",
                     "imu.gyro[0] [rad/s]": "rad/s", "imu.gyro[1] [rad/s]": "rad/s"}  # fmt: skip
    said = "\n".join(left_out_of(f"{path}#"))
    assert "array camera: 8 x 9 numbers a row" in said and "array gain: a single value" in said
    assert "array other: another number of rows" in said
    with h5py.File(path, "r+") as file:
        file["slow/again"] = file["slow"]
    with pytest.raises(ValueError, match=r"log\.h5: .*group 'slow/again' holds itself, or stands"):
        parts_of(path)


def test_matlab_7_3_has_columns_that_lie(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.mat", "w") as file:
        file["t"], file["q"] = TIME[None], np.stack([TIME, -TIME])
        file["run2/t"], file["run2/q"] = TIME[None, :9], TIME[:9, None]
        file["#refs#/a"] = TIME
    assert parts_of(tmp_path / "log.mat") == ["", "run2"]
    back = read_columns(f"{tmp_path}/log.mat#")
    assert set(back) == {"t", "q[0]", "q[1]"}
    np.testing.assert_array_equal(back["q[1]"], -TIME)
    np.testing.assert_array_equal(read_columns(f"{tmp_path}/log.mat#run2")["q"], TIME[:9])


def swing(k, rows=60):
    """A servo that lags behind its goal."""
    goal = np.sin((3.0 + k) * np.arange(rows) / 30.0)
    return goal, np.roll(goal, 3) + 1e-3 * np.random.default_rng(k).normal(size=rows)


def test_demonstrations_of_robomimic(tmp_path, capsys):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        for k in range(3):
            goal, position = swing(k)
            demo = file.create_group(f"data/demo_{k}")
            demo["actions"], demo["dones"] = goal[:, None] * [1, 2], np.zeros(60, np.int64)
            demo["obs/joint_pos"] = position[:, None]
            demo["obs/agentview_image"] = np.zeros((60, 8, 9, 3), dtype=np.uint8)
            demo["next_obs/joint_pos"] = np.roll(position, -1)[:, None]
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 20}})
        file["mask/train"] = np.array([b"demo_0", b"demo_1"])
    assert main(["diagnose", "init", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["actions_0", "actions_1"]
    assert [c.name for c in study.channels] == ["obs_joint_pos"]
    assert [run.name for run in study.runs] == [f"demo_data_demo_{k}" for k in range(3)]
    np.testing.assert_allclose(study.runs[1].time_s, np.arange(60) / 20.0)
    np.testing.assert_array_equal(study.runs[2].command["actions_1"], 2.0 * swing(2)[0])
    np.testing.assert_array_equal(study.runs[2].measured[:, 0], swing(2)[1])
    assert "demo.hdf5#mask" in said and "group next_obs: obs of the next row" in said
    assert "array obs.agentview_image: 8 x 9 x 3 numbers a row" in said


@pytest.mark.parametrize("version", [2, 3])
def test_datasets_of_lerobot(tmp_path, capsys, version):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    names = ["shoulder.pos", "gripper.pos"]
    listed = {"motors": names} if version == 2 else names
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": listed},
        "action": {"dtype": "float32", "shape": [2], "names": listed},
    }
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": features}))
    (tmp_path / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "swing"}\n')
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    tables = []
    for k in range(3):
        goal, position = swing(k)
        tables.append(
            pyarrow.table({
                "observation.state": [[p, g] for p, g in zip(position, goal, strict=True)],
                "action": [[g, 0.5 * g] for g in goal],
                "timestamp": np.arange(60) / 30.0,
                "frame_index": np.arange(60),
                "episode_index": np.full(60, k),
                "index": np.arange(60) + 60 * k,
                "task_index": np.zeros(60, np.int64),
                "image": [{"bytes": b"x", "path": ""}] * 60,
            })
        )  # fmt: skip
    folder = tmp_path / "data" / "chunk-000"
    if version == 2:
        for k, table in enumerate(tables):
            parquet.write_table(table, folder / f"episode_{k:06d}.parquet")
    else:
        parquet.write_table(pyarrow.concat_tables(tables), folder / "file-000.parquet")
    assert main(["diagnose", "init", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    study = load_study(tmp_path)
    assert [c.name for c in study.commands] == ["action_shoulder_pos", "action_gripper_pos"]
    names = ["observation_state_shoulder_pos", "observation_state_gripper_pos"]
    assert [c.name for c in study.channels] == names
    assert len(study.runs) == 3
    assert study.runs[1].name == ("episode_000001" if version == 2 else "file-000_1")
    np.testing.assert_allclose(study.runs[1].time_s, np.arange(60) / 30.0)
    np.testing.assert_array_equal(study.runs[1].command["action_gripper_pos"], 0.5 * swing(1)[0])
    np.testing.assert_array_equal(study.runs[1].measured[:, 0], swing(1)[1])
    assert "column image: struct<bytes: binary, path: string> is no number" in said


def test_rows_that_pandas_numbers_are_dropped(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    days = np.datetime64("1970-01-02") + np.arange(11) * np.timedelta64(100, "ms")
    for index, kept in ((np.arange(11), False), (days, True)):
        table = pyarrow.table({"q": TIME, "__index_level_0__": index})
        parquet.write_table(table, tmp_path / "log.parquet")
        back = read_columns(tmp_path / "log.parquet")
        assert set(back) == {"q", *(["__index_level_0__"] if kept else [])}
        assert len(left_out_of(tmp_path / "log.parquet")) == (not kept)
    np.testing.assert_allclose(back["__index_level_0__"], 86400.0 + DECIMALS)


def test_archives_of_numpy(tmp_path):
    objects = np.array([{"a": 1}] * 11, dtype=object)
    np.savez(tmp_path / "log.npz", t=TIME, q=np.stack([TIME, -TIME], 1), gain=3.0, o=objects,
             label=np.array(["a"] * 11), picture=np.zeros((11, 9, 9)))  # fmt: skip
    back = read_columns(tmp_path / "log.npz")
    assert set(back) == {"t", "q[0]", "q[1]", "label"}
    np.testing.assert_array_equal(back["q[1]"], -TIME)
    said = "\n".join(left_out_of(tmp_path / "log.npz"))
    assert "array o: objects" in said and "array gain" in said and "array picture" in said


def test_sheets_of_excel(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = "run 1"
    sheet.append(["Bench of May"])
    sheet.append([])
    sheet.append(["time_s", "Force [N]", "label", None])
    for k, t in enumerate(DECIMALS.tolist()):  # sheets have 16 digits
        sheet.append([t, None if k == 3 else 2.0 * t, "a"])
    book.create_sheet("notes").append(["nothing", "here"])
    book.save(tmp_path / "log.xlsx")
    assert parts_of(tmp_path / "log.xlsx") == ["run 1"]
    back = read_columns(tmp_path / "log.xlsx")
    np.testing.assert_array_equal(back["time_s"], DECIMALS)
    expected = 2.0 * DECIMALS
    expected[3] = np.nan
    np.testing.assert_array_equal(back["Force [N]"], expected)
    assert back["label"].tolist() == ["a"] * 11


def write_mcap(path, **options):
    """Poses as JSON, one every 0.1 s, beginning at 5 s."""
    writer_of = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        plain = writer_of.CompressionType.NONE
        writer = writer_of.Writer(file, enable_data_crcs=True, compression=plain, **options)
        writer.start()
        schema = writer.register_schema("pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for k, t in enumerate(TIME):
            stamp = 5_000_000_000 + round(1e9 * t)
            pose = {"position": {"x": float(t)}, "q": [1, 0, 0, k], "scan": {"ranges": [0] * 70}}
            data = json.dumps(pose).encode()
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def test_json_messages_of_an_mcap(tmp_path):
    path = write_mcap(tmp_path / "log.mcap")
    back = read_columns(f"{path}#/pose")
    np.testing.assert_array_equal(back["time_s"], DECIMALS)
    np.testing.assert_array_equal(back["position.x"], TIME)
    np.testing.assert_array_equal(back["q[3]"], np.arange(11))
    said = ["log.mcap: field scan.ranges: 70 entries, at most 64 are columns"]
    assert left_out_of(path) == said


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


@pytest.mark.parametrize("lacking", [1, 5, 18, 20])
def test_a_log_that_was_cut_says_so(tmp_path, capsys, lacking):
    """The battery was pulled: pyulog reads a shorter flight and says nothing."""
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog(123_000_000)[:-lacking])
    (said,) = left_out_of(f"{path}#motors")
    assert "ends inside of a record" in said and "the last sample is of 0.900 s" in said
    assert main(["convert", str(path), str(tmp_path / "flight.csv")]) == 0
    assert f"not in it: {said}" in capsys.readouterr().out
    study = STUDY.replace("log.SUFFIX#PART", "flight.ulg#motors")
    study = study.replace("unit: rad,", "unit: rad, column: 'control[0]',")
    (tmp_path / "study.yaml").write_text(study)
    assert said in load_study(tmp_path / "study.yaml").left_out


def test_damaged_rows_of_a_log_do_not_vanish_in_silence(tmp_path, capsys):
    pytest.importorskip("pyulog")
    whole, path = ulog(123_000_000), tmp_path / "flight.ulg"
    path.write_bytes(whole)
    assert left_out_of(path) == []
    for last_record in (bytes([0]), bytes([97])):  # a kind that is none
        path.write_bytes(whole[:-19] + last_record + whole[-18:])
        assert len(read_columns(path)["time_s"]) == 10
        assert any("damaged" in said for said in left_out_of(path))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("chunked", [True, False])
def test_checksums_of_an_mcap_are_held(tmp_path, chunked):
    path = write_mcap(tmp_path / "log.mcap", use_chunking=chunked)
    whole = path.read_bytes()
    assert len(read_columns(path)["time_s"]) == 11
    at = whole.index(b'"x": 0.5')
    for place in (at + 5, len(whole) - 60):  # a message's number; the summary
        damaged = bytearray(whole)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(
            ValueError, match=r"log\.mcap: cannot be read as \.mcap: .*(crc|checksum)"
        ):
            read_columns(path)
    path.write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=r"log\.mcap: cannot be read"):
        read_columns(path)


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


def test_convert_shows_the_tables_of_a_datasets_folder(tmp_path, capsys):
    pq = pytest.importorskip("pyarrow.parquet")
    pa = pytest.importorskip("pyarrow")
    named = {"action": {"dtype": "float32", "shape": [2], "names": ["pan", "lift"]}}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": named}))
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    rows = pa.array([[0.0, 1.0], [2.0, 3.0]], pa.list_(pa.float32(), 2))
    table = pa.table({"action": rows, "timestamp": [0.0, 0.02]})
    for k in range(2):
        pq.write_table(table, tmp_path / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    assert main(["convert", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.count("episode_") == 2 and said.count("action.lift: 1 to 3") == 2


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


def _runs_by_column(lengths):
    """A file as scripts write it: one object for each run, with a list for each column."""
    runs = []
    for number, length in enumerate(lengths):
        time_s = 0.02 * np.arange(length)
        goal = np.sin((2.0 + number) * time_s)
        moved = np.roll(goal, 2) + 1e-3 * np.cos(7.0 * time_s)
        runs.append(
            {
                "kind": "chirp",
                "targets": ["kp", "tau"],
                "actions": goal.tolist(),
                "sensor": {"angle": moved.tolist(), "pose": np.stack([goal, moved], 1).tolist()},
            }
        )
    return {"config": {"action_hz": 50, "limits": [-0.6, 0.6]}, "data": runs}


@pytest.mark.parametrize("lengths", [(150, 30, 30), (150,), (150, 150)])
def test_json_with_a_list_for_each_column_is_a_table_for_each_run(tmp_path, lengths):
    log = _runs_by_column(lengths)
    (tmp_path / "log.json").write_text(json.dumps(log))
    parts = [f"data.{k}" for k in range(len(lengths))]
    assert parts_of(tmp_path / "log.json") == parts
    for part, run in zip(parts, log["data"], strict=True):
        columns = read_columns(tmp_path / f"log.json#{part}")
        np.testing.assert_array_equal(columns["actions"], run["actions"])
        np.testing.assert_array_equal(columns["sensor.pose[1]"], run["sensor"]["angle"])
        assert set(columns["config.action_hz"]) == {50}
        assert set(columns["kind"]) == {"chirp"}
    (said,) = left_out_of(tmp_path / f"log.json#{parts[0]}")
    assert "list targets: another number of rows" in said


def test_json_of_one_run_by_column_and_records_with_vectors(tmp_path):
    run = {"fs": 100.0, "t": TIME.tolist() * 2, "x": [None, *range(21)], "said": ["a"] * 22}
    (tmp_path / "run.json").write_text(json.dumps(run))
    columns = read_columns(tmp_path / "run.json")
    assert list(columns) == ["t", "x", "said", "fs"]
    assert np.isnan(columns["x"][0]) and columns["x"][-1] == 20
    run["x"][3] = [1.0, 2.0]  # rows of several lengths
    (tmp_path / "run.json").write_text(json.dumps(run))
    assert list(read_columns(tmp_path / "run.json")) == ["t", "said", "fs"]
    assert left_out_of(tmp_path / "run.json") == ["run.json: list x: rows of several lengths"]
    # records with vectors of 24 joints, and lists of a robot's numbers, are none of these
    records = [{"q": [float(k)] * 24, "dq": [0.0] * 24} for k in range(30)]
    facts = {"home": [0.1] * 7, "limits": [1.0] * 7}
    (tmp_path / "arm.json").write_text(json.dumps({"robot": facts, "steps": records}))
    assert parts_of(tmp_path / "arm.json") == ["steps"]
    assert len(read_columns(tmp_path / "arm.json")) == 48


@pytest.mark.parametrize(
    ("config", "step"),
    [
        ({"action_hz": 50}, 0.02),
        ({"sample_rate": 250.0}, 0.004),
        ({"dt": 0.02}, 0.02),
        ({"sampling_time_ms": 5}, 0.005),
        ({"gain": 50}, None),
    ],
)
def test_a_rate_that_the_file_states_is_the_clock(tmp_path, capsys, config, step):
    log = _runs_by_column((150, 90, 60)) | {"config": config}
    (tmp_path / "log.json").write_text(json.dumps(log))
    assert main(["diagnose", "init", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert ("time.step" in (tmp_path / "study.yaml").read_text().partition("todo:")[2]) == (
        step is None
    ), said
    study = load_study(tmp_path / "study.yaml")
    assert len(study.runs) == 3
    assert "actions" in study.runs[0].command
    np.testing.assert_allclose(np.diff(study.runs[0].time_s), step or 0.01, rtol=1e-9)


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


def test_messages_in_blocks_are_the_columns_of_all(monkeypatch):
    """Read at once, 400,000 messages of 62 numbers took more than 2.5 GB."""
    from diffsim.data.formats import columns

    messages = [{"q": k, "w": [0.5 * k, 1]} for k in range(7)]
    messages += [{"q": k, "said": f"m{k}"} for k in range(7, 12)]
    messages += [{"said": k, "late": {"x": 1.5}} for k in range(3)]
    whole = columns.of_messages(messages)
    assert whole["q"].dtype.kind == "f" and whole["said"].tolist()[6:8] == ["", "m7"]
    monkeypatch.setattr(columns, "_BLOCK", 4)
    parts = columns.of_messages(iter(messages))
    assert list(parts) == list(whole)
    for name, values in whole.items():
        np.testing.assert_array_equal(parts[name], values)
        assert parts[name].dtype.kind == values.dtype.kind


def test_a_row_of_units_below_the_names_of_a_sheet(tmp_path):
    """Names were [s], [bar]; two columns of one unit were refused as having one name."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Zeit", "Druck", "Gegendruck"], ["[s]", "(bar)", "(bar)"], [], [0, 1.5, 1.0]):
        book.active.append(row)
    book.active.append([0.1, 1.6, 1.0])
    book.create_sheet("Info").append(["Masse [kg]", 180])
    book.save(tmp_path / "run.xlsx")
    found = read_columns(tmp_path / "run.xlsx")
    assert list(found) == ["Zeit [s]", "Druck [bar]", "Gegendruck [bar]"]
    assert left_out_of(tmp_path / "run.xlsx") == ["run.xlsx: sheet Info: no table"]


@pytest.mark.parametrize("units", [[], [["s", "bar"]]])
def test_a_first_row_of_a_sheet_with_one_number_is_a_row(tmp_path, units):
    """It was left out without a word, and units were taken for the names."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["Zeit", "Druck"], *units, [0, None], [0.1, 1.6], [0.2, 1.7]):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    found = read_columns(tmp_path / "run.xlsx")
    assert list(found) == (["Zeit [s]", "Druck [bar]"] if units else ["Zeit", "Druck"])
    np.testing.assert_array_equal([*found.values()], [[0.0, 0.1, 0.2], [np.nan, 1.6, 1.7]])


def test_a_struct_with_time_of_simulink_has_a_column_for_each_signal(tmp_path):
    """Its signals were left out as no table."""
    kinds = [(name, object) for name in ("values", "dimensions", "label", "blockName")]
    signals = np.empty((1, 3), dtype=kinds)
    for k, (label, block) in enumerate((("theta", "m/a"), ("", "m/current"), ("theta", "m/b"))):
        signals[0, k] = (np.arange(4.0)[:, None] * k, 1.0, label, block)
    scope = {"time": 0.1 * np.arange(4.0)[:, None], "signals": signals, "blockName": "m/Scope"}
    scipy.io.savemat(tmp_path / "run.mat", {"Scope": scope})
    found = read_columns(tmp_path / "run.mat#Scope")
    assert list(found) == ["time", "theta", "current", "theta_3"]
    assert found["current"].tolist() == [0.0, 1.0, 2.0, 3.0]
