"""Study files: round trip, and messages that name file, row and column."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

import diffsim.data.study_save as study_save
from diffsim.data import Channel, Command, Run, Study, load_study, save_study
from diffsim.data.study_schema import ChannelEntry, CommandEntry
from diffsim.systems.description import quantity
from diffsim.systems.registry import setup_of


def make_study() -> Study:
    rng = np.random.default_rng(0)
    t = np.arange(25) / 30.0  # not exact in decimal
    runs = []
    for order, (name, group) in enumerate([("a", "up"), ("b", "up"), ("c", "down"), ("d", "new")]):
        measured = rng.normal(size=(25, 2))
        measured[3, 1] = np.nan
        level = {"up": t, "down": 1.0 - t, "new": t**2}[group]
        use = "test" if name == "d" else "fit"
        run = Run(
            name, t, measured, {"tendon_N": level}, group, order, use, {"temperature_C": 22.5}
        )
        runs.append(replace(run, row_s=0.01) if name == "b" else run)
    channels = (
        Channel("tip_z_m", "m", "position", 3e-6),
        Channel("rate_rad_s", "rad/s", "angular_velocity"),
    )
    return Study("beam", "soft_body", channels, tuple(runs), {"geometry": {"length_m": 0.1}})


@pytest.fixture
def folder(tmp_path):
    save_study(make_study(), tmp_path / "beam")
    return tmp_path / "beam"


def test_round_trip_is_exact(folder):
    before, after = make_study(), load_study(folder / "study.yaml")
    assert (after.name, after.system, after.channels) == ("beam", "soft_body", before.channels)
    assert after.metadata == before.metadata
    for a, b in zip(before.runs, after.runs, strict=True):
        assert (a.name, a.group, a.order, a.use, a.setup, a.row_s) == (
            b.name, b.group, b.order, b.use, b.setup, b.row_s
        )  # fmt: skip
        np.testing.assert_array_equal(a.time_s, b.time_s)
        np.testing.assert_array_equal(a.measured, b.measured)  # NaN included
        np.testing.assert_array_equal(a.command["tendon_N"], b.command["tendon_N"])


def test_what_was_commanded_before_is_kept_and_only_where_it_acts(tmp_path):
    text = """
name: rig
model: {system: SYSTEM}
channels: [{name: x, unit: mm}]
commands: [{name: u, unit: mV, before: -250}]
runs: [{name: a, file: a.csv}]
time: {column: t}
"""
    (tmp_path / "a.csv").write_text("t,x,u\n0,0,1\n1,1,1\n2,1,1\n")
    (tmp_path / "study.yaml").write_text(text.replace("SYSTEM", "ode"))
    study = load_study(tmp_path / "study.yaml", strict=False)
    assert study.commands[0].before == -0.25
    again = load_study(save_study(study, tmp_path / "saved"), strict=False)
    assert again.commands[0].before == -0.25
    rod = load_study(Path(__file__).parents[1] / "studies" / "rod_in_time")
    name = next(iter(rod.runs[0].command))
    stated = replace(rod, commands=(Command(name, before=1.0),))
    with pytest.raises(ValueError, match=f"before of {name}: system rod takes the first value"):
        setup_of(stated)


def test_a_missing_value_is_an_empty_cell(folder):
    lines = (folder / "a.csv").read_text().splitlines()
    assert lines[0] == "time_s,tip_z_m,rate_rad_s,tendon_N"
    assert lines[4].split(",")[2] == ""


def change(folder, file, old, new):
    path = folder / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "a.csv",
            "tip_z_m",
            "tip_z_mm",
            r"a\.csv: column tip_z_m is missing; did you mean 'tip_z_mm'",
        ),
        ("a.csv", "time_s", "time_ms", r"a\.csv: column time_s is missing; column 'time_ms' looks"),
        (
            "study.yaml",
            "use: fit",
            "use: fitt",
            r"runs\[0\]\.use: must be one of .* mean 'fit'",
        ),
        (
            "study.yaml",
            "group: up",
            "gruop: up",
            r"yaml: runs\[0\]: no key 'gruop' here; did you mean 'group'",
        ),
        ("study.yaml", "file: b.csv", "file: bb.csv", r"bb\.csv: no such run.*you mean 'b\.csv'"),
        (
            "study.yaml",
            "sd: 3.0e-06",
            "sd: -1",
            r"channels\[0\]\.sd: must be above 0, got -1",
        ),
        (
            "study.yaml",
            "temperature_C: 22.5",
            "temperature_C: yes",
            r"yaml: runs\[0\]\.setup\.temperature_C must be",
        ),
        ("study.yaml", "order: 0", "order: 0.5", r"yaml: runs\[0\]\.order: must be a whole number"),
        ("study.yaml", "unit: m\n", "shown_unit: m\n", r"yaml: channels\[0\]\.unit: is missing"),
        ("study.yaml", "runs:", "runs: {", "not YAML"),
    ],
)
def test_errors_name_the_place(folder, file, old, new, message):
    change(folder, file, old, new)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_study(folder)


def with_cell(folder, row, column, text):
    path = folder / "c.csv"
    lines = [line.split(",") for line in path.read_text().splitlines()]
    lines[row - 1][column] = text
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")


@pytest.mark.parametrize(
    ("row", "column", "text", "message"),
    [
        (7, 1, "abc", r"c\.csv, row 7, column tip_z_m: 'abc' is not a number"),
        (7, 3, "inf", r"c\.csv, row 7, column tendon_N: 'inf' is not a finite number"),
        (9, 0, "0.0", r"c\.csv, row 9, column time_s: time must increase"),
        (9, 0, "", r"c\.csv, row 9, column time_s: time is missing"),
        (5, 2, "1,5", r"c\.csv, row 5: 5 cells, but the header has 4"),
    ],
)
def test_bad_cells_name_row_and_column(folder, row, column, text, message):
    with_cell(folder, row, column, text)
    with pytest.raises(ValueError, match=message):
        load_study(folder)


def test_an_sd_without_a_point_is_read(folder):
    change(folder, "study.yaml", "sd: 3.0e-06", "sd: 3e-6")  # YAML 1.1 takes this for text
    assert load_study(folder).channels[0].sd == 3e-6


def test_existing_folders_are_not_replaced_by_accident(folder, tmp_path):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        save_study(make_study(), folder)
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.txt").write_text("years of work")
    with pytest.raises(FileExistsError, match="holds no study"):
        save_study(make_study(), other, overwrite=True)
    save_study(replace(make_study(), name="new"), folder, overwrite=True)
    assert load_study(folder).name == "new"
    assert {p.name for p in tmp_path.iterdir()} == {"beam", "thesis"}  # no temporary left


def test_an_interrupted_save_leaves_the_old_study(folder, tmp_path, monkeypatch):
    written = []

    def fail_late(path, text):
        written.append(path)
        if len(written) == 3:
            raise KeyboardInterrupt
        path.write_text(text)

    monkeypatch.setattr(study_save, "write_text_atomic", fail_late)
    with pytest.raises(KeyboardInterrupt):
        save_study(replace(make_study(), name="new"), folder, overwrite=True)
    assert len(written) == 3
    assert load_study(folder).name == "beam"
    assert [p.name for p in tmp_path.iterdir()] == ["beam"]


def test_a_run_name_that_is_a_path_is_refused(tmp_path):
    study = make_study()
    bad = replace(study, runs=(replace(study.runs[0], name="../up"),))
    with pytest.raises(ValueError, match=re.escape("'../up' cannot be a file name")):
        save_study(bad, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_missing_recording_of_a_set_with_a_maker_says_how_it_is_made(folder):
    (folder / "make_csv.py").write_text("")
    (folder / "b.csv").unlink()
    with pytest.raises(ValueError, match=r"made by `python .*make_csv\.py`"):
        load_study(folder)


@pytest.mark.parametrize(
    ("entry", "key", "given", "read"),
    [
        ({"name": "x", "unit": "mm"}, "sd", "0.2 cm", 2.0),
        ({"name": "T", "unit": "degC"}, "sd", "0.5 K", 0.5),
        ({"name": "x", "unit": "mm"}, "sd", "3e-1", 0.3),
        ({"name": "F", "unit": "N"}, "lower", "-0.005 kN", -5.0),
        ({"name": "T", "unit": "degC"}, "upper", "300 K", 26.85),
        ({"name": "F", "unit": "N"}, "rate", "2 kN/s", 2000.0),
    ],
)
def test_numbers_of_entries_may_have_a_unit_of_their_own(entry, key, given, read):
    kind = ChannelEntry if key == "sd" else CommandEntry
    assert getattr(kind.model_validate({**entry, key: given}), key) == pytest.approx(read)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"name": "x", "unit": "mm", "lower": "2 deg"}, "lower: unit 'deg' is no unit"),
        ({"name": "x", "lower": "2 mm"}, "lower is '2 mm'; state `unit`"),
        ({"name": "x", "unit": "mm", "lower": "low"}, "must be a number, got 'low'"),
    ],
)
def test_units_that_do_not_fit_are_refused(entry, message):
    with pytest.raises(ValueError, match=message):
        CommandEntry.model_validate(entry)


def test_a_temperature_of_a_description_is_one_and_its_width_a_difference():
    room = TypeAdapter(quantity("K")).validate_python({"value": "22 degC", "sd": "2 degC"})
    assert (room.value, room.sd) == (pytest.approx(295.15), 2.0)
