"""A verdict on every cause: what is certain, what cannot be told, what a data sheet has wrong."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.data.study import Study
from diffsim.diagnose import Report, diagnose
from diffsim.diagnose.judge.averaging import Widening, _interval, widening
from diffsim.diagnose.judge.data_sheet import _pulled_together, base_rows, pull_limit
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.judge import Decision, Judgment
from diffsim.diagnose.judge.left_out import folds_of
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.preconditions import singled_out
from diffsim.diagnose.judge.records import BaseRow, CauseRow, ErrorRow
from diffsim.diagnose.say import assemble
from diffsim.diagnose.say.causes import CauseEvidence, _finding_row, _is_hollow, _rise_without
from diffsim.diagnose.say.headline import _on_unseen, first_of, headline
from diffsim.diagnose.say.wording import Answer, _first, _sets, component_words, opened
from diffsim.identify import DiagnosisSettings, SearchSettings, fit
from diffsim.identify.model import Parameter, SimModel
from tests.diagnose import linear

QUICK = DiagnosisSettings(search=SearchSettings(num_refits=4))
PUSH, OTHER = linear.line("push"), linear.line("other", family="twins")
DOUBLE = replace(OTHER, name="double")
"""Exactly the other one under another name."""


def recorded(name, seed, sizes, base=(0.0, 0.0), **changes):
    """A run with effects of known sizes, base parameters some prior sd off."""
    run, model = linear.run(name, seed, **changes), linear.model()
    given = {effect: torch.tensor([size]).double() for effect, size in sizes.items()}
    clean = model.predict(run, torch.tensor(base, dtype=torch.float64), given)
    return replace(run, measured=run.measured + clean.numpy())


def diagnosed(sizes, effects, num=6, tests=2, **options) -> Report:
    runs = [recorded(f"r{k}", k, sizes, **options) for k in range(num)]
    runs += [recorded(f"t{k}", 50 + k, sizes, use="test", **options) for k in range(tests)]
    study = Study("lines", "copter", linear.CHANNELS, tuple(runs))
    return diagnose(study, linear.model(), effects, seed=0, settings=QUICK)


def causes(report: Report) -> dict[str, CauseRow]:
    return {row.name: row for row in report.causes}


@pytest.fixture(scope="module")
def shared():
    """A certain push beside one of two causes that no data can tell apart."""
    return diagnosed({PUSH: 1.0, OTHER: 0.8}, (PUSH, OTHER, DOUBLE))


@pytest.mark.parametrize(("num", "tests", "status"), [(1, 0, "likely"), (1, 1, "certain")])
def test_nothing_is_certain_by_a_single_recording(num, tests, status):
    found = diagnosed({PUSH: 3.0}, (PUSH,), num=num, tests=tests)
    assert found.named == ("push",)
    assert causes(found)["push"].status == status


@pytest.mark.parametrize(("tests", "status"), [(0, "likely"), (1, "certain")])
def test_a_data_sheet_beside_a_cause_is_no_surer_than_that(tests, status):
    found = diagnosed({PUSH: 3.0}, (PUSH,), num=1, tests=tests, base=(6.0, 0.5))
    rows = causes(found)
    assert (rows["push"].status, rows["mass"].status) == (status, status)


def test_what_all_rivals_share_is_certain_though_the_rest_cannot_be_told(shared):
    found = causes(shared)
    assert (shared.verdict, shared.named) == ("named", ("push",))
    assert {frozenset(r) for r in shared.rivals} == {
        frozenset({"push", "other"}),
        frozenset({"push", "double"}),
    }
    assert found["push"].status == "certain" and found["push"].probability > 0.99
    for name, twin in (("other", "double"), ("double", "other")):
        assert (found[name].status, found[name].rivals) == ("cannot be told from", (twin,))
        # half each, and the sets that hold both
        assert 0.5 <= found[name].probability < 0.7
    # the extended model holds one of the two: it helps, its name is not known
    assert {e.name for e in shared.best.problem.effects} > {"push"}
    assert sum(found[name].helps for name in ("other", "double")) == 1


def test_probabilities_are_shares_of_evidence(shared):
    evidence = np.array([np.exp(h.nats) for h in shared.hypotheses])
    for name, row in causes(shared).items():
        holding = np.array([name in h.effects for h in shared.hypotheses])
        assert row.probability == pytest.approx(evidence[holding].sum() / evidence.sum(), rel=1e-6)


def test_sizes_hold_the_truth_and_nothing_named_is_invisible(shared):
    push = causes(shared)["push"].size["size"]
    assert push.low < 1.0 < push.high and push.high - push.low < 0.6
    assert not set(shared.cannot_see) & {"push", "other", "double"}
    for row in shared.causes:
        if row.status == "certain":
            assert all(abs(row.size[c].value) > s for c, s in row.smallest_visible.items())


def test_quantiles_are_those_of_the_mixture():
    from scipy import stats

    weights, mean, sd = np.array([0.3, 0.7]), np.array([1.0, 3.0]), np.array([0.2, 0.5])
    found = _interval(weights, mean, sd, PUSH)
    for q, p in ((found.low, 0.05), (found.high, 0.95)):
        assert weights @ stats.norm.cdf((q - mean) / sd) == pytest.approx(p, abs=1e-6)
    assert found.value == pytest.approx(2.4)
    cut = _interval(np.ones(1), np.array([0.1]), np.array([1.0]), replace(PUSH, signed=False))
    assert cut.low == 0.0


def test_a_data_sheet_that_is_wrong_is_a_finding_and_never_noise():
    report = diagnosed({}, (PUSH,), base=(6.0, 0.5))
    assert (report.verdict, report.named, report.findings) == ("data_sheet", (), ("mass",))
    row = causes(report)["mass"]
    assert (row.origin, row.status, row.unit) == ("data sheet", "certain", "kg")
    assert row.size["size"].low < 0.3 + 6.0 * 0.7 < row.size["size"].high
    assert not any("noise: no effect" in s for s in report.sentences)
    assert any("the data sheet says 0.3 +- 0.7 kg" in s for s in report.sentences)
    assert report.headline.startswith("Only a data sheet is off: mass is 4.")
    assert not report.causes_with("certain", "likely", origin="effect")
    base = {b.name: b for b in report.base}
    assert base["mass"].finding and base["mass"].pull == pytest.approx(6.0, abs=0.5)
    assert not base["gain"].finding


def test_an_interval_that_holds_the_data_sheet_is_no_finding():
    """Far off by its best value, and widened to decades by runs that disagree."""
    report = diagnosed({}, (PUSH,), base=(6.0, 0.5))
    best = report.best
    rows = {
        wide: base_rows(best, best.problem.runs, Widening(usual=wide), judged=True)
        for wide in (1.0, 1e4)
    }
    found = {w: [r.name for r in made if r.finding] for w, made in rows.items()}
    assert found == {1.0: ["mass"], 1e4: []}


def test_of_many_data_sheets_one_is_far_off_by_chance():
    """One right description in a hundred has a finding, however many parameters it has."""
    rng = np.random.default_rng(0)
    for num in (1, 12, 40):
        made = [Parameter(f"p{k}@run_{r}", 1.0, 0.1) for k in range(num) for r in range(3)]
        limit = pull_limit(made)
        off = (np.abs(rng.normal(size=(20_000, num))) > limit).any(axis=1).mean()
        assert off == pytest.approx(0.01, abs=0.003)


def test_symbols_keep_their_case():
    """m and M are two parameters of one cart."""
    assert [opened(t) for t in ("m", "kp of a", "mass")] == ["m", "kp of a", "Mass"]


def test_small_lengths_of_data_sheets_are_read_in_millimeters():
    row = BaseRow("bore", "bore", "m", 9.12e-4, 5e-6, 9.04e-4, 9.2e-4, 1e-3, 1e-5, -8.8, 3.0)
    read = row.as_read()
    assert (read.unit, read.value, read.prior_sd) == (
        "mm",
        pytest.approx(0.912),
        pytest.approx(0.01),
    )
    assert replace(row, value=0.3).as_read() == replace(row, value=0.3)
    assert replace(row, unit="Pa").as_read() == replace(row, unit="Pa")


def test_a_null_has_no_cause_and_no_finding():
    report = diagnosed({}, (PUSH, OTHER))
    assert (report.verdict, report.findings) == ("none", ())
    assert all(row.status not in ("certain", "likely") for row in report.causes)
    assert report.headline.startswith("Nothing is missing that these runs could show")


@pytest.mark.parametrize("tests", [0, 2])
@pytest.mark.parametrize(
    ("sizes", "effects"),
    [
        ({}, (PUSH,)),
        ({PUSH: 1.0}, (PUSH,)),
        ({OTHER: 1.0}, (OTHER, DOUBLE)),
        ({PUSH: 1.0, OTHER: 1.0}, (PUSH, OTHER)),
    ],
)
def test_headlines_are_short_and_say_the_error(sizes, effects, tests):
    report = diagnosed(sizes, effects, tests=tests)
    assert len(first_of(report.headline).split()) <= 25 and report.headline.endswith(".")
    assert "_" not in report.headline
    assert bool(re.search(r"\d m\b", report.headline)) == bool(tests)
    assert tests or "test" in report.headline
    assert tests or any("No gain is known" in s for s in report.sentences)


def test_a_cause_may_say_its_size_in_words():
    limit = replace(PUSH, name="rate_limit", words=lambda s: f"a speed limit near {1 / s:.1g} m/s")
    report = diagnosed({PUSH: 1.0}, (limit,))
    # the shapes of a linear effect go by the name that it was made with
    assert report.headline.startswith("A speed limit near 1 m/s is missing:")


def test_a_cause_that_acts_says_what_else_has_its_form():
    twin = replace(PUSH, also_looks_like=("a lever of another length", "a scale"))
    (row,) = diagnosed({PUSH: 1.0}, (twin,)).causes
    assert row.note.endswith("May as well be: a lever of another length; a scale.")
    (row,) = diagnosed({}, (twin,)).causes
    assert row.status not in ("certain", "likely") and "May as well" not in row.note


def test_a_rival_without_a_cause_has_a_name():
    """A stranger read "cannot tell it from  or meter_gain_2", and "cannot tell it from ."."""
    report = diagnosed({PUSH: 1.0}, (PUSH,))
    decision = Decision("ambiguous", frozenset((0,)), (), None, 0.7)
    answer = Answer("ambiguous", decision, report.causes, (), (), None, best_names=(PUSH.name,))
    assert _first(answer).endswith("but not so clearly that it is certain.")
    said = _sets(answer, [(), ("other",)], "a wrong data sheet")
    assert said == "a wrong data sheet or other"


def test_a_size_in_a_unit_of_its_own_is_read_in_it():
    report = diagnosed({PUSH: 1.0}, (replace(PUSH, shown_unit="%", shown_times=100.0),))
    row = next(r for r in report.causes if r.name == PUSH.name)
    read = row.as_read()
    assert read.unit == "%"
    assert read.size["size"].value == pytest.approx(100.0 * row.size["size"].value)


def test_a_headline_does_not_praise_what_helps_nothing():
    row = ErrorRow("t", "position", "mm", 2.0, 2.0, 1.0, 100, 0)
    said = {after: _on_unseen([replace(row, after=after)], True, None)[0] for after in (1, 2, 3)}
    assert said[1].startswith(": error on unseen runs 2 to 1 mm")
    assert "stays at 2 mm" in said[2] and "rises from 2 to 3 mm" in said[3]


def test_a_headline_claims_no_gain_that_is_not_confirmed():
    """A device's error of 0.133 to 0.132 was said as a gain, with an interval across zero."""
    rows = [
        ErrorRow("t", "position", "mm", 0.133, 0.130, 0.01, 100, 0),
        ErrorRow("t", "force", "N", 2.0, 3.0, 1.0, 100, 0),
    ]
    push = CauseRow("push", "push", "effect", "certain", 1.0, {}, "N", removes=1.0)
    answer = Answer("named", None, (push,), (), (), None, named=("push",))

    def said(rows, low, value, high):
        return headline(answer, rows, (), Gain(value, low, high, 2.0, 9))

    sure = said(rows[:1], 0.1, 0.2, 0.3)
    assert sure == "Push is missing: error on unseen runs 0.133 to 0.13 mm, noise 0.01 mm."
    unsure = said(rows[:1], -0.1, 0.2, 0.3)
    assert unsure == f"{sure} Not certain: the gain may be chance on unseen runs."
    told = said(rows[:1], -0.5, -0.2, 0.3)
    assert told == f"{sure} Not certain: no gain is confirmed on unseen runs."
    assert "rises from 2 to 3 N" in said(rows, -0.9, -0.5, -0.2)


def test_the_page_of_a_small_gain_does_not_praise_it():
    """On the unseen run the push is half as large: with it, the error is hardly smaller."""
    runs = [recorded(f"r{k}", k, {PUSH: 1.0}) for k in range(4)]
    runs.append(recorded("last", 9, {PUSH: 0.35}, use="test"))
    study = Study("once", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (PUSH,), seed=0, settings=QUICK)
    assert report.gain is not None and report.gain.status == "not confirmed"
    row = report.errors[0]
    assert row.after < 0.99 * row.before
    assert "the gain may be chance on unseen runs" in report.headline
    assert len(first_of(report.headline).split()) <= 25


def test_with_an_unknown_cause_the_extended_model_holds_what_helps():
    curve = np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, linear.NUM_SAMPLES))

    def drifting(name, seed, amplitude, **changes):
        run = recorded(name, seed, {PUSH: 1.2}, **changes)
        moved = run.measured.copy()
        moved[:, 0] += amplitude * curve
        return replace(run, measured=moved)

    runs = [
        replace(drifting(f"r{k}", k, (3.0, -4.0, 3.5)[k // 2]), group=f"g{k // 2}")
        for k in range(6)
    ]
    runs.append(drifting("last", 9, -3.0, use="test"))
    study = Study("drifting", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (PUSH,), seed=0, settings=QUICK)
    row = causes(report)["push"]
    assert (report.verdict, report.named) == ("unknown", ())
    assert row.status == "cannot be told from" and "unknown drift of a" in row.rivals
    assert row.helps and [e.name for e in report.best.problem.effects] == ["push"]
    assert any("helps, but is not named" in s for s in report.sentences)
    assert report.gain is not None and report.gain.value > 0.0
    assert 0.2 < report.unknown_share < 1.0


def test_intervals_cover_where_runs_differ_by_more_than_noise():
    """The push differs from run to run: noise alone would make the interval too narrow."""
    rng, inside, narrow = np.random.default_rng(0), 0, 0
    for seed in range(20):
        sizes = rng.normal(1.0, 0.4, 6)
        runs = [recorded(f"r{k}", 100 * seed + k, {PUSH: s}) for k, s in enumerate(sizes)]
        found = fit(linear.model(), runs, linear.CHANNELS, effects=(PUSH,))
        folds = folds_of(found)
        assert folds is not None
        away, half = abs(found.values["push"] - 1.0), 1.645 * found.sd["push"]
        inside += away <= half * widening(found).factors["push"]
        narrow += away <= half
    # 90 % of 20 is 18 +- 1.3
    assert narrow <= 15 < 16 <= inside


def test_intervals_of_a_runs_own_numbers_are_widened_with_what_runs_share():
    """The push differs from run to run, and a wind of each run stands in for the difference."""
    rng, inside, narrow = np.random.default_rng(0), 0, 0
    names = [f"r{k}" for k in range(6)]

    def build(values, run, numerics):
        push = linear.shapes("push", run)[..., 0]
        wind = 0.7 * push + 0.7 * linear.shapes("wind", run)[..., 0]
        own = {n: v for n, v in values.items() if n == f"wind@{run.name}"}
        return linear.LinearScene(values["push"] * push + sum(own.values()) * wind)

    base = [Parameter("push", 0.8, 3.0, "N"), *(Parameter(f"wind@{n}", 0.0, 3.0) for n in names)]
    model = SimModel(build, base, "winds")
    for seed in range(10):
        runs = []
        for k, name in enumerate(names):
            run = linear.run(name, 100 * seed + k)
            values = {"push": rng.normal(1.0, 0.8), f"wind@{name}": 0.5}
            with torch.no_grad():
                moved = build(values, run, None).record.numpy()
            runs.append(replace(run, measured=run.measured + moved))
        found = fit(model, runs, linear.CHANNELS)
        wider = widening(found).factors
        for name in (f"wind@{n}" for n in names):
            away, half = abs(found.values[name] - 0.5), 1.645 * found.sd[name]
            inside += away <= half * wider[name]
            narrow += away <= half
    assert narrow < 42 and 50 <= inside < 60  # 90 % of 60 are 54 +- 2.3, were all independent


def test_intervals_of_a_right_model_are_hardly_widened():
    factors = []
    for seed in range(8):
        runs = [recorded(f"r{k}", 100 * seed + k, {PUSH: 1.0}) for k in range(6)]
        found = fit(linear.model(), runs, linear.CHANNELS, effects=(PUSH,))
        factors.append(widening(found).factors["push"])
    assert np.median(factors) < 1.25 and min(factors) == 1.0


def test_code_names_become_words():
    assert words_of("sliding_friction") == "sliding friction"
    assert words_of("thrust_exponent[propeller=A]") == "thrust exponent (propeller A)"
    assert words_of("offset@run_3") == "offset of run_3"
    assert words_of("joint.FR_calf_joint.damping") == "damping of FR_calf_joint"
    assert words_of("joint.root.start[2]@run_3") == "start of root (2) in run_3"


def test_a_place_is_read_as_the_study_names_it():
    """It was "dry friction at fr calf joint", which no file of the user holds."""
    assert words_of("dry_friction_at_FR_calf_joint") == "dry friction at FR_calf_joint"
    assert words_of("command_gain_of_tendon1_N@run_3") == "command gain of tendon1_N of run_3"
    assert words_of("half_of_friction_at_FR_calf") == "half of friction at FR_calf"
    assert words_of("exchanged_commands_of_FL_hip_and_FR_hip").endswith("FL_hip and FR_hip")
    assert words_of("bias_of_all_commands_in_N_m") == "bias of all commands in N m"
    assert words_of("unknown force at FR_calf_joint") == "unknown force at FR_calf_joint"
    assert component_words("FR_calf") == "FR_calf"
    assert component_words("[propeller=HQ_5x4]") == "propeller HQ_5x4"
    assert component_words("[battery=half_full]") == "battery half full"


def test_what_stands_in_for_a_withdrawn_cause_is_not_certain():
    """The fit runs ask for a cause that the select runs refuse; another one mimics a part of it."""
    strong = linear.line("strong")

    def mimic(scene, size, run):
        shape = linear.shapes("mimic", run)[..., 0]
        if run.use == "fit":
            shape = 0.6 * linear.shapes("strong", run)[..., 0] + 0.8 * shape
        return replace(scene, record=scene.record + shape * size)

    weak = replace(linear.line("mimic"), apply=mimic)
    runs = [recorded(f"r{k}", k, {strong: 1.2}) for k in range(6)]
    runs += [recorded(f"s{k}", 40 + k, {strong: -0.6, weak: 0.6}, use="select") for k in range(2)]
    study = Study("refused", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (strong, weak), seed=0, settings=QUICK)
    assert causes(report)["strong"].status == "refuted"
    assert causes(report)["mimic"].status != "certain" and report.named == ()


def test_a_size_whose_widened_interval_holds_zero_is_not_certain(monkeypatch):
    seen = []

    def keeping(grounds):
        seen.append(grounds)
        return singled_out(grounds)

    monkeypatch.setattr(assemble, "singled_out", keeping)
    assert diagnosed({PUSH: 1.0}, (PUSH,)).named == ("push",)
    (grounds,) = seen
    wide = grounds.search.wide
    factors = {wide.names[wide.columns_of(PUSH)[0]]: 100.0}
    vague = replace(grounds, about=replace(grounds.about, factors=factors))
    assert vague.about.size(0)["size"].low < 0.0
    assert singled_out(vague) == frozenset()
    useless = replace(grounds.judgment, gains={0: Gain(-0.2, -0.3, 0.0, 1.0, 5)})
    assert singled_out(replace(grounds, judgment=useless)) == frozenset()


def _row(run, pull):
    return BaseRow(
        f"onset@{run}",
        f"onset of {run}",
        "s",
        0.015 * pull,
        0.001,
        0.015 * pull - 0.002,
        0.015 * pull + 0.002,
        0.0,
        0.015,
        pull,
        3.0,
        run,
    )


def test_what_all_runs_pull_alike_is_one_finding_under_its_own_name():
    rows = [_row(name, pull) for name, pull in zip("abcd", (-2.0, -2.5, -3.0, -2.5), strict=True)]
    (found,) = _pulled_together(rows)
    assert (found.name, found.words, found.run) == ("onset", "onset in all runs", None)
    assert found.value == pytest.approx(-0.0375) and found.pull == pytest.approx(-5.0)
    assert (found.low, found.high) == (pytest.approx(-0.047), pytest.approx(-0.028))
    assert not _pulled_together([*rows[:3], _row("d", 0.5)])


def test_a_test_run_that_cannot_be_simulated_costs_the_gain_and_not_the_answer():
    def breaking(scene, size, run):
        push = linear.shapes("push", run)[..., 0] * size
        return replace(scene, record=scene.record + (np.nan if run.name == "t1" else 1.0) * push)

    breaks = replace(PUSH, apply=breaking)
    runs = [recorded(f"r{k}", k, {PUSH: 1.0}) for k in range(4)]
    runs += [recorded(f"t{k}", 50 + k, {PUSH: 1.0}, use="test") for k in range(2)]
    study = Study("lines", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (breaks,), seed=0, settings=QUICK)
    assert (report.verdict, report.named, report.gain) == ("named", ("push",), None)
    assert "run t1 could not be simulated" in report.headline
    assert any(s.startswith("Run t1 could not be simulated") for s in report.sentences)
    assert {row.run for row in report.errors} == {"t0"}


def test_causes_are_ordered_by_the_share_that_is_back_without_them():
    report = diagnosed({PUSH: 1.0, OTHER: 3.0}, (PUSH, OTHER))
    found = causes(report)
    assert {n for n, row in found.items() if row.removes} == {"push", "other"}
    missing = report.null.chi2 - report.null.num_samples
    runs, channels = report.null.problem.runs, linear.CHANNELS
    for name, effect in (("push", OTHER), ("other", PUSH)):
        without = fit(linear.model(), runs, channels, effects=(effect,))
        share = (without.chi2 - report.best.chi2) / missing
        assert found[name].removes == pytest.approx(share, rel=0.02)
    assert [row.name for row in report.causes[:2]] == ["other", "push"]
    # without that fit, the slopes of the best one say as much of a linear model
    assert _rise_without(report.best, OTHER) > _rise_without(report.best, PUSH) > 0.0


def test_what_is_left_is_the_noise_that_sizes_must_show_above():
    """Something outside of the library acts, twice the noise: slopes tell of what is left."""
    hidden = linear.line("hidden")
    runs = [recorded(f"r{k}", k, {hidden: 1.5}) for k in range(6)]
    study = Study("lines", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (PUSH,), seed=0, settings=QUICK)
    assert report.left > 2.0
    found = causes(report)
    screened = dict(zip(report.screened.names, report.screened.smallest_visible, strict=True))
    assert found["push"].status == "not visible below"
    least = found["push"].smallest_visible["size"]  # a fit's prior narrows it by a third of 1 %
    assert least == pytest.approx(report.left * screened["push"], rel=0.01)
    assert f"Of what is left, {report.left:.2g} times the noise." in found["push"].note


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("sd", "doubts", "status"),
    [(0.4, (), "certain"), (0.8, (), "likely"), (0.4, ("few runs",), "likely")],
)
def test_a_data_sheet_is_certain_where_its_whole_interval_is_beyond_the_limit(
    sign, sd, doubts, status
):
    """At 4 of its sd, where 3 are the limit: 1.645 * 0.4 less is beyond it, 1.645 * 0.8 is not."""
    row = BaseRow("m", "mass", "kg", 1 + 0.4 * sign, 0.1 * sd, 0.0, 2.0, 1.0, 0.1, 4.0 * sign, 3.0)
    judgment = SimpleNamespace(decision=SimpleNamespace(verdict="none", forms={}))
    known = CauseEvidence(judgment, None, None, (), frozenset(), {}, doubts_of_names=doubts)
    assert _finding_row(known, row).status == status


@pytest.mark.parametrize(("left", "fits"), [(1.0, ()), (3.0, ()), (3.0, ({1},))])
def test_a_kink_that_no_fit_held_is_not_judged_while_much_is_left(left, fits):
    """An overflow of 172 mm that nothing had fitted was not visible below 0.3 mm."""
    made = SimpleNamespace(scans={}, scans_late=frozenset())
    search = SimpleNamespace(fits=dict.fromkeys(map(frozenset, fits)), simulations=made)
    effects = (PUSH, replace(linear.line("overflow"), smooth=False))
    judgment = SimpleNamespace(search=search)
    known = CauseEvidence(judgment, None, None, effects, frozenset(), {}, left=left)
    is_silent = left > 1.0 and not fits
    assert bool(known.why_not_judged(1)) == is_silent
    assert known.why_not_judged(0) == ""
    late = SimpleNamespace(scans={}, scans_late=frozenset({("", frozenset(), frozenset({0}))}))
    judgment = SimpleNamespace(search=SimpleNamespace(fits={}, simulations=late))
    assert replace(known, judgment=judgment).why_not_judged(0) == "its sizes were not tried"


@pytest.mark.parametrize(
    ("falls", "zero", "forms", "hollow"),
    [
        ((0.4, -0.1), (False, True), {}, True),
        ((0.4, 0.1), (False, True), {}, False),  # what was not fitted shows its gain
        ((0.4, -0.1), (False, False), {}, False),  # its interval leaves zero out
        ((0.4, -0.1), (False, False), {1: "another form"}, True),
        ((0.4, 0.1), (False, False), {1: "another form"}, False),
        ((-0.2, -0.1), (True, True), {}, False),  # of one of the two the misfit must be
    ],
)
def test_a_member_that_may_be_nothing_and_gains_nothing_is_not_likely(falls, zero, forms, hollow):
    gains = {i: Gain(0.5, 0.1, 0.9, 1.0, 8, fall) for i, fall in enumerate(falls)}
    decision = Decision("named", frozenset({0, 1}), (), None, 0.99, forms=forms)
    judged = Judgment(decision, gains=gains)
    about = SimpleNamespace(may_be_zero=lambda i: zero[i])
    assert _is_hollow(judged, about, 1) == hollow
