"""docs/environments is what the classes of the environments say, and every page has its picture."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

SCRIPT = Path(__file__).parents[2] / "scripts" / "environment_pages.py"


def script():
    spec = importlib.util.spec_from_file_location("environment_pages", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_are_up_to_date() -> None:
    """Where this fails: python scripts/environment_pages.py."""
    module = script()
    kept = {path.name: path.read_text(encoding="utf-8") for path in module.FOLDER.glob("*.md")}
    assert kept == module.pages()


def test_every_page_has_its_picture() -> None:
    module = script()
    for name in module.pages().keys() - {"README.md"}:
        assert (module.IMAGES / f"env_{Path(name).stem}.png").stat().st_size > 5_000


def test_what_a_page_shows_is_a_motion_of_its_environment() -> None:
    """Three moments of the arm, whose nodes have moved."""
    found = script().moments("TendonReach")
    assert len(found) == 3
    (task, first), (_, second), (_, last) = found
    assert (first["x"] - second["x"]).abs().max() > 0.01
    assert task.picture(last, 0).shape == (360, 480, 3)
