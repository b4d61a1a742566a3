"""benchmarks/planted_errors.py: the plan fits the tree; what is planted is seen, or said."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import drawn_errors, planted_errors
from benchmarks.nearest_tests import nearest_tests
from benchmarks.planted_errors import (
    CAUGHT,
    KEPT,
    MISSED,
    ROOT,
    UNFIT,
    PlanError,
    Planted,
    Record,
    WarmTests,
    copy_with,
    planted_text,
    read_plan,
    read_records,
    run_limited,
    table,
    try_one,
)

AREA = "def area(a, b):\n    return a * b\n"
TEST = "from plane.area import area\n\n\ndef test_area():\n    assert area(2, 3) == 6\n"


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A tree of one function and its test."""
    tree = tmp_path / "tree"
    (tree / "plane").mkdir(parents=True)
    (tree / "plane" / "area.py").write_text(AREA)
    (tree / "test_area.py").write_text(TEST)
    return tree


@pytest.fixture
def warm(tmp_path: Path) -> Iterator[WarmTests]:
    tests = WarmTests(tmp_path, warm=("pytest",))
    yield tests
    tests.end()


def error(new: str, **other: object) -> Planted:
    given = {"name": "e", "file": "plane/area.py", "old": "a * b", "new": new, "means": "m"}
    return Planted(**{**given, "tests": ("test_area.py",), **other})  # type: ignore[arg-type]


def test_every_old_text_stands_once_in_the_tree():
    plan = read_plan()
    for planted in plan:
        assert planted_text(planted, ROOT) != (ROOT / planted.file).read_text("utf-8")
    assert len(plan) >= 60
    assert sum(planted.is_compiled for planted in plan) >= 12


def test_every_room_has_errors_and_their_tests_are_there():
    plan = read_plan()
    rooms = {p.name for p in (ROOT / "diffsim").iterdir() if (p / "__init__.py").is_file()}
    kernels = {f"csrc/{p.name}" for p in (ROOT / "csrc/kernels").iterdir() if p.is_dir()}
    inside = [planted for planted in plan if not planted.file.startswith(("examples/", "labs/"))]
    assert {planted.room for planted in inside} == rooms | kernels
    for planted in plan:
        for test in planted.tests:
            assert (ROOT / test.partition("::")[0]).exists(), (planted.name, test)


@pytest.mark.parametrize(
    ("planted", "message"),
    [
        (error("a", old="c"), "once, found 0 times"),
        (error("a", old="a"), "once, found 4 times"),
        (error("a", file="b.py"), "no file b.py"),
    ],
)
def test_a_plan_that_does_not_fit_is_said(toy: Path, planted: Planted, message: str):
    with pytest.raises(PlanError, match=f"e: .*{message}.*; mend the plan"):
        planted_text(planted, toy)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([("a", "x", "y"), ("a", "x", "z")], "names must differ"),
        ([("a", "x", "x")], "change nothing"),
    ],
)
def test_a_plan_of_mistakes_is_refused(tmp_path: Path, rows: list, message: str):
    names = ("name", "old", "new")
    rest = {"file": "f", "means": "m", "tests": ["t"]}
    path = tmp_path / "plan.yaml"
    path.write_text(json.dumps([dict(zip(names, row, strict=True)) | rest for row in rows]))
    with pytest.raises(PlanError, match=message):
        read_plan(path)


def test_an_error_is_caught_and_a_change_of_nothing_missed(toy: Path, warm: WarmTests):
    caught = try_one(error("a + b"), toy, toy.parent, warm, 60.0)
    assert (caught.state, caught.by) == (CAUGHT, "test_area.py::test_area")
    assert caught.cpu_s > 0.0
    assert try_one(error("b * a"), toy, toy.parent, warm, 60.0).state == MISSED
    assert (toy / "plane" / "area.py").read_text() == AREA  # the tree itself is left alone
    nothing = try_one(error("a + b", only="volume"), toy, toy.parent, warm, 60.0)
    assert nothing.state == UNFIT and "deselected" in nothing.by
    lost = try_one(error("a + b", old="c"), toy, toy.parent, warm, 60.0)
    assert lost.state == UNFIT and "mend the plan" in lost.by
    hangs = try_one(error("area(a, b) if a else 0", old="a * b"), toy, toy.parent, warm, 60.0)
    assert hangs.state == CAUGHT  # an endless recursion


def test_an_error_that_no_import_survives_is_caught(toy: Path, warm: WarmTests):
    """Of tests that are asked for by name, pytest says that the name is unknown."""
    (toy / "plane" / "area.py").write_text("raise ValueError\n")
    found = warm.outcome(toy, ("test_area.py::test_area",), 60.0)
    assert (found.state, found.by) == (CAUGHT, "test_area.py")
    assert warm.outcome(toy, ("test_area.py::test_none",), 60.0).state == CAUGHT
    (toy / "plane" / "area.py").write_text("def area(a, b):\n    return a * b\n")
    assert warm.outcome(toy, ("test_area.py::test_none",), 60.0).state == UNFIT
    assert warm.outcome(toy, ("test_area.py", "--collect-only"), 60.0).state == MISSED


def test_tests_that_hang_are_ended(toy: Path, warm: WarmTests):
    (toy / "test_area.py").write_text("def test_area():\n    while True:\n        pass\n")
    assert warm.outcome(toy, ("test_area.py",), 3.0).by == "not over after 3 s"


def test_a_cached_module_does_not_hide_an_error(toy: Path):
    run = [sys.executable, "-c", "from plane.area import area; print(area(2, 3))"]
    assert subprocess.check_output(run, cwd=toy) == b"6\n"
    # as long as the old text, and as likely as not in the same second
    with copy_with(error("a + b"), toy, toy.parent) as tree:
        assert subprocess.check_output(run, cwd=tree) == b"5\n"
    assert not tree.exists()


def test_what_hangs_is_ended(tmp_path: Path):
    ended = run_limited([sys.executable, "-c", "while True: pass"], tmp_path, {}, 0.5)
    assert ended.is_late and ended.status < 0 and ended.cpu_s < 30.0


def test_outcomes_are_kept_until_what_they_depend_on_changes(toy: Path, tmp_path: Path):
    planted, path = error("a + b"), tmp_path / "record.json"
    key = planted_errors.key_of(planted, toy)
    record = Record.at(path, {"commit": "c"}, fresh=False)
    record.add(planted, planted_errors.Outcome(state=CAUGHT, key=key))
    again = Record.at(path, {"commit": "c"}, fresh=False)
    assert again.is_known(planted, planted_errors.key_of(planted, toy))
    (toy / "test_area.py").write_text(TEST.replace("6", "6.0"))
    assert not again.is_known(planted, planted_errors.key_of(planted, toy))
    assert not Record.at(path, {"commit": "c"}, fresh=True).errors


def test_the_table_counts_by_room_and_names_what_was_missed():
    rows = {
        "u": {"room": "core", "means": "a unit", "state": CAUGHT},
        "v": {"room": "core", "means": "a sign", "state": MISSED},
        "w": {"room": "mesh", "means": "an axis", "state": CAUGHT},
    }
    less = {name: {**row, "state": MISSED} for name, row in rows.items() if name != "w"}
    lines = table({"before": {"errors": rows}, "after": {"errors": less}}).splitlines()
    assert lines[0] == "| room | planted | caught, before | caught, after |"
    assert lines[2:5] == ["| core | 2 | 1 | 0 |", "| mesh | 1 | 1 | - |", "| **all** | 3 | 2 | 0 |"]
    assert lines[-2:] == [
        "Missed, before: `v` (a sign).",
        "Missed, after: `u` (a unit), `v` (a sign).",
    ]


def test_contributing_shows_the_record_of_the_plan():
    records = read_records(sorted(KEPT.glob("*.json")))
    *_, latest = records.values()
    assert set(latest["errors"]) == {planted.name for planted in read_plan()}
    assert table(records) in (ROOT / "CONTRIBUTING.md").read_text("utf-8")


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]):
    assert planted_errors.main(["--only", "corre"]) == 1
    assert "no errors or rooms ['corre']" in capsys.readouterr().err


def test_drawn_errors_fit_the_tree(monkeypatch):
    """From a seed the same ones, each a text that stands once, of Python that can be read."""
    monkeypatch.setattr(drawn_errors, "nearest_tests", lambda *_: ["tests/test_house.py", "b"])
    drawn = drawn_errors.draw(5, 20, nearest=1)
    assert drawn == drawn_errors.draw(5, 20, nearest=1)
    assert drawn != drawn_errors.draw(6, 20, nearest=1)
    kernels = [error.file.startswith(drawn_errors.KERNELS) for error in drawn]
    assert kernels == [k % 3 == 2 for k in range(20)]
    for error in drawn:
        assert "tests/test_house.py" in error.tests
        text = planted_text(Planted(**error._asdict()), ROOT)
        if error.file.endswith(".py"):
            compile(text, error.file, "exec")


@pytest.mark.cpu(9)  # the package and all tests are parsed
def test_the_nearest_tests_say_what_uses_a_line():
    """A private class, by the name of a table's entry; the kernel of a binding, by its op."""
    drag = "diffsim/systems/soft_body/forces.py"
    line = (ROOT / drag).read_text().partition("speed = torch")[0].count("\n") + 1
    assert "tests/systems/test_soft_body.py" in nearest_tests(drag, line)[:4]
    kernel = nearest_tests("csrc/kernels/copter/flight_step.h", 36)
    assert "tests/copter/dynamics/test_flight_gradients.py" in kernel[:4]


def test_the_operators_of_drawn_errors():
    text = "def f(a, b=2.0, *, c=False):\n    return a[0] * b - -c if (a < b) else 'x' + 'y'\n"
    sites = set(drawn_errors.sites_of(Path("f.py"), text))
    seen = {(text[s.start : s.end].strip(), s.new.strip(), s.kind) for s in sites}
    assert seen == {
        ("2.0", "5.0", "default"),
        ("False", "True", "default"),
        ("0", "1", "index"),
        ("*", "/", "factor"),
        ("-", "+", "sign"),
        ("- -c", "", "dropped-term"),
        ("-", "", "sign"),
        ("<", "<=", "comparison"),
    }
    kernel = "double f() { return a[0] * b + c; }  // a + b\n"
    assert len(set(drawn_errors.sites_of(Path("f.cpp"), kernel))) == 3


def test_harmless_errors_leave_the_count(tmp_path):
    record = Record(tmp_path / "r.json", {})
    states = {"a": CAUGHT, "b": MISSED, "c": UNFIT}
    record.errors = {n: {"state": s, "room": "soft", "cpu_s": 1.0} for n, s in states.items()}
    record.errors["d"] = {"state": CAUGHT, "room": "csrc/soft", "cpu_s": 1.0, "build_s": 8.0}
    python, kernels = planted_errors.shares_caught(record, {}).splitlines()
    assert python.startswith("Python: caught 1 of 2 (50 %); 1 CPU s each, 0 more to compile; 0 ")
    assert kernels.startswith("kernels: caught 1 of 1 (100 %); 1 CPU s each, 8 more to compile; 0 ")
    assert "caught 1 of 1" in planted_errors.shares_caught(record, {"b": "a guess"})
