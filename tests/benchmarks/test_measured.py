"""Answers of the published sets: pages have the text of the record, and its checks can fail."""

import json

import numpy as np
import pytest

from benchmarks import diagnose_published, measured
from diffsim.core.paths import data_folder

ROWS = json.loads(measured.RECORD.read_text(encoding="utf-8"))
SAID = {name: row["first"] for name, row in ROWS.items() if row["first"]["said"]}
FELL = {"kind": "position", "unit": "um", "before": 72.4e-6, "after": 6.41e-6}


def test_pages_are_written_from_the_record():
    page = measured.PAGE.read_text(encoding="utf-8")
    assert page == measured.with_table(page, ROWS)
    assert measured.SENTENCES.read_text(encoding="utf-8") == measured.sentences_of(ROWS)


def test_every_published_set_has_a_row_and_those_with_data_a_sentence():
    assert set(ROWS) == set(diagnose_published.NAMES)
    assert {*SAID, *measured.BY_SCRIPT} == set(ROWS)
    here = [row for name in SAID for row in ROWS[name].values()]
    assert all(row["date"] and row["machine"] for row in here)


@pytest.mark.parametrize("name", sorted(SAID))
def test_a_first_sentence_is_short_and_has_the_errors_of_its_answer(name):
    assert measured.amiss(SAID[name]) == []


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("Lag is missing: error on unseen runs 72.4 to 6.41 um, noise 1 um.", []),
        ("Lag is missing: error on unseen runs 72.4 to 7.41 um, noise 1 um.", ["another error"]),
        ("Lag of motor_4 is missing: unseen error 72.4 to 6.41 um.", ["code name"]),
        ("Lag is missing.", []),
        (f"Lag is {'very ' * 23}missing.", ["long"]),
    ],
)
def test_what_is_amiss_is_seen(said, why):
    assert measured.amiss({"said": said, "errors": [FELL]}) == why


def test_errors_of_several_runs_are_their_root_mean_square():
    run = {"run": "a", "kind": "angle", "unit": "rad", "before": 3.0, "after": 0.0, "noise": 1.0}
    run |= {"num_samples": 1, "num_fitted": 0}
    other = {**run, "before": 0.0, "after": 2.0, "num_samples": 3}
    content = {"headline": "Lag is missing.", "errors": [run, other]}
    row = measured.row_of(diagnose_published.Asked(content, "named", "", (), 1.0))
    assert row["errors"] == [
        {"kind": "angle", "unit": "rad", "before": 1.5, "after": pytest.approx(3.0**0.5)}
    ]


def test_a_call_asks_what_no_row_of_this_code_has(monkeypatch, tmp_path, capsys):
    calls = []

    def asked(name, *, quick):
        calls.append((name, quick))
        if name == "emps":
            raise ValueError("no recordings")
        return diagnose_published.Asked({"headline": f"{name}."}, "named", "", ("lag",), 61.4)

    monkeypatch.setattr(measured, "asked", asked)
    monkeypatch.setattr(measured.os, "getloadavg", lambda: (1e3, 1e3, 1e3))
    monkeypatch.setattr(measured, "RECORD", tmp_path / "measured.json")
    rows = {"starfish": {"first": {"cpu_s": 21, "code": "another"}}}
    for _ in range(2):
        measured._ask(["starfish", "emps"], rows, "first", again=False)
    assert calls == [("starfish", True), ("emps", True), ("emps", True)]
    assert json.loads((tmp_path / "measured.json").read_text()) == rows
    assert "emps: no recordings" in capsys.readouterr().err
    assert "| named | **61~** |" in measured.table_of(rows) and rows["starfish"]["first"]["machine"]


@pytest.mark.slow
@pytest.mark.skipif(data_folder() is None, reason="no recordings: set DIFFSIM_DATA")
def test_three_drawn_answers_are_those_of_the_record():
    """Drawn by the record itself, so that each renewal asks others."""
    seed = sum(ord(c) for c in measured.RECORD.read_text(encoding="utf-8"))
    for name in np.random.default_rng(seed).choice(sorted(SAID), 3, replace=False):
        row = measured.row_of(diagnose_published.asked(str(name), quick=True))
        known = SAID[str(name)]
        assert {k: row[k] for k in ("verdict", "said")} == {
            k: known[k] for k in ("verdict", "said")
        }
