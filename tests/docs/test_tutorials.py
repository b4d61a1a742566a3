"""The tutorials run as they stand, cell after cell, in an empty folder."""

import json
import shlex
from pathlib import Path

import pytest

from diffsim.cli import main
from tests.diagnose.discover.answers import no_laws

TUTORIALS = Path(__file__).resolve().parents[2] / "docs" / "tutorials"


def cells(name):
    notebook = json.loads((TUTORIALS / name).read_text(encoding="utf-8"))
    return [(c["cell_type"], "".join(c["source"])) for c in notebook["cells"]]


def run(name, folder, monkeypatch, shorter=None, until=None):
    """Names that the code cells leave; lines with ``!diffsim`` are commands.

    ``shorter`` has texts to replace, each of which must be there; ``until`` begins the first cell
    that is not run.
    """
    monkeypatch.chdir(folder)
    names, replaced = {"__name__": "__main__"}, set()
    for k, (kind, text) in enumerate(cells(name)):
        if kind != "code":
            continue
        if until is not None and text.startswith(until):
            break
        for long, short in (shorter or {}).items():
            if long in text:
                replaced.add(long)
                text = text.replace(long, short)
        if text.startswith("!diffsim "):
            assert main(shlex.split(text.removeprefix("!diffsim "))) == 0, text
        else:
            exec(compile(text, f"{name}, cell {k}", "exec"), names)
    assert replaced == set(shorter or {})
    return names


@pytest.mark.short_of("test_own_shape")
@pytest.mark.example
def test_own_shape_in_short(tmp_path, monkeypatch):
    shorter = {"spacing=0.009": "spacing=0.015", "rest_state(), 30": "rest_state(), 10"}
    names = run("1_own_shape.ipynb", tmp_path, monkeypatch, shorter)
    assert abs(float(names["miss"])) < 1e-3  # [m]; a third of the time is no fall of 8 mm


@pytest.mark.example
def test_own_quadrotor(tmp_path, monkeypatch):
    shorter = {
        'load_mission("there_and_back"))': 'load_mission("there_and_back"), seconds=0.5)',
        "expand(1, 300, 4)": "expand(1, 30, 4)",
    }
    names = run("2_own_quadrotor.ipynb", tmp_path, monkeypatch, shorter)
    assert names["log"].series("time")[-1] == pytest.approx(0.5, abs=0.02)
    assert (tmp_path / "flight" / "flight.csv").is_file()


@pytest.mark.short_of("test_own_recording")
@pytest.mark.example
def test_own_recording_in_short(tmp_path, monkeypatch, capsys):
    """Recorded, described and checked; not diagnosed."""
    run("3_own_recording.ipynb", tmp_path, monkeypatch, until="!diffsim diagnose explain")
    assert "ready for a diagnosis" in capsys.readouterr().out


@pytest.mark.story
@pytest.mark.example
def test_own_shape(tmp_path, monkeypatch):
    names = run("1_own_shape.ipynb", tmp_path, monkeypatch)
    assert abs(float(names["miss"])) < 1e-5  # the tip ends where it was wanted [m]


@pytest.mark.story
@pytest.mark.example
def test_own_recording(tmp_path, monkeypatch, capsys):
    quick = {"explain pendulum --out": "explain pendulum --budget quick --out"}
    with no_laws():
        names = run("3_own_recording.ipynb", tmp_path, monkeypatch, quick)
    certain = {c["name"] for c in names["report"]["causes"] if c["status"] == "certain"}
    said = capsys.readouterr().out
    assert certain == {"dry_friction_at_hinge"}, said  # the rubbing joint, nothing else
    assert "ready for a diagnosis" in said


def test_every_tutorial_is_tested_and_has_no_outputs():
    names = sorted(p.name for p in TUTORIALS.glob("*.ipynb"))
    assert names == ["1_own_shape.ipynb", "2_own_quadrotor.ipynb", "3_own_recording.ipynb"]
    for name in names:
        notebook = json.loads((TUTORIALS / name).read_text(encoding="utf-8"))
        assert all(not c.get("outputs") for c in notebook["cells"])


def test_the_site_has_what_each_cell_prints():
    kept = json.loads((TUTORIALS / "outputs.json").read_text(encoding="utf-8"))
    for path in TUTORIALS.glob("*.ipynb"):
        code = [text for kind, text in cells(path.name) if kind == "code"]
        assert len(kept[path.name]) == len(code), "python scripts/tutorial_outputs.py"
        silent = [text for text, told in zip(code, kept[path.name], strict=True) if not told]
        assert not any(text.startswith("!") or "\nprint(" in text for text in silent)
