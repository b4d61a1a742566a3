"""Hostile cells of a record: each is named with its place, or read without a word from below."""

import shutil
import warnings

import numpy as np
import pytest

from diffsim.cli import main
from labs.records.rigs import joint

ROWS = 121
ALL = range(1, ROWS)
NUMBER = "'{}' is not a number"
EMPTY = "nothing was measured in this run"
HUGE = "has values beyond 1e+150"
STUCK = "in all 120 samples"
CELLS = {
    "nan": ([5, 6], 2, "nan", None),
    "null": ([5, 9], 2, "null", None),
    "inf": ([5], 2, "inf", "row 6, column angle_deg: 'inf' is not a finite number"),
    "-inf": ([5], 1, "-Infinity", "row 6, column goal_deg: '-Infinity' is not a finite number"),
    "huge": ([5], 2, "1e308", HUGE),
    "all huge": (ALL, 2, "-1e308", HUGE),
    "huge command": ([7], 1, "1e308", HUGE),
    "tiny": (ALL, 2, "1e-320", STUCK),
    "stuck": (ALL, 2, "3.5", STUCK),
    "empty": (ALL, 2, "", EMPTY),
    "empty command": (ALL, 1, "", "say what they mean by `fill`"),
    "text": ([5], 2, "abc", NUMBER.format("abc")),
    "all text": (ALL, 2, "True", NUMBER.format("True")),
    "hex": ([5], 2, "0x1F", NUMBER.format("0x1F")),
    "nul": ([5], 2, "\x00", NUMBER.format("\\x00")),
    "far clock": ([ROWS - 1], 0, "1e308", "`stamps: {jumps: close}`"),
    "one stamp": (ALL, 0, "0", "`duplicates: first`"),
    "no stamp": (ALL, 0, "", "time is missing"),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = joint(np.random.default_rng(2)).write(tmp_path_factory.mktemp("hostile") / "rig")
    lines = (folder / "a.csv").read_text().splitlines()
    (folder / "a.csv").write_text("\n".join(lines[:ROWS]) + "\n")
    return folder


def ran(capsys, *args):
    """Exit code and all that was said; warnings of libraries are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        code = main(["diagnose", *map(str, args)])
    said = capsys.readouterr()
    return code, said.out + said.err


@pytest.mark.parametrize("name", CELLS)
def test_hostile_cells_are_named_with_their_place(sound, tmp_path, capsys, name):
    rows, column, text, says = CELLS[name]
    folder = shutil.copytree(sound, tmp_path / "rig")
    cells = [line.split(",") for line in (folder / "a.csv").read_text().splitlines()]
    for row in rows:
        cells[row][column] = text
    (folder / "a.csv").write_text("\n".join(",".join(row) for row in cells) + "\n")
    code, said = ran(capsys, "check", folder)
    assert code == (2 if says else 0) and (says or "ready for a diagnosis") in said, said
    raw = tmp_path / "raw"
    raw.mkdir()
    for path in folder.glob("*.csv"):
        shutil.copy(path, raw)
    code, told = ran(capsys, "init", raw, "--out", raw / "study.yaml")
    assert code in (0, 2) and "diffsim" in told
    if says:  # else it is diagnosed
        code, again = ran(capsys, "explain", folder, "--quick", "--out", tmp_path / "out")
        assert says in again and ("verdict: record" in again) == (code == 0)


@pytest.mark.parametrize("text", ["", "time_s,goal_deg,angle_deg\n", "time_s,goal_deg\n0,1\n"])
def test_files_without_rows_or_columns_are_refused_in_a_sentence(sound, tmp_path, capsys, text):
    folder = shutil.copytree(sound, tmp_path / "rig")
    (folder / "a.csv").write_text(text)
    code, said = ran(capsys, "check", folder)
    assert code == 2 and "a.csv" in said
