"""The demo ends with a page and numbers, with measured data or without."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("matplotlib", reason="the demo's page needs diffsim-robot[viz]")
pytest.importorskip("jinja2", reason="the demo's page needs diffsim-robot[viz]")

from diffsim import demo

pytestmark = pytest.mark.example


def test_without_data_it_makes_virtual_ones_and_says_so(tmp_path, monkeypatch):
    monkeypatch.delenv("DIFFSIM_DATA", raising=False)
    monkeypatch.setattr("diffsim.demo.find_dataset", lambda *_: None)
    results = demo.main(out=tmp_path / "run")
    assert results["is_virtual"]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert page.count("VIRTUAL DATA") == 2
    kept = json.loads((tmp_path / "run" / "results.json").read_text())
    assert kept["measured"]["repeats"]["gravity"]["vertical_rms_m"] > 0


def test_wrong_data_folder_does_not_fall_back_to_virtual(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"data=.*must be the folder that holds"):
        demo.main(data=tmp_path / "nowhere", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
