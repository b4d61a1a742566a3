"""A wrong data sheet, and causes that may stand in for it."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.checks.gates import REPEATED, GateResult
from diffsim.diagnose.judge import judge
from diffsim.diagnose.judge.averaging import Widening
from diffsim.diagnose.judge.data_sheet import base_rows
from diffsim.diagnose.judge.stand_ins import wrong_data_sheet
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.identify import Parameter, SimModel, fit
from diffsim.identify.unknown import UnknownDrift
from tests.diagnose import linear
from tests.diagnose.say.test_causes import QUICK, causes, diagnosed, recorded
from tests.diagnose.search.test_evidence import linearized

OWN = linear.line("tug")


def tug(own: float):
    """A cause that does what a larger mass does, and something of its own."""

    def apply(scene, size, run):
        moved = linear.shapes("mass", run)[..., 0] + own * linear.shapes("tug", run)[..., 0]
        return replace(scene, record=scene.record + moved * size)

    return replace(OWN, apply=apply)


def test_a_wide_prior_weighs_as_one_of_that_width():
    """Against ln N(y; 0, 1 + B B'), the column of the parameter ten times as long."""
    from scipy import stats

    problem = linear.problem()
    y, columns = linear.matrices()
    for wide in ({}, {0: 10.0}, {1: 3.0}):
        scaled = columns * [wide.get(0, 1.0), wide.get(1, 1.0)]
        spread = np.eye(len(y)) + scaled @ scaled.T
        want = stats.multivariate_normal(np.zeros(len(y)), spread).logpdf(y)
        found = linearized(problem, fit_of(problem).x, [], 1).weigh(Hypothesis(), wide=wide)
        assert found.nats == pytest.approx(want + 0.5 * len(y) * np.log(2.0 * np.pi), abs=1e-8)
        mean = scaled.T @ np.linalg.solve(spread, y) * [wide.get(0, 1.0), wide.get(1, 1.0)]
        np.testing.assert_allclose(found.x, mean, atol=1e-8)


def fit_of(problem):
    return fit(problem.model, problem.runs, linear.CHANNELS, whitener=problem.whitener)


def test_a_cause_that_takes_up_a_wrong_data_sheet_gives_way_to_it():
    report = diagnosed({}, (tug(0.05),), base=(9.0, 0.0))
    assert (report.verdict, report.named, report.findings) == ("data_sheet", (), ("mass",))
    size = causes(report)["mass"].size["size"]
    assert size.low < 0.3 + 9.0 * 0.7 < size.high
    row = causes(report)["tug"]
    assert row.status == "refuted" and row.rivals == (wrong_data_sheet("mass"),)
    assert row.probability < 0.05
    first = report.hypotheses[0]
    assert (first.effects, first.unknown) == ((), wrong_data_sheet("mass"))


def test_what_a_cause_alone_explains_stays_its_name():
    cause = tug(1.0)
    report = diagnosed({cause: 4.0}, (cause,))
    assert (report.verdict, report.named, report.findings) == ("named", ("tug",), ())


def test_two_causes_that_together_take_up_a_wrong_data_sheet_give_way_to_it():
    """A tube with a narrow bore was a leak behind it, and a pump that delivers what is lost there.
    Neither alone is the tube, so that no set without one of them had the evidence."""

    def half(name, other):
        def apply(scene, size, run):
            own = linear.shapes("mass", run)[..., 0] + other * linear.shapes("aside", run)[..., 0]
            return replace(scene, record=scene.record + own * size)

        return replace(linear.line(name), apply=apply)

    causes_of_both = (half("leak", 1.0), half("pump", -1.0))
    report = diagnosed({}, causes_of_both, base=(14.0, 0.0))
    assert (report.verdict, report.named, report.findings) == ("data_sheet", (), ("mass",))
    assert {causes(report)[name].status for name in ("leak", "pump")} == {"refuted"}


@pytest.mark.parametrize(("off", "typical"), [(9.0, 0.4), (30.0, 0.02)])
def test_a_cause_that_fits_as_well_as_a_wrong_data_sheet_is_told_beside_it(off, typical):
    """However unusual its size: of two with one misfit, priors alone do not say which it is."""
    report = diagnosed({}, (replace(tug(0.0), typical=typical),), base=(off, 0.0))
    assert report.verdict == "ambiguous"
    row = causes(report)["tug"]
    assert (
        row.status in ("likely", "cannot be told from") and wrong_data_sheet("mass") in row.rivals
    )
    assert "mass is off its data sheet" in report.headline


def test_a_wrong_data_sheet_does_not_narrow_its_neighbors():
    """Two stiffnesses whose sum is known well: one is nine sd off, and held its twin back."""
    held = {"front": 0, "rear": 0}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = {"front": float(rng.normal()), "rear": 9.0}
        runs = [pair_run(f"r{k}", truth, rng) for k in range(2)]
        found = fit(PAIR, runs, linear.CHANNELS, whitener=linear.problem(runs=runs).whitener)
        rows = base_rows(found, runs, Widening(), judged=True)
        for row in rows:
            held[row.name] += row.low <= truth[row.name] <= row.high
        assert [row.name for row in rows if row.finding] == ["rear"]
    assert min(held.values()) >= 0.85 * 60


def test_a_usual_value_that_nobody_stated_is_no_data_sheet():
    """ "Slow time is 0.4 s, the data sheet says 120 s" of a study that stated none."""
    truth, rng = {"front": 0.0, "rear": 9.0}, np.random.default_rng(0)
    runs = [pair_run(f"r{k}", truth, rng) for k in range(2)]
    whitener = linear.problem(runs=runs).whitener
    for is_usual in (False, True):
        model = PAIR.with_base((PAIR.base[0], replace(PAIR.base[1], is_usual=is_usual)))
        found = fit(model, runs, linear.CHANNELS, whitener=whitener)
        rows = base_rows(found, runs, Widening(), judged=True)
        assert [row.name for row in rows if row.finding] == ([] if is_usual else ["rear"])


def pair_record(values, run):
    """(T, 2) of two stiffnesses that do nearly the same."""
    both, rear = linear.shapes("both", run)[..., 0], linear.shapes("rear", run)[..., 0]
    return (values["front"] + values["rear"]) * both + 0.25 * values["rear"] * rear


def pair_run(name, truth, rng):
    bare = linear.run(name, 0)
    noise = rng.normal(size=bare.measured.shape) * [c.sd for c in linear.CHANNELS]
    return replace(bare, measured=pair_record(truth, bare).numpy() + noise)


PAIR = SimModel(
    lambda values, run, numerics: linear.LinearScene(pair_record(values, run)),
    [Parameter("front", 0.0, 1.0, "N/m"), Parameter("rear", 0.0, 1.0, "N/m")],
    "pair",
)


def test_intervals_are_numbers_however_much_parts_disagree():
    """A rate that no run shows had an interval to infinity, and its file could not be read."""
    base = [Parameter("front", 1.0, 1.0, "N/m", log=True), Parameter("idle", 0.1, 1.0, log=True)]
    model = SimModel(
        lambda values, run, numerics: linear.LinearScene(
            values["front"] * linear.shapes("both", run)[..., 0] + 0.0 * values["idle"]
        ),
        base,
        "idle",
    )
    runs = [
        replace(
            linear.run("r", 0), measured=linear.shapes("both", linear.run("r", 0))[..., 0].numpy()
        )
    ]
    found = fit(model, runs, linear.CHANNELS, whitener=linear.problem(runs=runs).whitener)
    told, idle = base_rows(found, runs, Widening(usual=1e6), judged=True)
    assert 1e9 < told.high < np.inf
    assert (idle.low, idle.high) == pytest.approx((0.1 / 5.18, 0.1 * 5.18), rel=1e-3)


@pytest.mark.parametrize(
    ("pull", "drift", "status"),
    [(35.0, 0.8, "likely"), (35.0, 0.0, "certain"), (15.0, 0.8, "certain")],
)
def test_nothing_is_certain_that_takes_a_data_sheet_far_off_while_something_unknown_acts(
    pull, drift, status
):
    """A winding that heats up had a bent sensor for certain, the air 30 sd colder than stated."""
    push, runs = linear.line("push"), []
    for k, use in enumerate(["fit"] * 6 + ["test"] * 2):
        run = recorded(f"r{k}", k, {push: 3.0}, base=(pull, 0.0), use=use)
        course = np.outer(np.sin(4.0 * run.time_s), [drift, 0.0])
        runs.append(replace(run, measured=run.measured + course))
    study = Study("far", "copter", linear.CHANNELS, tuple(runs))
    unknowns = (UnknownDrift(0, "drift"),)
    report = diagnose(study, linear.model(), (push,), seed=0, unknowns=unknowns, settings=QUICK)
    assert (report.verdict, report.named, report.findings) == ("named", ("push",), ("mass",))
    found = causes(report)
    assert found["push"].status == found["mass"].status == status
    assert ("probably" in report.headline) == (status == "likely")
    doubts = [s for s in report.sentences if "standard deviations off its data sheet" in s]
    assert len(doubts) == (status == "likely")


@pytest.mark.parametrize(
    ("noise", "size", "status"), [(1.0, 0.8, "certain"), (0.1, 0.8, "likely"), (0.1, 8.0, "likely")]
)
def test_nothing_is_certain_that_leaves_much(noise, size, status, monkeypatch):
    """A cable that pulls beyond 0.9 rad was a cubic stiffness, certain, with 16 noise sd left.

    Of the third course the push explains so little that the unknown drift faces the repeats, which
    withdraw it: no unknown cause stands beside, and as much is left.
    """
    failed = (GateResult(REPEATED, False, 0.5, 0.02),)
    monkeypatch.setattr(judge, "repeated_gate", lambda fit, seed: failed)
    push, runs = linear.line("push"), []
    for k, use in enumerate(["fit"] * 6 + ["test"] * 2):
        run = linear.run(f"r{k}", k)
        run = replace(run, measured=noise * run.measured, use=use)
        clean = recorded(f"r{k}", k, {push: 6.0}).measured - linear.run(f"r{k}", k).measured
        course = np.outer(np.sin(4.0 * run.time_s), [size, 0.0])
        runs.append(replace(run, measured=run.measured + clean + course))
    channels = tuple(replace(c, sd=noise * c.sd) for c in linear.CHANNELS)
    study = Study("left", "copter", channels, tuple(runs))
    unknowns = (UnknownDrift(0, "drift"),)
    report = diagnose(study, linear.model(), (push,), seed=0, unknowns=unknowns, settings=QUICK)
    assert (report.verdict, report.named) == ("named", ("push",))
    assert causes(report)["push"].status == status
    assert (report.beside == "") == (size > 1.0)
    doubts = [s for s in report.sentences if "what the fit leaves is" in s]
    assert len(doubts) == (status == "likely")
    left = report.to_dict()["left"]
    assert left == pytest.approx(np.sqrt(report.best.chi2 / report.num_samples))
    ((name, beside),) = report.with_unknown.items()
    assert beside < (0.8 if noise < 1.0 else 1.0) * left
    said = f"{left:.2g} times the noise, {beside:.2g} with an {name} beside"
    assert any(said in s for s in report.sentences)


@pytest.mark.parametrize("rest", [0.0, 3.0])
def test_while_much_is_left_no_data_sheet_is_blamed(rest):
    """Where no cause explains the rest, it may have bent the number."""
    report = diagnosed({linear.line("rest"): rest}, (linear.line("push"),), base=(9.0, 0.0))
    assert (report.left > 2.0) is (rest > 0.0)
    assert report.findings == (() if rest else ("mass",))
    assert [row.name for row in report.bent] == (["mass"] if rest else [])
    assert any("no finding while" in s for s in report.sentences) is (rest > 0.0)
