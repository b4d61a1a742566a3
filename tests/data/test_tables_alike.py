"""One recording written as several programs would write it: one study, one set of numbers."""

import numpy as np
import pytest

from diffsim.cli import main
from diffsim.data import table as table_module
from diffsim.data.table import MISSING, Table, read_numbers
from diffsim.data.table_guess import column_of, layout_of

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


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("seed", range(4))
def test_gaps_and_decimal_commas_are_read_alike_at_once_and_cell_by_cell(
    tmp_path, monkeypatch, mark, seed
):
    """Missing readings are rare in long recordings: these need not be read cell by cell."""
    rng = np.random.default_rng(seed)
    point = "," if mark != "," and seed % 2 else "."
    gaps = ["", " ", *MISSING, "  NaN "]
    cells = [
        [
            f"{x:.3g}".replace(".", point) if keep else gaps[k]
            for x, keep, k in zip(*row, strict=True)
        ]
        for row in zip(
            rng.normal(0.0, 50.0, (60, 4)),
            rng.random((60, 4)) < 0.8,
            rng.integers(len(gaps), size=(60, 4)),
            strict=True,
        )
    ]
    end = "\r\n" if seed > 1 else "\n"
    lines = ["t", *"abc"], *cells[:30], ["", " ", "", ""], *cells[30:]
    path = tmp_path / "a.csv"
    path.write_text(end.join(mark.join(row) for row in lines), "utf-8", newline="")
    with monkeypatch.context() as patch:
        patch.setattr(table_module, "_all_cells_of", lambda *_: pytest.fail("cell by cell"))
        table = Table(path, "run")
    monkeypatch.setattr(table_module, "_all_numbers_of", lambda *_: None)
    other = Table(path, "run")
    assert list(table.lines) == list(other.lines)
    assert table.is_number == other.is_number
    for name in "tabc":
        np.testing.assert_array_equal(table.numbers(name), other.numbers(name))


@pytest.mark.parametrize("cell", ["1,", ",", "1,234.5", "1_0", "1;2", "x", "inf"])
def test_what_is_no_number_is_told_beside_gaps(tmp_path, cell):
    path = tmp_path / "a.csv"
    path.write_text(f"t;a\n0;1,5\n1;\n2;{cell}\n", "utf-8")
    with pytest.raises(ValueError, match="row 4"):
        Table(path, "run").numbers("a")


def test_recordings_are_not_asked_for_names_of_runs(tmp_path, monkeypatch):
    """They are numbers: to read them cell by cell takes eight times as long."""
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text("\n".join(LINES), "utf-8")
    monkeypatch.setattr(table_module, "_all_cells_of", lambda *_: pytest.fail("cell by cell"))
    assert main(["diagnose", "init", str(tmp_path), "--system", "ode"]) == 0


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("Drehzahl [1/min]", "rpm"),
        ("n_1 [min-1]", "rpm"),
        ("breaths [1/min]", "1/min"),
        ("speed (m/sec)", "m/sec"),
    ],
)
def test_a_speed_in_one_a_minute_counts_turns(header, unit):
    assert column_of(header).unit == unit
