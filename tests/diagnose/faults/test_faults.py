"""Faults of single groups: hidden ones are named, sound days stay silent, intervals hold."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.data import load_study
from diffsim.diagnose.faults import judge_faults, judging
from diffsim.diagnose.faults.verdict import (
    CERTAIN,
    SILENT,
    UNLISTED,
    least_visible,
    plain_words,
    weighted_quantiles,
)
from tests.diagnose.faults import days

NUM_SOUND = 12


def teachers(rng):
    """Sound days, and days with a known fault of the first reading."""
    runs = [r for k in range(NUM_SOUND) for r in days.group(f"sound{k}", rng, {}, "sound")]
    for k in range(4):
        runs += days.group(f"known{k}", rng, {"first": rng.uniform(0.1, 0.4)}, "first")
    return runs


@pytest.fixture(scope="module")
def judged():
    """Verdicts on 30 hidden groups, by label; the true sizes beside them."""
    rng = np.random.default_rng(5)
    runs, true = teachers(rng), {}
    for k in range(8):
        true[f"null{k}"] = {}
        true[f"first{k}"] = {"first": rng.uniform(0.25, 0.45)}
        true[f"rear{k}"] = {"rear": rng.uniform(0.25, 0.45)}
    for k in range(6):
        true[f"both{k}"] = {"first": rng.uniform(0.3, 0.45), "second": rng.uniform(0.3, 0.45)}
    for label, sizes in true.items():
        runs += days.group(label, rng, sizes)
    for k in range(2):
        runs += days.group(f"other{k}", rng, {}, off=-0.6)
    study = days.study(runs)
    report = judge_faults(study, days.setup(study))
    return {v.group: v for v in report.verdicts}, true, report


def test_only_groups_with_an_unknown_fault_are_judged(judged):
    verdicts, true, _ = judged
    assert set(verdicts) == {*true, "other0", "other1"}


def test_hidden_causes_are_named_and_nothing_else(judged):
    verdicts, true, _ = judged
    wrong = [k for k, sizes in true.items() if set(verdicts[k].causes) != set(sizes)]
    assert not wrong


def test_what_labels_of_other_groups_add_stands_apart(judged):
    """Of two explanations the odds by labels are those that the runs alone do not give."""
    verdicts, true, _ = judged
    added = {}
    for label in true:
        v = verdicts[label]
        lacking = [s for s in v.sets if not set(v.causes) <= set(s.causes)]
        if not v.causes or not lacking or lacking[0].probability_alone == 0.0:
            continue
        rival = lacking[0]  # sets come by probability
        whole = np.log(v.sets[0].probability / rival.probability)
        alone = np.log(v.sets[0].probability_alone / rival.probability_alone)
        assert v.lead_by_runs == pytest.approx(alone, abs=1e-6)
        assert v.lead_by_runs + v.lead_by_labels == pytest.approx(whole, abs=1e-6)
        added.setdefault(v.causes, []).append(v.lead_by_labels)
    # the known days had the first fault: labels speak for it, and against what was never seen
    assert min(added["first",]) > 0.5 > 0.0 > max(added["rear",])
    assert all(verdicts[f"null{k}"].lead_by_runs == 0.0 for k in range(8))


def test_sound_days_stay_silent_although_days_differ(judged):
    verdicts, _, _ = judged
    assert all(verdicts[f"null{k}"].status == SILENT for k in range(8))


def test_a_change_that_is_not_in_the_library_is_named_as_such(judged):
    verdicts, _, _ = judged
    assert [verdicts[f"other{k}"].status for k in range(2)] == [UNLISTED, UNLISTED]


def test_spreads_are_learned(judged):
    _, _, report = judged
    truth = {"shift": days.DAY, "gain_0, gain_1, gain_2, gain_3": days.GAIN, "now": days.NOW}
    for row in report.spreads:
        assert row.interval.low < truth[row.quantities] < row.interval.high
        assert row.interval.high < 4.0 * row.interval.low


def test_sizes_hold_what_was_hidden(judged):
    verdicts, true, _ = judged
    inside = [
        size.interval.low < true[label][size.cause] < size.interval.high
        for label, v in verdicts.items()
        for size in v.sizes
    ]
    assert len(inside) == 28
    assert sum(inside) >= 23  # 25 expected; fewer than 23 of 28 in one case of twenty


def test_words_say_the_size(judged):
    verdict = judged[0]["first0"]
    alike = {"b": 0.05512, "a": 0.05511, "c": 0.03}
    assert [name for name, _ in least_visible(alike)] == ["c", "b", "a"]  # no order of rounding
    assert verdict.status == CERTAIN
    assert verdict.words == f"First by {verdict.sizes[0].interval.value:.2f}."


def test_no_code_name_is_said_where_there_are_words(judged):
    """A cause without a size is said by its words, numbers that are its size by "some"."""
    for said, plain in (
        (lambda size: f"{size:.0%} more at rotor 1", "some more at rotor 1"),
        (lambda size: f"{100.0 * size:.0f} % more at rotor 1", "some more at rotor 1"),
        (lambda size: f"{size:.2g} N beyond 16 % duty", "some N beyond 16 % duty"),
        (None, "weight at 1 2"),
        (lambda size: "more " * round(100 * size), "weight at 1 2"),
    ):
        load = SimpleNamespace(name="weight_at_1_2", typical=0.05, words=said)
        assert plain_words(load) == plain
    for verdict in judged[0].values():
        assert {c for row in verdict.sets for c in row.causes} <= set(verdict.plain)
        assert verdict.plain.get("first", "first by some") == "first by some"
        assert all(" by 0" in said for said in verdict.visible if said.startswith("first"))


def test_a_group_does_not_teach_its_own_judge():
    """With few days, one that is far off would widen the scatter that it is judged by."""
    rng = np.random.default_rng(2)
    runs = [r for k in range(4) for r in days.group(f"sound{k}", rng, {}, "sound")]
    runs += days.group("odd", rng, {"first": 0.2}, "sound")
    study = days.study(runs)
    (verdict,) = judge_faults(study, days.setup(study), groups=["odd"]).verdicts
    assert verdict.causes == ("first",)
    assert verdict.is_right is False


def test_what_was_frequent_is_expected_more():
    rng = np.random.default_rng(7)
    runs = [*teachers(rng), *days.group("weak", rng, {"first": 0.12})]
    shares = []
    for learn_odds in (False, True):
        study = days.study(runs, learn_odds=learn_odds)
        (verdict,) = judge_faults(study, days.setup(study)).verdicts
        row = next(row for row in verdict.sets if row.causes == ("first",))
        shares.append(row.probability / row.probability_alone)
    assert shares[0] == pytest.approx(1.0)
    assert shares[1] > 1.2


def test_a_group_is_judged_in_the_state_that_it_is_in_although_nobody_says_which():
    rng = np.random.default_rng(11)
    runs = []
    for k in range(5):
        runs += days.group(f"old{k}", rng, {}, "sound", kit="old")
        runs += days.group(f"worn{k}", rng, {}, "sound", kit="worn")
    for kit in days.KITS:
        runs += days.group(f"sound in {kit}", rng, {}, kit=kit)
        runs += days.group(f"weak in {kit}", rng, {"first": 0.5}, kit=kit)
    hidden = [
        replace(r, setup={**r.setup, "kit": "unknown"}) if r.use == "test" else r for r in runs
    ]
    scatter = [["kit_0", "kit_1", "kit_2", "kit_3"], *days.SCATTER]
    verdicts = {}
    for name, given in (("with", {"state": "kit", "scatter": scatter}), ("without", {})):
        study = days.study(hidden, **given)
        report = judge_faults(study, days.setup(study))
        verdicts[name] = {v.group: v for v in report.verdicts}
    said = {label: set(v.causes) for label, v in verdicts["with"].items()}
    assert said["weak in old"] == said["weak in worn"] == {"first"}
    assert not any(said[f"sound in {kit}"] for kit in days.KITS)
    visible = {k: v["sound in worn"].smallest_visible["first"] for k, v in verdicts.items()}
    assert visible["with"] < 0.6 * visible["without"]  # kits pass for scatter between days


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scatter": ["shft"]}, "no fitted quantity 'shft'; did you mean 'shift'"),
        ({"scatter": ["level_0"]}, "state level_0 `per: day` or per run"),
        ({"scatter": [["shift", "now"]]}, "shift, now need the same sd"),
        ({"per": "dy"}, "no dy in its setup"),
        ({"together": ["frst"]}, "no cause 'frst'; did you mean 'first'"),
        ({"known": {"fact": "said", "causes": {"nothing": []}}}, "needs at least three"),
    ],
)
def test_mistakes_are_said_in_terms_of_the_keys(changes, message):
    rng = np.random.default_rng(1)
    study = days.study([r for k in range(4) for r in days.group(f"d{k}", rng, {}, "sound")])
    study = days.study(study.runs, **changes)
    with pytest.raises(ValueError, match=message):
        judge_faults(study, days.setup(days.study(study.runs)))


def test_quantiles_of_weighted_samples():
    values, weights = np.array([3.0, 1.0, 2.0]), np.array([0.1, 0.8, 0.1])
    assert weighted_quantiles(values, weights, (0.05, 0.95)) == (1.0, 3.0)
    assert weighted_quantiles(values, weights, (0.0, 1.0)) == (1.0, 3.0)
    assert weighted_quantiles(values, weights, (0.85, 0.89)) == (2.0, 2.0)


def test_new_runs_are_entries_like_those_of_the_file(tmp_path):
    (tmp_path / "a.csv").write_text("time_s,y\n0,1\n1,2\n")
    (tmp_path / "b.csv").write_text("time_s,y\n0,3\n1,4\n")
    (tmp_path / "study.yaml").write_text(
        "name: s\nmodel: {system: bench, readings: {y: '0'}}\n"
        "channels: [{name: y, unit: m, sd: 1}]\nruns: [{name: a, file: a.csv}]\n"
    )
    more = [{"name": "b", "file": str(tmp_path / "b.csv"), "use": "test", "setup": {"day": "x"}}]
    study = load_study(tmp_path, more)
    assert [run.name for run in study.runs] == ["a", "b"]
    assert study.test_runs[0].setup == {"day": "x"}


def test_groups_are_judged_by_one_thread(monkeypatch):
    """Arrays are small: with two threads of torch the same took four times the CPU seconds."""
    seen = []

    def interrupted(*args):
        seen.append(torch.get_num_threads())
        raise InterruptedError

    monkeypatch.setattr(judging, "take_apart", interrupted)
    study = days.study(teachers(np.random.default_rng(5)))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(InterruptedError):
            judge_faults(study, days.setup(study))
        assert seen == [1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
