"""One recording written as several programs would write it: one study, one set of numbers."""

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.data.table import Table, read_numbers
from diffsim.data.table_guess import layout_of

T = 0.01 * np.arange(60)
COLUMNS = {
    "time_s": T,
    "angle (deg)": 40.0 * np.sin(5.0 * T) + 0.01 * np.cos(700.0 * T),
    "duty": np.sign(np.sin(9.0 * T)),
}
LINES = [
    ",".join(COLUMNS),
    *(",".join(f"{v:.6f}" for v in row) for row in zip(*COLUMNS.values(), strict=True)),
]
WAYS = {
    "commas at the ends": lambda lines: "\n".join(f"{line}," for line in lines),
    "ends of lines of Windows": lambda lines: "\r\n".join(lines) + "\r\n",
    "a mark of bytes before": lambda lines: "\ufeff" + "\n".join(lines),
    "semicolons": lambda lines: "\n".join(line.replace(",", ";") for line in lines),
    "tabs": lambda lines: "\n".join(line.replace(",", "\t") for line in lines),
    "commas in numbers": lambda lines: "\n".join(
        line.replace(",", ";").replace(".", ",") for line in lines
    ),
    "quotes": lambda lines: "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in lines
    ),
    "blanks": lambda lines: "\n".join(line.replace(",", ", ") for line in lines),
    "rows that pandas numbers": lambda lines: "\n".join(
        [f",{lines[0]}", *(f"{k},{line}" for k, line in enumerate(lines[1:]))]
    ),
    "remarks with as many cells": lambda lines: "\n".join(
        [*lines[:30], "# off, on, again", *lines[30:], "# end"]
    ),
    "empty lines at the end": lambda lines: "\n".join(lines) + "\n\n\n",
}


def study_of(folder, text):
    for name in "ab":
        (folder / f"{name}.csv").write_text(text, "utf-8", newline="")
    assert main(["diagnose", "init", str(folder), "--out", str(folder / "study.yaml")]) == 0
    return (folder / "study.yaml").read_text("utf-8").splitlines()


@pytest.mark.parametrize("way", WAYS)
def test_one_recording_written_in_another_way_is_the_same(tmp_path, way):
    folders = [tmp_path / name / "records" for name in ("usual", "other")]
    studies = []
    for folder, text in zip(folders, ("\n".join(LINES), WAYS[way](LINES)), strict=True):
        folder.mkdir(parents=True)
        studies.append(study_of(folder, text))
    assert studies[0] == studies[1]
    numbers = read_numbers(folders[1] / "a.csv", list(COLUMNS))
    for name, wanted in COLUMNS.items():
        np.testing.assert_allclose(numbers[name], wanted, atol=1e-6)


@pytest.mark.parametrize("cells", [("#1", "#2"), ("#1", "right"), ("0.5", "#N/A"), ("#N/A", "2.5")])
def test_rows_whose_first_cell_is_no_remark_are_kept(tmp_path, cells):
    """Names of wells, and what Excel writes where a value is missing."""
    path = tmp_path / "a.csv"
    rows = (f"{cell},{t}" for t, cell in enumerate(cells))
    path.write_text("\n".join(["well,time_s", *rows]), "utf-8")
    np.testing.assert_array_equal(read_numbers(path, ["time_s"])["time_s"], [0.0, 1.0])


@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
@pytest.mark.parametrize("below", ["# calibrated on Monday", "", "# restart{mark} gain{mark} 2"])
def test_a_remark_below_the_names_is_neither_names_nor_a_sample(tmp_path, mark, below):
    path = tmp_path / "a.csv"
    rows = [mark.join([f"{0.1 * k:.1f}", "2", "3"]) for k in range(8)]
    names = mark.join(["time_s", "x_mm", "force_N"])
    path.write_text("\n".join([names, below.format(mark=mark), *rows]), "utf-8")
    found = layout_of(path)
    assert found is not None and (found.header_line, found.first_line) == (1, 3)
    assert [c.name for c in found.columns] == ["time_s", "x_mm", "force_N"]
    table = Table(path, "run")
    assert table.header == ["time_s", "x_mm", "force_N"]
    np.testing.assert_allclose(table.numbers("time_s"), 0.1 * np.arange(8))


def test_a_header_above_rows_with_missing_values_is_found(tmp_path):
    """As exports of PX4 have them, where most of twelve motors are not there."""
    path = tmp_path / "a.csv"
    path.write_text("t,a,b,c,d\n" + "".join(f"{k},0.5,nan,nan,nan\n" for k in range(9)), "utf-8")
    found = layout_of(path)
    assert found is not None and len(found.columns) == 5 and found.has_names


def test_a_file_is_read_once_as_long_as_a_table_has_it(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_text("t,a\n" + "".join(f"{k},{2 * k}\n\n" for k in range(9)), "utf-8")
    first = Table(path, "run")
    monkeypatch.setattr("diffsim.data.table.np.loadtxt", lambda *_, **__: pytest.fail("read again"))
    second = Table(path, "run")
    np.testing.assert_array_equal(second.numbers("a"), first.numbers("a"))
    assert list(second.lines) == list(range(2, 20, 2))
    monkeypatch.undo()
    path.write_text("t,a\n0,7\n", "utf-8")
    assert Table(path, "run").numbers("a").tolist() == [7.0]


def test_many_rows_are_read_block_by_block(tmp_path, monkeypatch):
    monkeypatch.setattr("diffsim.data.table.ROWS_SHOWN", 7)
    path = tmp_path / "a.csv"
    path.write_text("t,a\n" + "".join(f"{k},{-k}\n" for k in range(40)), "utf-8")
    table = Table(path, "run")
    np.testing.assert_array_equal(table.numbers("a"), -np.arange(40.0))
    assert list(table.lines) == list(range(2, 42))
