"""Folders as instruments and programs of laboratories write them."""

import numpy as np
import pytest
import yaml

from diffsim.cli import main
from diffsim.core.units import to_si
from diffsim.data.table import Table
from diffsim.data.table_guess import column_of, layout_of

T = 0.02 * np.arange(150)
SWING = 0.1 * np.exp(-0.2 * T) * np.cos(5.0 * T) + 1e-4 * np.cos(900.0 * T)

LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t.
Time\t10:11:12.1234567890
***End_of_Header***\t

Channels\t2\t
Samples\t150\t150\t
Delta_X\t0.020000\t0.020000\t
***End_of_Header***\t\t\t
X_Value\tPosition\tForce\tComment
"""
MOTIVE = """Format Version,1.23,Take Name,Take 1,Capture Frame Rate,50.000000,Length Units,Meters

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,Name,bob,bob,bob,bob
,ID,1,1,1,1
,,Rotation,Rotation,Position,Position
Frame,Time (Seconds),X,Y,X,Y
"""
POSES = "scorer,net,net,net\nbodyparts,tip,tip,tip\ncoords,x,y,likelihood\n"


def init(folder, name, text):
    """The study that init writes for a folder of two such files."""
    for k in "ab":
        (folder / f"{k}{name}").write_text(text, "utf-8")
    assert main(["diagnose", "init", str(folder), "--system", "ode"]) == 0
    return yaml.safe_load((folder / "study.yaml").read_text("utf-8"))


def test_comments_that_labview_names_and_does_not_write_are_no_column(tmp_path):
    rows = "".join(f"{t:.6f}\t{x:.6f}\t{np.sin(t):.6f}\n" for t, x in zip(T, SWING, strict=True))
    found = init(tmp_path, ".lvm", LABVIEW + rows)
    assert found["time"] == {"column": "X_Value", "unit": "s"}
    assert [c["name"] for c in found["channels"]] == ["Position", "Force"]


def test_numbers_of_bodies_above_their_axes_are_no_sample(tmp_path):
    rows = "".join(
        f"{k},{t:.6f},{x:.6f},{np.sin(x):.6f},{x:.6f},{x * x:.6f}\n"
        for k, (t, x) in enumerate(zip(T, SWING, strict=True))
    )
    found = init(tmp_path, ".csv", MOTIVE + rows)
    assert found["time"]["column"] == "Time (Seconds)"
    names = {c["name"] for c in found["channels"]}
    assert names == {"Rotation_X", "Rotation_Y", "Position_X", "Position_Y"}


def test_frames_of_a_film_are_no_milliseconds(tmp_path):
    rows = "".join(f"{k},{300 + 800 * x:.3f},{200 + x:.3f},0.99\n" for k, x in enumerate(SWING))
    found = init(tmp_path, ".csv", POSES + rows)
    assert found["time"] == {"column": "coords", "step": 0.01}
    assert any(said.startswith("time.step") for said in found["todo"])


def test_durations_of_a_timetable_are_a_clock(tmp_path):
    rows = "".join(f"{t:.2f} sec,{x:.6f}\n" for t, x in zip(T, SWING, strict=True))
    found = init(tmp_path, ".csv", "Time,Position\n" + rows)
    assert found["time"] == {"column": "Time", "unit": "clock"}
    seconds = Table(tmp_path / "a.csv", "run").seconds("Time", None, None)
    np.testing.assert_allclose(seconds, T, atol=1e-12)


def test_sequence_numbers_of_a_message_are_no_channel(tmp_path):
    """As rostopic echo -p writes them."""
    head = "%time,field.header.seq,field.header.stamp,field.position0\n"
    for k in range(2):
        stamps = [1_700_000_000_000_000_000 + k * 10**12 + round(1e9 * t) for t in T]
        rows = (
            f"{s},{i},{s},{x:.6f}\n" for i, (s, x) in enumerate(zip(stamps, SWING, strict=True))
        )
        (tmp_path / f"joint_{k}.csv").write_text(head + "".join(rows), "utf-8")
    assert main(["diagnose", "init", str(tmp_path), "--system", "ode"]) == 0
    found = yaml.safe_load((tmp_path / "study.yaml").read_text("utf-8"))
    assert [c["name"] for c in found["channels"]] == ["field_position0"]


SIDE_BY_SIDE = {
    "pendulum.csv": "Data Set {0}: Time (s),Data Set {0}: Position (m)",
    "cart.txt": "Time (s) Run #{0}\tPosition (m) Run #{0}",
}


@pytest.mark.parametrize("name", SIDE_BY_SIDE)
def test_runs_side_by_side_are_runs(tmp_path, name):
    """As teaching laboratories export them: the first run was the command of the second."""
    mark = "," if name.endswith("csv") else "\t"
    header = mark.join(SIDE_BY_SIDE[name].format(k) for k in (1, 2))
    lines = [header]
    for k, (t, x) in enumerate(zip(T, SWING, strict=True)):
        second = [f"{t:.2f}", f"{2 * x:.5f}"] if k < 120 else ["", ""]
        lines.append(mark.join([f"{t:.2f}", f"{x:.5f}", *second]))
    (tmp_path / name).write_text("\n".join(lines), "utf-8")
    assert main(["diagnose", "init", str(tmp_path), "--system", "ode"]) == 0
    found = yaml.safe_load((tmp_path / "study.yaml").read_text("utf-8"))
    assert found["commands"] == [] and [c["unit"] for c in found["channels"]] == ["m"]
    tables = [Table(tmp_path / run["file"], "run") for run in found["runs"]]
    assert [len(table) for table in tables] == [150, 120]
    np.testing.assert_allclose(tables[1].numbers("Position (m)"), 2 * SWING[:120], atol=1e-5)
    with pytest.raises(ValueError, match=r"no run 'Run 9'; it holds (Data Set 1|Run #1), "):
        Table(tmp_path / f"{name}#Run 9", "run")


def test_a_mark_in_the_name_of_a_file_is_no_part(tmp_path):
    (tmp_path / "Run #1.csv").write_text("time_s,x\n0,1\n", "utf-8")
    assert len(Table(tmp_path / "Run #1.csv", "run")) == 1


def test_channels_that_an_oscilloscope_numbers_have_their_units(tmp_path):
    rows = "".join(f"{t:+.6E},{x:+.6E},{x * x:+.6E}\n" for t, x in zip(T, SWING, strict=True))
    found = init(tmp_path, ".csv", "x-axis,1,2\nsecond,Volt,Volt\n" + rows)
    assert found["time"] == {"column": "x-axis", "unit": "second"}
    both = [*found["channels"], *found["commands"]]
    assert {c["column"]: c["unit"] for c in both} == {"1": "Volt", "2": "Volt"}


def test_marks_of_thousands_are_told_and_loops_counted_are_no_command(tmp_path, capsys):
    rows = "".join(
        f"{16 * k};{t:.2f};{9000 + 500 * x:,.1f}\n".replace(",", "'").replace(".", ",")
        for k, (t, x) in enumerate(zip(T, SWING, strict=True))
    ).replace("'", ".")
    init(tmp_path, ".csv", "loopIteration;Zeit [s];Weg [mm];x\n" + rows.replace("\n", ";1,5\n"))
    said = capsys.readouterr().out
    assert "cannot be read, not used" in said and "leave marks of thousands out" in said
    assert "counters and flags, not used (see missing_if): loopIteration" in said


@pytest.mark.parametrize(
    ("lines", "time", "channels"),
    [  # what stands above, or as the second row: names and the first rows are read all the same
        (["Rate,100,Hz", "t,V,A", "0,1,2"], "t", {"V", "A"}),
        (["time_s,volt,amp", "0,1.5,2", "0.02,OL,OL"], "time_s", {"volt", "amp"}),
        (["time_s,volt,amp", "0,1.5,2", "OK"], "time_s", {"volt", "amp"}),
        (["time_s,volt,amp", "0,1.5,2", ",,"], "time_s", {"volt", "amp"}),
        (["time_s,volt,amp", "0,1.5,2", "slow,fast,none"], "time_s", {"volt", "amp"}),
    ],
)
def test_an_odd_row_above_or_below_the_first_moves_no_header(tmp_path, lines, time, channels):
    rows = [f"{t + 0.1:.2f},{x:.5f},{x * x:.6f}" for t, x in zip(T, SWING, strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([*lines, *rows]), "utf-8")
    found = layout_of(path)
    assert found is not None and found.has_names
    assert {c.name for c in found.columns} == {time, *channels}


def test_units_and_commands_of_runs_side_by_side_are_kept(tmp_path):
    header = "Run 1: Time,Run 1: Position,Run 2: Time,Run 2: Position,Motor command (V)"
    rows = (
        f"{1e3 * t:.0f},{100 * x:.4f},{1e3 * t:.0f},{50 * x:.4f},{np.sign(np.sin(9 * t)):.0f}"
        for t, x in zip(T, SWING, strict=True)
    )
    folder = tmp_path / "rig #3"
    folder.mkdir()
    (folder / "a.csv").write_text("\n".join([header, "ms,cm,ms,cm,", *rows]), "utf-8")
    assert main(["diagnose", "init", str(folder), "--system", "ode"]) == 0
    found = yaml.safe_load((folder / "study.yaml").read_text("utf-8"))
    assert found["time"]["unit"] == "ms" and [c["unit"] for c in found["channels"]] == ["cm"]
    assert [c["name"] for c in found["commands"]] == ["Motor_command"]


def test_comments_that_labview_writes_end_no_table(tmp_path):
    rows = [f"{t:.6f}\t{x:.6f}\t{np.sin(t):.6f}" for t, x in zip(T, SWING, strict=True)]
    rows[0] += "\tstart"
    rows[40] += "\tstep"
    found = init(tmp_path, ".lvm", LABVIEW + "\n".join(rows))
    assert [c["name"] for c in found["channels"]] == ["Position", "Force"]
    assert len(Table(tmp_path / "a.lvm", "run", **found["table"])) == len(T)


def test_a_label_that_looks_like_a_unit_is_none():
    names = ["Voltage A-B", "Signal pk-pk", "Temp deg-C", "Sensor S-1", "Heater H-1", "n_beats"]
    assert [column_of(name).unit for name in names] == [None] * len(names)
    assert to_si(column_of("SPEED (RAD/S)").unit).unit == "rad/s"
    assert column_of("flow speed [1/min]").unit == "1/min"


@pytest.mark.parametrize("mark", [" ", ";"])
def test_lines_of_blanks_and_form_feeds_are_no_rows(tmp_path, mark):
    rows = [mark.join(["0", "1"]), "\t", mark.join(["1", "2"]), mark.join(["2", "3"]), ""]
    (tmp_path / "a.csv").write_text("\n".join([mark.join("tx"), *rows]), "utf-8")
    table = Table(tmp_path / "a.csv", "run")
    assert len(table) == len(table.numbers("t")) == 3


def test_durations_may_be_missing(tmp_path):
    (tmp_path / "a.csv").write_text("Time,x\n0 sec,1\n,2\nNaN sec,3\n0.04 sec,4\n", "utf-8")
    seconds = Table(tmp_path / "a.csv", "run").dates("Time")
    np.testing.assert_array_equal(seconds, [0.0, np.nan, np.nan, 0.04])
