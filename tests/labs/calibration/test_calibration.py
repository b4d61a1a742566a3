"""Thresholds that are listed, set, followed, answered with, and counted."""

import json
import math
import operator

import numpy as np
import pytest
import torch

from diffsim.diagnose.judge import judge as judge_module
from diffsim.identify import effort
from labs.calibration import __main__ as command
from labs.calibration import answers
from labs.calibration.answers import changed, followed, store
from labs.calibration.probe import Probe, probed
from labs.calibration.table import moved, page
from labs.calibration.thresholds import FACTORS, Threshold, bound_early, listed, put, variant
from labs.rates.case import case_inputs

ADVICE = "diagnose.say.next_run"  # which run to record next is no verdict


@pytest.mark.parametrize("threshold", listed(), ids=lambda t: t.key)
def test_every_threshold_is_there_and_can_be_set(threshold):
    assert threshold.decides and threshold.chosen
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
    assert bound_early(Threshold("diagnose.checks.noise", "MAX_ORDER", "x"))
    assert not bound_early(Threshold("diagnose.judge.gain", "MIN_BLOCKS", "x"))


def test_a_changed_threshold_reaches_all_that_import_it_and_comes_back():
    (threshold,) = (t for t in listed() if t.name == "KEEP_NATS")
    before = effort.KEEP_NATS
    with pytest.raises(RuntimeError, match="stop"), put(threshold, threshold.times(2.0)):
        assert 2.0 * before == effort.KEEP_NATS == judge_module.KEEP_NATS
        raise RuntimeError("stop")
    assert before == effort.KEEP_NATS == judge_module.KEEP_NATS


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A force stand that is diagnosed within a second."""
    studies = tmp_path_factory.mktemp("studies")
    return {"master": 2, "domain": "bench", "index": 4, "effort": "quick", "studies": str(studies)}


@pytest.mark.story
def test_what_is_not_asked_cannot_change_the_answer(case):
    found = followed(case)
    assert found["followed"] and found["plain"]["outcome"] != "no answer"
    spared = [t for t in listed() if not {variant(t, f) for f in FACTORS} & {*found["asked"]}]
    assert 10 < len(spared) < len(listed()) - 10
    same = {**case, "key": spared[0].key, "factor": 2.0}
    assert changed(same) == found["plain"]


def test_an_answer_that_cannot_be_followed_is_asked_by_all(case, monkeypatch):
    def fail(item, made):
        if isinstance(effort.KEEP_NATS, Probe):
            raise TypeError("must be real number, not Probe")
        return {"verdict": "none"}

    monkeypatch.setattr(answers, "brief", fail)
    found = followed(case)
    assert not found["followed"] and len(found["asked"]) == 2 * len(listed())


def probe(value, **ways):
    noted = set()
    return Probe(value, ways, noted), noted


FOLLOWED = {
    "compared": (lambda p: p > 3.5, {"double"}),
    "compared from the left": (lambda p: operator.lt(1.5, p), {"half"}),
    "far from both": (lambda p: p < 100.0, set()),
    "a product": (lambda p: 1.0 + 2.0 * p > 6.5, {"double"}),
    "the larger": (lambda p: max(p, 5.0) > 4.5, set()),
    "an array": (lambda p: np.array([1.5, 10.0]) < p, {"half"}),
    "an array's ufunc": (lambda p: np.maximum(np.array([9.0]), p) > 8.0, set()),
    "a number of NumPy": (lambda p: np.float64(3.0) < p, {"double"}),
    "left to the C library": (lambda p: math.sqrt(p), {"half", "double"}),
    "left to an array": (lambda p: np.where([True], p, 1.0), {"half", "double"}),
    "left to torch": (lambda p: torch.ones(2) * p, {"half", "double"}),
    "a slice": (lambda p: [1, 2, 3][: Probe(2, p._ways, p._noted)], {"half", "double"}),
    "a condition": (lambda p: bool(p - 1.0), {"half"}),
    "a key": (lambda p: {p: 1}, {"half", "double"}),
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_a_number_is_followed_at_all_its_values(name):
    work, asked = FOLLOWED[name]
    number, noted = probe(2.0, half=1.0, double=4.0)
    plain = work(number)
    if name not in ("a slice", "a key"):
        assert np.array_equal(np.asarray(plain), np.asarray(work(probe(2.0)[0])))
    assert noted == asked


def test_two_thresholds_are_followed_together():
    noted = set()
    first, second = Probe(2.0, {"a": 1.0}, noted), Probe(3.0, {"b": 9.0}, noted)
    assert first * second < 10.0 and noted == {"b"}
    assert float(first + 1.0) == 3.0 and noted == {"a", "b"}


def test_thresholds_are_plain_again_afterwards():
    with probed() as noted:
        assert isinstance(judge_module.KEEP_NATS, Probe)
        assert effort.KEEP_NATS < 1e9 and not noted
        assert not effort.KEEP_NATS >= 5.0
        assert noted == {"identify.effort.KEEP_NATS_x2"}
    assert judge_module.KEEP_NATS == effort.KEEP_NATS == 4.0
    assert isinstance(effort.KEEP_NATS, float)


def test_a_stored_case_is_made_once(case, monkeypatch):
    made = store(case)
    monkeypatch.setattr(answers, "make", lambda *_: pytest.fail("the case was made again"))
    assert store(case) == made
    assert case_inputs(made, made["study"], "quick").study.runs


def test_a_case_that_cannot_be_recorded_has_no_answers(case, monkeypatch):
    def fail(*_):
        raise RuntimeError("step size is less than spacing between numbers")

    monkeypatch.setattr(answers, "make", fail)
    assert followed({**case, "index": 5}) == {}


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
    names = [variant(threshold, f) for f in FACTORS]
    first = {f"bench_{k}": {"plain": p, "asked": names[1:], "followed": k != "a"}
             for k, p in plain.items()}  # fmt: skip
    again = {names[1]: {f"bench_{k}": other[k] for k in "ab"}}
    options = {"domain": ("bench",), "n": (3,), "master": 1, "effort": "quick", "again": 2}
    text = page(first, again, options, "0123456789ab")
    (line,) = (row for row in text.splitlines() if row.startswith(f"| `{threshold.key}`"))
    assert line.endswith("| 0 | – | 3 | 0 (1) of 2, +1, -1, 0 |")
    assert f"{len(listed()) - 1} are asked by no case, 0 change no answer" in text
    assert "(3 bench)" in text and "2 cases could be followed" in text


def test_the_command_answers_again_what_may_change_and_goes_on(tmp_path, monkeypatch):
    seen = []
    name = next(variant(t, FACTORS[0]) for t in listed() if t.name == "KEEP_NATS")

    def follow(item):  # the third is not recorded
        asked = {"plain": brief("right"), "asked": [name], "followed": True}
        return asked if item["index"] < 2 else {}

    def change(item):
        seen.append((item["key"], item["factor"], item["domain"], item["index"]))
        if len(seen) == 2:
            raise KeyboardInterrupt
        return brief("right")

    monkeypatch.setattr(command, "head", lambda: ("c" * 40, ""))
    monkeypatch.setattr(command, "followed", follow)
    monkeypatch.setattr(command, "changed", change)
    call = ["--domain", "toy,bench", "--n", "1,3", "--again", "2", "--out", str(tmp_path)]
    assert command.main(call) == 130
    assert command.main(call) == 0
    # the domain with more cases first; what was kept is not answered again
    assert [one[2:] for one in seen] == [("bench", 0), ("bench", 1), ("bench", 1)]
    assert "| 3 | 0 (0) of 2, 0, 0, 0 | 0 | – |" in (tmp_path / "thresholds.md").read_text()
    kept = json.loads(next((tmp_path / "changed").glob("*.json")).read_text())
    assert kept["result"]["outcome"] == "right"
    assert command.main(["--domain", "tyo", "--out", str(tmp_path)]) == 2
    assert command.main(["--domain", "toy", "--n", "1,2", "--out", str(tmp_path)]) == 2
