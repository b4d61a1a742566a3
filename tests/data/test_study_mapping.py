"""A stranger's files: any column, unit, delimiter and lay-out, mapped by ``study.yaml`` alone."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffsim.data import load_study, save_study
from diffsim.data.run_plan import _words_of

T = np.arange(40) * 10.0  # ms
HEADER = ["t (ms)", "pos (mm)", "right 2", "F", "trial", "rig"]


def rows(trial: int, rig: str = "A") -> list[list[Any]]:
    return [
        [t, 2.0 * t + trial, 4.0 * t, math.sin(t / 50.0) * trial, trial, rig] for t in T.tolist()
    ]


def write_csv(path: Path, lines: list[list[Any]], header=tuple(HEADER), mark: str = ",") -> None:
    text = [mark.join(header), *(mark.join(str(c) for c in line) for line in lines)]
    path.write_text("\n".join(text) + "\n")


BASE: dict[str, Any] = {
    "name": "cart",
    "model": {"system": "ode"},
    "time": {"column": "t (ms)", "unit": "ms"},
    "channels": [{"name": "position", "column": "pos (mm)", "unit": "mm", "sd": 0.1}],
    "commands": [{"name": "force", "column": "F", "unit": "mN", "lower": -5, "rate": 100}],
}


def load(folder: Path, **changes: Any):
    (folder / "study.yaml").write_text(yaml.safe_dump({**BASE, **changes}))
    return load_study(folder)


@pytest.fixture
def folder(tmp_path):
    write_csv(tmp_path / "a.csv", rows(1))
    write_csv(tmp_path / "all.csv", [*rows(1), *rows(2, "B"), *rows(3)])
    return tmp_path


def test_units_of_the_file_become_si(folder):
    study = load(folder, runs=[{"name": "a", "file": "a.csv"}])
    run, channel, command = study.runs[0], study.channels[0], study.commands[0]
    np.testing.assert_allclose(run.time_s, T * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(run.measured[:, 0], (2.0 * T + 1.0) * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(run.command["force"], np.sin(T / 50.0) * 1e-3, rtol=1e-12)
    assert (channel.unit, channel.kind, channel.shown_unit) == ("m", "position", "mm")
    assert channel.sd == pytest.approx(1e-4)
    assert (command.unit, command.shown_unit, command.upper) == ("N", "mN", None)
    assert (command.lower, command.rate) == pytest.approx((-5e-3, 0.1))
    assert study.system == "ode" and study.model == {"system": "ode"}


def test_a_scale_with_a_zero_of_its_own_becomes_kelvin(folder):
    channel = {"name": "room", "column": "pos (mm)", "unit": "degF", "sd": 1.8}
    study = load(folder, runs=[{"name": "a", "file": "a.csv"}], channels=[channel])
    wanted = (2.0 * T + 1.0 + 459.67) * 5.0 / 9.0
    # the size of a degree is a difference of two numbers near 255
    np.testing.assert_allclose(study.runs[0].measured[:, 0], wanted, rtol=1e-12)
    assert study.channels[0].unit == "K" and study.channels[0].sd == pytest.approx(1.0)


def test_what_is_loaded_is_saved_and_read_back(folder, tmp_path):
    study = load(
        folder,
        runs=[
            {"name": "r{trial}", "file": "all.csv", "split": "trial", "setup": {"rig": "column"}}
        ],
    )
    saved = load_study(save_study(study, tmp_path / "saved"))
    assert saved.channels == study.channels and saved.commands == study.commands
    assert saved.model == study.model and saved.folder == study.folder.resolve()
    for a, b in zip(study.runs, saved.runs, strict=True):
        assert (a.name, a.group, a.order, a.use, a.setup) == (
            b.name, b.group, b.order, b.use, b.setup
        )  # fmt: skip
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(a.command["force"], b.command["force"])


def test_values_of_a_column_are_runs(folder):
    study = load(
        folder,
        runs=[
            {
                "name": "toss_{trial:02d}",
                "file": "all.csv",
                "split": "trial",
                "use": {"test": [3], "select": 2},
                "group": "rig {rig}",
                "setup": {
                    "trial": "column",
                    "rig": "column",
                    "level": {"value": "{trial}", "unit": "mbar"},
                },
            }
        ],
    )
    assert [r.group for r in study.runs] == ["rig A", "rig B", "rig A"]
    assert [r.name for r in study.runs] == ["toss_01", "toss_02", "toss_03"]
    assert [r.use for r in study.runs] == ["fit", "select", "test"]
    assert [r.order for r in study.runs] == [0, 1, 2]
    assert study.runs[1].setup == {"trial": 2.0, "rig": "B", "level": 200.0}


def test_values_of_two_columns(folder):
    study = load(
        folder, runs=[{"file": "all.csv", "split": ["rig", "trial"], "where": {"trial": [1, 3]}}]
    )
    assert [r.name for r in study.runs] == ["all_A_1", "all_A_3"]
    assert "all.csv: 40 of 120 rows, by runs[0].where" in study.left_out


def test_files_that_fit_a_pattern(folder):
    for level in (50, 100, 200):
        write_csv(folder / f"step_{level}mbar.csv", rows(1))
    study = load(
        folder,
        runs=[
            {
                "file": "step_{level}mbar.csv",
                "name": "p{level}",
                "setup": {"pressure_Pa": {"value": "{level}", "unit": "mbar"}},
                "use": {"test": ["p200"]},
            }
        ],
    )
    assert [r.name for r in study.runs] == ["p50", "p100", "p200"]
    assert [r.setup["pressure_Pa"] for r in study.runs] == [5000.0, 10000.0, 20000.0]
    assert [r.use for r in study.runs] == ["fit", "fit", "test"]


@pytest.mark.property
@pytest.mark.parametrize("seed", range(20))
def test_patterns_fit_as_regular_expressions_do(seed):
    """Words as short as can be, stars as long, none over a folder's mark; a star may be nothing."""
    rng = np.random.default_rng(seed)
    parts = ["a", "*", "{x}", "b", "{y}", "*", "/", "*"]
    for _ in range(60):
        pattern = [parts[k] for k in sorted(rng.choice(8, rng.integers(2, 9), replace=False))]
        name = "".join(rng.choice(list("ab/"), rng.integers(1, 7), p=[0.45, 0.4, 0.15]))
        kinds = {"*": "[^/]*", "{x}": "(?P<x>[^/]+?)", "{y}": "(?P<y>[^/]+?)"}
        found = re.fullmatch("".join(kinds.get(p, p) for p in pattern), name)
        assert _words_of(pattern, name) == (found and found.groupdict()), (pattern, name)


def test_a_table_lists_the_runs(folder):
    write_csv(folder / "b.csv", rows(2))
    write_csv(
        folder / "flights.csv",
        [["a", "plain", 0.5, 1], ["b", "plain", 0.7, 1], ["c", "cut", 0.5, 2]],
        ["flight", "kind", "mass", "day"],
    )
    study = load(
        folder,
        runs=[
            {
                "table": "flights.csv",
                "where": {"kind": "plain"},
                "file": "{flight}.csv",
                "group": "day{day}",
                "setup": {"mass": "{mass}", "kind": "{kind}"},
            }
        ],
    )
    assert [(r.name, r.group) for r in study.runs] == [("a", "day1"), ("b", "day1")]
    assert study.runs[1].setup == {"mass": 0.7, "kind": "plain"}


def test_windows_and_clock(folder):
    entry = {"name": "a", "file": "a.csv", "from_s": 0.1, "until_s": 0.3}
    run = load(folder, runs=[entry]).runs[0]
    assert (run.time_s[0], len(run.time_s)) == (0.1, 20)  # 0.3 itself is the next window's
    run = load(folder, runs=[{**entry, "zero_time": "start"}]).runs[0]
    assert run.time_s[0] == 0.0 and run.measured[0, 0] == pytest.approx(0.201)
    run = load(
        folder,
        runs=[
            {
                "name": "a",
                "file": "a.csv",
                "zero_when": "`pos (mm)` > 200",
                "before_zero_s": 0.02,
                "after_zero_s": 0.05,
            }
        ],
    ).runs[0]
    np.testing.assert_allclose(run.time_s, [-0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04], atol=1e-12)


def test_a_run_begins_where_a_channel_says_so(folder):
    """Channels count from their zero_s, wherever the rig stood: a place of the room need not."""
    channel = {"name": "moved", "column": "pos (mm)", "unit": "mm", "zero_s": [0.0, 0.05]}
    entry = {"name": "a", "file": "a.csv", "zero_when": "moved > 0.0021", "before_zero_s": 0.02}
    run = load(folder, channels=[channel], runs=[entry]).runs[0]
    assert run.time_s[0] == pytest.approx(-0.02)
    assert run.measured[2, 0] > 0.0021 >= run.measured[1, 0]
    with pytest.raises(ValueError, match=r"no column or fact 'mooved'; did you mean 'moved'"):
        load(folder, channels=[channel], runs=[{**entry, "zero_when": "mooved > 1"}])


def test_windows_by_run(folder):
    study = load(
        folder,
        runs=[{"name": "r{trial}", "file": "all.csv", "split": "trial", "until_s": {2: 0.1}}],
    )
    assert [len(r.time_s) for r in study.runs] == [40, 10, 40]


def test_fewer_samples(folder):
    entry = {"name": "a", "file": "a.csv"}
    run = load(folder, runs=[{**entry, "every": 4}]).runs[0]
    np.testing.assert_allclose(run.time_s, T[::4] * 1e-3, rtol=1e-15)
    run = load(folder, runs=[{**entry, "every": {0: 2, 0.2: 10}}]).runs[0]
    np.testing.assert_allclose(run.time_s, [*np.arange(0, 0.2, 0.02), 0.2, 0.3], atol=1e-12)
    run = load(folder, runs=[{**entry, "every": 4, "average": True}]).runs[0]
    assert len(run.time_s) == 10
    assert run.time_s[0] == pytest.approx(0.015)
    assert run.measured[0, 0] == pytest.approx(0.031)


def test_channels_by_formula(folder):
    study = load(
        folder,
        channels=[
            {"name": "middle", "formula": "0.5*(`pos (mm)` + `right 2`)", "unit": "mm"},
            {"name": "moved", "column": "right 2", "unit": "mm", "zero_s": [0.0, 0.02]},
            {"name": "seen", "formula": "`pos (mm)` if trial < 2 else nan", "unit": "mm"},
            {"name": "half", "column": "right 2", "unit": "mm", "scale": 0.5, "offset": 1.0},
        ],
        commands=[
            {"name": "pressure", "formula": "level*(t >= 0.1)"},
            {"name": "level_V", "formula": 2.5},
        ],
        defaults={"setup": {"level": {"value": 2, "unit": "mbar"}}, "until_s": 0.2},
        runs=[{"name": "r{trial}", "file": "all.csv", "split": "trial"}],
    )
    one, two, _ = study.runs
    np.testing.assert_allclose(one.measured[:, 0], (3.0 * T[:20] + 0.5) * 1e-3, rtol=1e-14)
    np.testing.assert_allclose(one.measured[:, 1], (4.0 * T[:20] - 20.0) * 1e-3, atol=1e-15)
    assert np.isfinite(one.measured[:, 2]).all() and np.isnan(two.measured[:, 2]).all()
    np.testing.assert_allclose(one.measured[:, 3], (2.0 * T[:20] + 1.0) * 1e-3, rtol=1e-14)
    np.testing.assert_array_equal(one.command["pressure"], np.where(one.time_s >= 0.1, 200.0, 0.0))
    np.testing.assert_array_equal(one.command["level_V"], np.full(20, 2.5))


def test_a_file_may_have_columns_of_its_own(folder):
    write_csv(folder / "b.csv", [[0.1 * i, i] for i in range(12)], ["s", "x_m"])
    study = load(
        folder,
        channels=[*BASE["channels"], {"name": "angle", "column": "right 2", "unit": "deg"}],
        runs=[
            {"name": "a", "file": "a.csv"},
            {
                "name": "b",
                "file": "b.csv",
                "time": {"column": "s"},
                "columns": {
                    "position": {"column": "x_m", "unit": "m"},
                    "angle": None,
                    "force": None,
                },
            },
        ],
    )
    np.testing.assert_allclose(study.runs[1].measured[:, 0], np.arange(12.0))
    assert np.isnan(study.runs[1].measured[:, 1]).all()


def test_further_files_are_read_at_the_clock_of_the_first(folder):
    write_csv(folder / "load.csv", [[i * 100, 2.0 * i] for i in range(3)], ["t (ms)", "load_N"])
    study = load(
        folder,
        channels=[*BASE["channels"], {"name": "load_N", "unit": "N"}],
        runs=[{"name": "a", "file": ["a.csv", "load.csv"]}],
    )
    load_n = study.runs[0].measured[:, 1]
    assert load_n[5] == pytest.approx(1.0) and np.isnan(load_n[-1])


@pytest.mark.parametrize("formula", [None, "2 * sent / 2"])
def test_a_command_of_a_further_file_is_held_where_its_study_says_so(folder, formula):
    """It was sent every 100 ms, and read at the clock of a file of every 10 ms."""
    write_csv(folder / "sent.csv", [[i * 100, i**2] for i in range(1, 3)], ["t (ms)", "sent"])
    source = {"column": "sent"} if formula is None else {"formula": formula}

    def sent(fill):
        command = {"name": "force", "unit": "N", "fill": fill, **source}
        entry = {"name": "a", "file": ["a.csv", "sent.csv"]}
        return load(folder, commands=[command], runs=[entry]).runs[0].command["force"]

    times = load(folder, runs=[{"name": "a", "file": "a.csv"}]).runs[0].time_s
    np.testing.assert_array_equal(sent("hold"), np.where(times < 0.2 - 1e-9, 1.0, 4.0))
    np.testing.assert_allclose(sent("linear"), np.interp(times, [0.1, 0.2], [1.0, 4.0]))


def test_a_held_command_that_comes_between_rows_counts_for_what_is_left_of_the_row(folder):
    """Sent 1 ms after every other row of 10 ms: old for a tenth of the row, new for the rest.

    Read at the row itself it was an interval old, and motors seemed to lag by 19 ms less.
    """
    write_csv(folder / "sent.csv", [[i * 20 + 1, i] for i in range(20)], ["t (ms)", "sent"])
    command = {"name": "force", "unit": "N", "fill": "hold", "column": "sent"}
    entry = {"name": "a", "file": ["a.csv", "sent.csv"]}
    force = load(folder, commands=[command], runs=[entry]).runs[0].command["force"]
    rows_of = np.arange(len(force) - 1)
    first = rows_of % 2 == 0  # the row within which the command comes
    want = np.where(first, np.maximum(0.5 * rows_of - 0.1, 0.0), 0.5 * (rows_of - 1))
    np.testing.assert_allclose(force[:-1][rows_of < 38], want[rows_of < 38], atol=1e-9)


def test_each_file_of_a_run_has_the_clock_that_it_holds(folder):
    """A camera counts milliseconds, an inertial unit seconds, in columns of other names."""
    write_csv(folder / "imu.csv", [[0.1 * i, 2.0 * i] for i in range(3)], ["stamp", "load_N"])
    study = load(
        folder,
        time=[BASE["time"], {"column": "stamp", "unit": "s"}],
        channels=[*BASE["channels"], {"name": "load_N", "unit": "N"}],
        runs=[{"name": "a", "file": ["a.csv", "imu.csv"]}],
    )
    load_n = study.runs[0].measured[:, 1]
    assert load_n[5] == pytest.approx(1.0) and np.isnan(load_n[-1])
    assert "columns: stamp" not in study.left_out
    with pytest.raises(ValueError, match=r"imu\.csv: column t \(ms\) is missing"):
        load(folder, runs=[{"name": "a", "file": ["a.csv", "imu.csv"]}])


@pytest.mark.parametrize("mark", ["---", "--", "#N/A", "n.a."])
def test_marks_of_missing_values(folder, mark):
    lines = rows(1)
    lines[9][1] = mark
    write_csv(folder / "a.csv", lines)
    run = load(folder, runs=[{"name": "a", "file": "a.csv"}]).runs[0]
    assert np.isnan(run.measured[9, 0]) and np.isfinite(run.measured[8, 0])


def test_gaps(folder):
    lines = rows(1)
    lines[0][3] = lines[5][3] = lines[6][3] = ""
    lines[9][1] = "NaN"
    write_csv(folder / "a.csv", lines)
    entry = {"name": "a", "file": "a.csv"}

    def force(fill):
        command = {"name": "force", "column": "F", "unit": "mN", **({"fill": fill} if fill else {})}
        run = load(folder, commands=[command], runs=[entry]).runs[0]
        assert np.isnan(run.measured[9, 0])
        return run.command["force"] * 1e3

    assert np.isnan(force(None)[[0, 5, 6]]).all()
    held, linear = force("hold"), force("linear")
    assert held[0] == held[1] and held[5] == held[6] == held[4]
    assert linear[5] == pytest.approx((2 * linear[4] + linear[7]) / 3.0)
    assert force(7)[5] == pytest.approx(7.0)
    run = load(folder, runs=[{**entry, "missing_if": "t > 0.25"}]).runs[0]
    assert np.isfinite(run.measured[25, 0]) and np.isnan(run.measured[26:]).all()


def test_blocks(folder):
    study = load(
        folder,
        runs=[
            {
                "name": "long",
                "file": "a.csv",
                "blocks": {"num": 4, "use": {"select": [3], "test": [4]}},
            }
        ],
    )
    assert [r.name for r in study.runs] == ["long_1", "long_2", "long_3", "long_4"]
    assert [r.use for r in study.runs] == ["fit", "fit", "select", "test"]
    assert [r.time_s[0] for r in study.runs] == [0.0, 0.1, 0.2, 0.3]
    blocks = {"length_s": 0.15, "restart_time": True}
    study = load(folder, runs=[{"name": "long", "file": "a.csv", "blocks": blocks}])
    assert [len(r.time_s) for r in study.runs] == [15, 15, 10]
    assert all(r.time_s[0] == 0.0 for r in study.runs)


def test_repeats(folder):
    first = {"name": "a", "file": "a.csv", "group": "up"}
    study = load(folder, runs=[first, {"name": "b", "file": "a.csv", "repeat_of": "a"}])
    assert [r.group for r in study.runs] == ["up", "up"]


def test_files_as_loggers_write_them(folder):
    text = "Logger 7\nDate;today\nZeit;Druck (mbar);Winkel\ns;mbar;°\n"
    text += "".join(f"0,{i:02d};{i},5;{i}\n" for i in range(20))
    (folder / "log.csv").write_bytes(text.encode("cp1252"))
    study = load(
        folder,
        table={"header_line": 3, "first_line": 5},
        time={"column": "Zeit"},
        channels=[
            {"name": "pressure", "column": "Druck (mbar)", "unit": "mbar"},
            {"name": "angle", "column": "Winkel", "unit": "°"},
        ],
        commands=[],
        runs=[{"name": "log", "file": "log.csv"}],
    )
    run = study.runs[0]
    np.testing.assert_allclose(run.time_s, np.arange(20) * 0.01, rtol=1e-14)
    np.testing.assert_allclose(run.measured[:, 0], (np.arange(20) + 0.5) * 100.0, rtol=1e-14)
    np.testing.assert_allclose(run.measured[:, 1], np.radians(np.arange(20.0)), rtol=1e-14)


def test_files_without_a_header_side_by_side(folder):
    """Rows of a file without a clock are those of the first; a last command may be missing."""
    (folder / "time.csv").write_text("\n".join(f"{0.1 * i:.1f}" for i in range(12)))
    (folder / "input.csv").write_text("\n".join(f"{i},{i % 3}" for i in range(11)))
    entry = {"name": "a", "file": ["time.csv", "input.csv"]}
    changes = {
        "table": [
            {"header_line": 0, "columns": ["time"]},
            {"header_line": 0, "columns": ["speed", "turn"]},
        ],
        "time": {"column": "time"},
        "channels": [{"name": "turn", "unit": "-"}],
        "commands": [{"name": "speed", "unit": "m/s", "fill": "hold"}],
    }
    run = load(folder, runs=[entry], **changes).runs[0]
    np.testing.assert_allclose(run.time_s, 0.1 * np.arange(12), rtol=1e-12)
    np.testing.assert_allclose(run.measured[:11, 0], np.arange(11) % 3)
    assert np.isnan(run.measured[11, 0])
    np.testing.assert_allclose(run.command["speed"], [*range(11), 10.0])
    (folder / "input.csv").write_text("1,2\n" * 9)
    with pytest.raises(ValueError, match="its 9 rows not each is beside one of the 12"):
        load(folder, runs=[entry], **changes)
    changes["table"][1]["columns"] = ["speed"]
    with pytest.raises(ValueError, match="2 cells, but `columns` names 1: speed"):
        load(folder, runs=[entry], **changes)
    with pytest.raises(ValueError, match="table has 2 entries, but a run has 1 files"):
        load(folder, runs=[{"name": "a", "file": "time.csv"}], **changes)


def test_lists_in_cells_of_files_with_the_same_columns(folder):
    """What both files call `positions` is told apart by `file`, also in a formula."""
    for name, sign, start in (("read", 1.0, 0.0), ("goal", -1.0, 5e6)):
        lines = [
            f'{start + 1e4 * i:.0f},"[{sign * i}, {sign * 2 * i}]",S'
            if i != 4
            else f"{start + 4e4},,S"
            for i in range(12)
        ]
        (folder / f"{name}.csv").write_text("\n".join(["stamp,positions,kind", *lines]))
    channels = [{"name": "reached", "column": "positions[1]", "unit": "rad"}]
    commands = [
        {"name": "goal", "column": "positions[1]", "unit": "rad", "file": 2, "fill": "linear"},
        {"name": "half", "formula": "0.5*`positions[1]`", "unit": "rad", "file": 2, "fill": "hold"},
    ]
    entry = {"name": "a", "file": ["read.csv", "goal.csv"]}
    clock = {"column": "stamp", "unit": "us", "zero": "start"}
    changes = {"channels": channels, "commands": commands, "runs": [entry]}
    run = load(folder, time=clock, **changes).runs[0]
    np.testing.assert_allclose(run.time_s, 0.01 * np.arange(12), rtol=1e-12)
    seen = np.arange(12) != 4
    np.testing.assert_allclose(run.measured[seen, 0], 2.0 * np.arange(12)[seen])
    assert np.isnan(run.measured[4, 0])
    np.testing.assert_allclose(run.command["goal"], -2.0 * np.arange(12), atol=1e-9)
    np.testing.assert_allclose(run.command["half"][[3, 4, 5]], [-3.0, -3.0, -5.0])
    # without a zero the clocks do not meet, and the goals are unknown
    apart = load(folder, time={"column": "stamp", "unit": "us"}, **changes).runs[0]
    assert np.isnan(apart.command["goal"]).all()
    channels[0]["file"] = 3
    with pytest.raises(ValueError, match=r"file: 3, but the run has read\.csv, goal\.csv"):
        load(folder, time=clock, **changes)
    (folder / "goal.csv").write_text('stamp,positions\n1,"[1, 2]"\n2,"[3]"\n')
    with pytest.raises(ValueError, match=r"goal\.csv, row 3, column positions: a list of 1 "):
        load(folder, time=clock, **changes)


def test_clocks(folder):
    lines = [[f"12:59:59.{k}", k] for k in range(10)] + [["13:00:00", 10]]
    write_csv(folder / "a.csv", lines, ["at", "x_m"])
    changes = {"channels": [{"name": "x_m", "unit": "m"}], "commands": []}
    runs = [{"name": "a", "file": "a.csv"}]
    study = load(folder, time={"column": "at", "unit": "clock"}, runs=runs, **changes)
    np.testing.assert_allclose(study.runs[0].time_s, np.arange(11) * 0.1, atol=1e-9)
    study = load(folder, time={"step": 0.5}, runs=runs, **changes)
    np.testing.assert_allclose(study.runs[0].time_s, np.arange(11) * 0.5)


def test_what_is_not_used_is_said(folder):
    left_out = load(folder, runs=[{"name": "a", "file": "a.csv", "until_s": 0.3}]).left_out
    assert left_out == (
        "files: all.csv",
        "columns: right 2, trial, rig",
        "run a: 10 of 40 samples, by its window",
    )


def test_all_mistakes_are_told_at_once(folder):
    with pytest.raises(ValueError) as caught:
        load(
            folder,
            channels=[{"name": "x", "unit": "mmm"}, {"name": "y", "unit": "m", "sd": 0}],
            runs=[{"name": "a", "until_s": "far"}, {"name": "b", "flie": "a.csv"}],
        )
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    assert "study.yaml: channels[0].unit: unit 'mmm' is unknown; did you mean 'mm'" in lines[0]
    assert lines[2].endswith("study.yaml: runs[0].until_s: must be a number, got 'far'")
    assert "study.yaml: runs[1]: no key 'flie' here; did you mean 'file'" in lines[3]


def test_mistakes_in_the_files_are_told_at_once(folder):
    with pytest.raises(ValueError) as caught:
        load(
            folder,
            runs=[
                {"name": "a", "file": "aa.csv"},
                {"file": "all.csv", "split": "tiral"},
                {"file": "all.csv", "name": "{trail}", "split": "trial"},
                {"name": "c", "file": "a.csv", "from_s": 5},
                {"file": "all.csv", "split": "trial", "use": {"test": [9]}},
                {"name": "d", "file": "a.csv", "where": {"rig": "C"}},
                {"name": "e", "file": "a.csv", "repeat_of": "z"},
                {"file": "step_*.csv"},
                {"name": "f", "file": "a.csv", "setup": {"load": {"column": "F"}}},
                {"name": "g", "file": "a.csv", "columns": {"position": {"formula": "2*pos"}}},
                {"name": "i", "file": "a.csv", "columns": {"position": {"unit": "N"}}},
                {"name": "h", "file": "a.csv", "blocks": {"num": 2, "use": {"test": [3]}}},
            ],
        )
    message = str(caught.value)
    for part in (
        "aa.csv: no such run",
        "all.csv: column tiral is missing; did you mean 'trial'",
        "study.yaml: runs[2].name: '{trail}' has {trail}; did you mean 'trial'",
        "study.yaml: runs[3]: no sample of c is left by from_s, until_s and the like; "
        "a.csv lasts from 0 to 0.39 s",
        "study.yaml: runs[4].use: no run 9; there are 1, 2, 3",
        "study.yaml: runs[5].where.rig: no row has C; a.csv has A",
        "study.yaml: runs[6].repeat_of: no run 'z'",
        "unit 'N' is no unit of the quantity that is wanted in 'mm'",
        "study.yaml: runs[7].file: no file fits 'step_*.csv'",
        "study.yaml: runs[8].setup.load: the column is not constant in the run",
        "a.csv: formula '2*pos': no column or fact 'pos'; did you mean '`pos (mm)`'",
        "study.yaml: runs[11].blocks.use: no piece 3; run h has 2",
    ):
        assert part in message, message


def test_published_data_by_name(tmp_path, monkeypatch):
    rig = tmp_path / "data" / "my_rig"
    rig.mkdir(parents=True)
    write_csv(rig / "a.csv", rows(1))
    (rig / "metadata.yaml").write_text("title: a rig\n")
    monkeypatch.setenv("DIFFSIM_DATA", str(tmp_path / "data"))
    study = load(tmp_path, data="my_rig", runs=[{"name": "a", "file": "a.csv"}])
    assert len(study.runs) == 1 and study.folder == rig
    with pytest.raises(FileNotFoundError, match=r"study\.yaml: data: .*'my_rig'"):
        load(tmp_path, data="my_rigg", runs=[{"name": "a", "file": "a.csv"}])
