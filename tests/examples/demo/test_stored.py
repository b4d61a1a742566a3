"""Stored answers are of the same recordings and sizes, or none; what is computed is compared."""

import json
import os
from pathlib import Path

import pytest

from diffsim.data import find_dataset
from examples import demo
from examples.data.beam import load_beam_study
from examples.demo import fitting, stored
from examples.demo.plan import FULL
from examples.demo.story import VIRTUAL_BEAM
from tests.examples.demo.conftest import SHORT

pytestmark = pytest.mark.example
DATA = find_dataset("silicone_beam")
QUESTION = stored.asked(load_beam_study(VIRTUAL_BEAM), SHORT)
FITS = stored.answers(stored.asked(load_beam_study(VIRTUAL_BEAM), FULL)).results


def _short_answers(folder: Path, **other: str) -> Path:
    """A folder with the fits that come with the demo, said to be those of the short plan."""
    content = {"commit": "abc", "of": QUESTION | other, "results": FITS}
    (folder / "beam.json").write_text(json.dumps(content))
    return folder


def test_a_fit_that_is_stored_is_not_made_again(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="the demo's page needs the extra viz")
    monkeypatch.setattr(stored, "FOLDER", _short_answers(tmp_path))
    monkeypatch.setattr("examples.demo.story.find_dataset", lambda *_: None)
    monkeypatch.setattr(fitting, "fit_motion", None)
    monkeypatch.setattr("examples.demo.story._write_page", lambda *_: None)  # seconds of pictures
    monkeypatch.setattr("examples.demo.story._write_extras", lambda *_: {})
    results = demo.run(out=tmp_path / "run", plan=SHORT, threads=1)
    assert {name: results[name] for name in FITS} == FITS
    assert "computed at commit abc" in results["stored"][0]
    # all else was computed
    assert results["simulated"]["joint"]["gravity"]["time_s"]


def test_answers_of_other_recordings_or_sizes_are_none(tmp_path):
    for other in ({}, {"data": "else"}, {"plan": "else"}):
        found = stored.answers(QUESTION, _short_answers(tmp_path, **other))
        assert bool(found.results) == (not other) and bool(found.words()) == (not other)
    assert not stored.answers(QUESTION, tmp_path / "none").results


def test_what_is_computed_again_is_compared(tmp_path):
    path = _short_answers(tmp_path) / "beam.json"
    content = json.loads(path.read_text())
    content["results"]["joint"]["value"]["youngs_modulus"] *= 1.01
    content["results"]["diagnosis"] = {"named": ["a"], "verdict": "named"}
    path.write_text(json.dumps(content))
    now = {**FITS, "diagnosis": {"named": ["b"], "verdict": "named"}}
    said = stored.distances(stored.answers(QUESTION, tmp_path), now)
    assert said == [
        "identified: within 0 % of the answer of abc",
        "joint: within 0.99 % of the answer of abc",
        "diagnosis: other causes than at abc",
    ]


def test_who_has_no_recordings_gets_stored_answers_too():
    found = stored.answers(stored.asked(load_beam_study(VIRTUAL_BEAM), FULL))
    assert set(found.results) == {"identified", "joint"}
    assert found.words()[0].startswith("Fits to the motion are stored answers")


@pytest.mark.skipif(DATA is None, reason="needs the measured beam (DIFFSIM_DATA)")
def test_the_answers_that_come_with_the_demo_are_of_the_measured_beam():
    found = stored.answers(stored.asked(demo.load_study(None), FULL))
    assert set(found.results) == set(stored.STAGES) and found.commit


@pytest.mark.slow
@pytest.mark.skipif(DATA is None, reason="needs the measured beam (DIFFSIM_DATA)")
def test_they_are_what_the_code_computes_now(tmp_path):
    found = demo.run(out=tmp_path, anew=True, threads=os.cpu_count())
    kept = stored.answers(stored.asked(demo.load_study(None), FULL))
    for name in ("identified", "joint"):
        assert found[name]["value"] == pytest.approx(kept.results[name]["value"], rel=0.01)
    assert found["diagnosis"]["named"] == kept.results["diagnosis"]["named"]
