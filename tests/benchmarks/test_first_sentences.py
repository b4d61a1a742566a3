"""The table of first sentences: its text is that of the record, and its checks can fail."""

import json

import pytest

from benchmarks import diagnose_published, first_sentences

ROWS = json.loads(first_sentences.RECORD.read_text(encoding="utf-8"))
FELL = {"kind": "position", "unit": "um", "before": 72.4e-6, "after": 6.41e-6}


def test_the_page_is_written_from_the_record():
    page = first_sentences.RECORD.with_suffix(".md").read_text(encoding="utf-8")
    assert page == first_sentences.page_of(ROWS)


def test_every_published_set_with_data_has_a_row():
    assert {*ROWS, *first_sentences.BY_SCRIPT} == set(diagnose_published.NAMES)


@pytest.mark.parametrize("name", sorted(ROWS))
def test_a_first_sentence_is_short_and_has_the_errors_of_its_answer(name):
    assert first_sentences.amiss(ROWS[name]) == []


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
    assert first_sentences.amiss({"said": said, "errors": [FELL]}) == why


def test_errors_of_several_runs_are_their_root_mean_square():
    run = {"run": "a", "kind": "angle", "unit": "rad", "before": 3.0, "after": 0.0, "noise": 1.0}
    run |= {"num_samples": 1, "num_fitted": 0}
    other = {**run, "before": 0.0, "after": 2.0, "num_samples": 3}
    row = first_sentences.row_of({"headline": "Lag is missing.", "errors": [run, other]})
    assert row["errors"] == [
        {"kind": "angle", "unit": "rad", "before": 1.5, "after": pytest.approx(3.0**0.5)}
    ]
