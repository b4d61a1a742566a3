"""Thresholds that are listed, set, judged with, and counted."""

from __future__ import annotations

import json

import pytest

from diffsim.diagnose.judge import judge as judge_module
from diffsim.diagnose.search import evidence
from labs.calibration import __main__ as command
from labs.calibration import answers
from labs.calibration.answers import judge_again, judged, store, variant
from labs.calibration.table import moved, page
from labs.calibration.thresholds import FACTORS, JUDGE, Threshold, bound_early, changed, listed
from labs.rates.case import case_inputs

ADVICE = "diagnose.say.next_run"  # which run to record next is no verdict


@pytest.mark.parametrize("threshold", listed(), ids=lambda t: t.key)
def test_every_threshold_is_there_and_can_be_set(threshold):
    assert threshold.acts in ("search", JUDGE) and threshold.decides and threshold.chosen
    assert isinstance(threshold.value, (int, float))
    half, double = (threshold.times(f) for f in FACTORS)
    assert half != threshold.value or threshold.value == 1
    assert double != threshold.value
    if threshold.of_rest:
        assert 0.5 < threshold.value < 1.0 and double < threshold.value < half < 1.0
    assert not [where for where in bound_early(threshold) if not where.startswith(ADVICE)]


def test_no_threshold_is_listed_twice():
    keys = [t.key for t in listed()]
    assert len(keys) == len(set(keys))


def test_a_value_that_is_taken_at_import_is_told():
    assert bound_early(Threshold("diagnose.checks.noise", "MAX_ORDER", JUDGE, "x"))
    assert not bound_early(Threshold("diagnose.judge.gain", "MIN_BLOCKS", JUDGE, "x"))


def test_a_changed_threshold_reaches_all_that_import_it_and_comes_back():
    (threshold,) = (t for t in listed() if t.name == "KEEP_NATS")
    before = evidence.KEEP_NATS
    with pytest.raises(RuntimeError, match="stop"), changed(threshold, 2.0):
        assert 2.0 * before == evidence.KEEP_NATS == judge_module.KEEP_NATS
        raise RuntimeError("stop")
    assert before == evidence.KEEP_NATS == judge_module.KEEP_NATS


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A force stand that is diagnosed within a second."""
    studies = tmp_path_factory.mktemp("studies")
    return {"master": 2, "domain": "bench", "index": 4, "effort": "quick", "studies": str(studies)}


def test_one_search_is_judged_with_every_threshold(case, monkeypatch):
    """Judged again as it was, the answer is the same; a surer "certain" changes its words."""
    seen = {}

    def spy(kept, inputs):
        seen.setdefault("same", answers._brief(seen["made"], lambda: judge_again(kept, inputs)))
        return judge_again(kept, inputs)

    seen["made"] = store(case)
    monkeypatch.setattr(answers, "judge_again", spy)
    chosen = [t for t in listed() if t.name in ("MEMORY", "EXPLAINED", "SURE")]
    monkeypatch.setattr(answers, "listed", lambda: chosen)
    found = judged(case)
    assert set(found) == {"plain", *(variant(t, f) for t in chosen for f in FACTORS)}
    assert found["plain"]["outcome"] != "no answer"
    assert seen["same"] == found["plain"]


def test_a_stored_case_is_made_once(case, monkeypatch):
    made = store(case)
    monkeypatch.setattr(answers, "make", lambda *_: pytest.fail("the case was made again"))
    assert store(case) == made
    assert case_inputs(made, made["study"], "quick").study.runs


def test_a_case_that_cannot_be_recorded_has_no_answers(case, monkeypatch):
    def fail(*_):
        raise RuntimeError("step size is less than spacing between numbers")

    monkeypatch.setattr(answers, "make", fail)
    assert judged({**case, "index": 5}) == {}


def brief(outcome, verdict="named", named=("lag",)):
    return {"outcome": outcome, "verdict": verdict, "named": list(named), "rivals": [],
            "is_certain": []}  # fmt: skip


def test_changes_are_counted_by_hand():
    plain = {"a": brief("right"), "b": brief("certain wrong"), "c": brief("right", "none", ())}
    other = {"a": brief("right"), "b": brief("right", named=("drag",)),
             "c": brief("false alarm", "unknown", ())}  # fmt: skip
    assert moved(plain, other) == {
        "answered": 3, "verdicts": 1, "words": 2, "right": 0, "certain wrong": -1, "false alarm": 1
    }  # fmt: skip
    (threshold,) = (t for t in listed() if t.name == "SURE")
    found = {"plain": plain, **{variant(threshold, f): other for f in FACTORS}}
    options = {"domain": ("bench",), "n": 3, "master": 1, "effort": "quick"}
    text = page(found, dict.fromkeys("abc"), options, "0123456789ab")
    (line,) = (row for row in text.splitlines() if row.startswith(f"| `{threshold.key}`"))
    assert line.endswith("| 1 (2) of 3, 0, -1, +1 | 1 (2) of 3, 0, -1, +1 |")
    assert f"1 of {len(listed())} thresholds are counted; 0 of these change no" in text


def test_the_command_makes_so_many_answers_and_goes_on(tmp_path, monkeypatch):
    asked = []

    def plain(item):
        return {"plain": brief("right")} if item["index"] < 2 else {}  # the third is not recorded

    def fake(item):
        asked.append((item["key"], item["factor"], item["index"]))
        return brief("right")

    monkeypatch.setattr(command, "head", lambda: ("c" * 40, ""))
    monkeypatch.setattr(command, "judged", plain)
    monkeypatch.setattr(command, "searched", fake)
    call = ["--domain", "bench", "--n", "3", "--only", "KEEP_NATS", "--out", str(tmp_path)]
    assert command.main([*call, "--most", "3"]) == 0
    assert len(asked) == 3
    assert command.main([*call, "--most", "3"]) == 0
    assert len(asked) == len(set(asked)) == 4
    text = (tmp_path / "thresholds.md").read_text()
    assert "| 0 (0) of 2, 0, 0, 0 | 0 (0) of 2, 0, 0, 0 |" in text
    kept = json.loads(next((tmp_path / "searched").glob("*.json")).read_text())
    assert kept["result"]["outcome"] == "right"
    assert command.main(["--domain", "tyo", "--out", str(tmp_path)]) == 2
