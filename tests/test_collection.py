"""Collecting all tests is paid by every run, each worker and each ``-k``: it stays cheap."""

import re
import sys
from collections.abc import Iterable
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.conftest import COLLECTION_S, STORY_ROOMS, TESTS, is_in_story, pytest_ignore_collect
from tests.cpu_seconds import BEGAN, slowness

LIMIT_S = 8.0
"""CPU seconds of a process up to its first test; 5 were measured, 1.4 of them PyTorch's."""
COMPILING_S = 12.0
"""More of them where files of tests are compiled first, their assertions rewritten; 8 measured."""


def test_collecting_all_tests_takes_few_seconds(request: pytest.FixtureRequest) -> None:
    """Where this fails: a test module loads at its top what one of its tests needs.

    ``python -X importtime -m pytest --collect-only -q -s`` shows which.
    """
    files = {item.path for item in request.session.items}
    rooms = [path for path in TESTS.rglob("test_*.py") if STORY_ROOMS.isdisjoint(path.parents)]
    if len(files) < 0.8 * len(rooms):  # files of slow tests are not here
        pytest.skip("holds where all tests are collected")
    limit = LIMIT_S + COMPILING_S * share_compiled(files)
    assert request.config.stash[COLLECTION_S] <= limit * slowness()


@pytest.mark.parametrize(
    ("marks", "named", "is_left_out"),
    [
        ("not slow and not story", "tests", True),
        ("not slow and not story", "tests/systems", True),
        ("not slow and not story", "tests/labs", False),
        ("not slow and not story", "tests/labs/loop/test_loop.py::test_report", False),
        ("not slow", "tests", False),
    ],
)
def test_rooms_of_stories_run_by_name_and_with_all_stories(marks, named, is_left_out):
    config: Any = SimpleNamespace(
        option=SimpleNamespace(markexpr=marks),
        args=[named],
        invocation_params=SimpleNamespace(dir=TESTS.parent),
    )
    assert bool(pytest_ignore_collect(TESTS / "labs", config)) is is_left_out
    assert pytest_ignore_collect(TESTS / "soft", config) is None


def test_short_forms_are_left_out_where_their_story_runs():
    item: Any = SimpleNamespace(
        nodeid="a.py::test_short[1]",
        get_closest_marker=lambda name: pytest.mark.short_of("b[1]").mark,
    )
    assert is_in_story(item, {"a.py::b[1]"}) and not is_in_story(item, {"a.py::b[2]", "c.py::b[1]"})
    named = {
        (path, story)
        for path in TESTS.rglob("test_*.py")
        for story in re.findall(r'mark\.short_of\(\s*"(test_\w+)', path.read_text("utf-8"))
    }
    assert len(named) > 5
    for path, story in named:
        text = path.read_text("utf-8")
        assert f"def {story}(" in text and re.search(r"mark\.(story|slow)", text), story


def share_compiled(files: set[Path]) -> float:
    """Share of test modules that this run compiled, having found nothing of an earlier one."""
    if sys.dont_write_bytecode:
        return 1.0
    kept = [max(map(written, compiled(path)), default=inf) for path in files]
    return sum(when > BEGAN for when in kept) / len(kept)


def compiled(path: Path) -> Iterable[Path]:
    """What pytest keeps of a module, by Python and pytest that wrote it."""
    return (path.parent / "__pycache__").glob(f"{path.stem}.*-pytest-*.pyc")


def written(path: Path) -> float:
    return path.stat().st_mtime
