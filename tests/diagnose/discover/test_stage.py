"""Recordings with something hidden that no library lists, from the plain fit to the answer."""

import json
import re
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from diffsim import cli
from diffsim.data import Command, save_study
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.discover import stage
from diffsim.diagnose.discover.beside import Pair
from diffsim.diagnose.discover.screen import ONE_TURN, Basis, Candidate, bumps
from diffsim.diagnose.discover.stage import find_laws
from diffsim.diagnose.say.headline import first_of
from diffsim.diagnose.search.fit import silent
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem, extended_model
from diffsim.identify.law import Entry, Law, Shape, Variable
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model_file import read_extended, rebuilt
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import load_extended, setup_of
from tests.diagnose.discover.answers import few_laws, found
from tests.diagnose.discover.turntable import DAMPING, turntable_study

USES = ("fit", "fit", "select", "test")
NOISE = 0.01  # [rad]
TEETH, TORQUE = 7.0, 0.02  # times a turn, [N m]


def cogging(angle, speed, temp):
    return TORQUE * np.sin(TEETH * angle + 0.6)


def thinner_when_warm(angle, speed, temp):
    return 0.024 * (temp - 298.0) * DAMPING * speed


@pytest.fixture(scope="module")
def cogs():
    return found(turntable_study(cogging, uses=USES, noise=NOISE, count=130))


@pytest.mark.cpu(8)  # a whole diagnosis, then another one with the laws that it found
def test_one_recording_alone_claims_no_law():
    """The same cogging: nothing that was not fitted could contradict its law."""
    with few_laws():
        report = found(turntable_study(cogging, uses=USES[:1], noise=NOISE, count=130))
    assert report.verdict == "ambiguous" and len(report.described.laws) == 1
    row = next(c for c in report.causes if c.name == report.described.laws[0].name)
    assert row.status == "likely" and "no other recording could contradict it" in row.doubts


@pytest.mark.cpu(8)  # a whole diagnosis, then another one with the laws that it found
def test_a_hidden_cogging_is_described(cogs):
    assert cogs.verdict == "described"
    (law,) = cogs.described.laws
    assert law.entry == {"kind": "force", "target": "shaft"}
    assert law.variables == ("angle",) and law.form == "periodic" and law.memory is None
    for name, truth, unit in (("amplitude", TORQUE, "N m"), ("wave_number", TEETH, "-")):
        number = law.numbers[name]
        assert number.low < truth < number.high and number.unit == unit
        assert number.high - number.low < 0.2 * truth
    (size,) = next(c for c in cogs.causes if c.name == law.name).size.values()
    told = law.numbers["amplitude"]  # as the answer states it, wider than one set's at its fit
    assert (told.low, told.high) == pytest.approx((size.low, size.high))
    assert "cogging" in law.looks_like and law.sentence in cogs.sentences[1]
    assert "7" in law.sentence.partition(" times a turn")[0] or "6.99" in law.sentence


def test_its_curve_is_the_torque(cogs):
    """Before it has a form: the missing term over the angle, within its band."""
    curve = next(c for c in cogs.described.curves if c.law == cogs.described.laws[0].name)
    u, value, sd = map(np.array, (curve.u, curve.value, curve.sd))
    truth = TORQUE * np.sin(TEETH * u + 0.6)
    assert np.sqrt(np.mean((value - truth) ** 2)) < 0.2 * TORQUE
    assert (sd > 0.0).all() and sd.max() < 0.2 * TORQUE


def test_each_run_alone_tells_the_torque(cogs):
    """Over the angles that it went through."""
    curve = next(c for c in cogs.described.curves if c.law == cogs.described.laws[0].name)
    assert curve.unit == "N m" and [r.run for r in curve.runs] == ["run_0", "run_1"]
    for run in curve.runs:
        u, value = np.array(run.u), np.array(run.value)
        assert curve.u[0] <= u[0] < u[-1] <= curve.u[-1]
        assert np.sqrt(np.mean((value - TORQUE * np.sin(TEETH * u + 0.6)) ** 2)) < 0.3 * TORQUE


def test_the_answer_says_a_law_once(cogs):
    (law,) = cogs.described.laws
    assert " ".join(cogs.sentences).count(law.sentence) == 1
    first = first_of(cogs.headline)
    assert len(first.split()) <= 25 and first.startswith(
        "No library cause explains it: a torque at shaft that depends on angle is missing"
    )
    assert "unbalance" not in law.looks_like  # that is once a turn


def test_others_explain_less_of_what_was_left_out(cogs):
    first, *rest = cogs.described.screen
    assert (first.kind, first.target, first.variable) == ("force", "shaft", "angle")
    assert first.wave_number == pytest.approx(TEETH, abs=0.2)
    assert first.share > 0.98 and all(row.nats < first.nats - 50.0 for row in rest)


def test_unseen_runs_confirm_it(cogs):
    (row,) = [row for row in cogs.errors if row.use == "test"]
    assert row.after < 1.2 * NOISE and row.before > 10.0 * NOISE


@pytest.mark.story  # a whole diagnosis beside the first
def test_a_law_that_unseen_runs_do_not_ask_for_stays_out():
    """Fitted runs have twice the torque of the others, from which the law takes one error and to
    which it gives another as large: what stood before it stands."""
    share = np.array([1.0, 1.0, 0.5, 0.5])  # of the torque, by run

    def faded(angle, speed, temp):
        return share * cogging(angle, speed, temp)

    with few_laws():
        report = found(turntable_study(faded, uses=USES, noise=NOISE, count=130))
    assert report.verdict == "unknown" and not report.named


def test_nothing_is_described_where_nothing_is_hidden():
    report = found(turntable_study(uses=USES, noise=NOISE, count=130))
    assert report.verdict == "none"
    assert report.described is None or report.described.laws == ()


def fitted_laws(study, *, most_steps=np.inf, with_library=False):
    """What the stage finds beside the plain model."""
    made = setup_of(study)
    problem = Problem(made.model, study.fit_runs, WhiteNoise(study.channels))
    start = linearization_at(problem, np.zeros(problem.num_base))
    library = made.effects if with_library else ()
    return find_laws([gauss_newton(problem, start)[0]], made.laws, silent, most_steps, library)


def cogging_that_rubs(angle, speed, temp):
    return cogging(angle, speed, temp) - 0.02 * np.tanh(speed / 0.02)


@pytest.mark.cpu(10)  # laws alone and beside causes, fitted in the simulator
@pytest.mark.parametrize(
    ("hidden", "is_spent", "is_pair_tried"),
    [(cogging_that_rubs, False, True), (cogging_that_rubs, True, False), (cogging, False, False)],
    ids=["both", "spent", "alone"],
)
def test_laws_alone_are_fitted_before_any_beside_a_cause(
    monkeypatch, hidden, is_spent, is_pair_tried
):
    """Of a flywheel pairs had spent the budget: a law of heat came first, as no other was tried.

    What one law explains alone is asked of no pair.
    """
    asked, fit_law = [], stage._fit_law

    def noted(screen, before, candidate, port, standing, most_steps, cause=None):
        if candidate.variable.times is None:
            asked.append(len(standing) + (0.5 if cause is not None else 0.0))
        return fit_law(screen, before, candidate, port, standing, most_steps, cause)

    def promising(screen, causes):
        return [Pair(screen.found[0], cause, 1e4) for cause in causes[:2]], len(causes)

    monkeypatch.setattr(stage, "_fit_law", noted)
    monkeypatch.setattr(stage, "best_pairs", promising)
    monkeypatch.setattr(stage, "NUM_FITTED", 3)
    study = turntable_study(hidden, uses=("fit", "fit"), noise=1e-4, count=50)
    laws = fitted_laws(study, most_steps=1.0 if is_spent else np.inf, with_library=True)
    assert asked.count(0) >= (3 if is_pair_tried else 1)
    first_pair = asked.index(0.5) if 0.5 in asked else None
    assert (first_pair is not None) == is_pair_tried
    assert not is_pair_tried or 0 not in asked[first_pair:]
    # further laws are weighed beside the first, which explains nothing again
    alone = [f.candidate for f in laws.fitted if not f.beside]
    assert not any(one is other for one, other in combinations(alone, 2))


def test_one_turn_of_an_angle_is_fitted_beside_its_bumps():
    port = setup_of(turntable_study(uses=("fit",), noise=NOISE, count=20)).laws
    shaft = next(e for e in port.entries if e.words == "force at shaft")
    angle = next(v for v in port.variables() if v.name == "angle")
    bump = Candidate(shaft, angle, bumps(-1.0, 1.0), nats=90.0, gained=90.0, share=0.9, typical=1.0)
    turn = replace(bump, basis=Basis(("sin(u)", "cos(u)"), wave=ONE_TURN), nats=60.0, gained=60.0)
    assert stage._choose([bump, turn], 3.0) == [bump, turn]


def test_of_variables_in_proportion_one_has_a_law():
    """Of a supply that sags the answer was that runs cannot tell a duty from its voltage."""
    entry = Entry("number", "resistance", "ohm", 1.0)

    def law(name, nats, top=1.0):
        return Candidate(entry, Variable(name, name), bumps(-top, top), nats, nats, 0.9, 1.0)

    duty, volts, speed = law("duty", 90.0), law("volts", 90.001, 12.0), law("speed", 80.0)
    assert stage._choose([volts, duty, speed], 3.0) == [volts, speed]
    memory = replace(duty, variable=Variable("memory", "m", memory="relaxation"))
    assert stage._choose([replace(memory, gained=99.0, nats=99.0), duty], 3.0)[1] is duty


def test_pairs_end_with_the_budget(monkeypatch):
    fitted = []
    pairs = [SimpleNamespace(law=k, cause=k) for k in range(5)]
    monkeypatch.setattr(stage, "causes_along", lambda *_: [])
    monkeypatch.setattr(stage, "best_pairs", lambda *_: (pairs, len(pairs)))
    monkeypatch.setattr(stage, "_fit_law", lambda screen, fit, law, *_: fitted.append(law))
    screen, table = SimpleNamespace(followed=None), stage.Table((), 1.0)
    assert stage._fit_beside(screen, None, None, table, lambda: len(fitted) < 2) == []
    assert fitted == [0, 1]


TURN, BLUR = 0.01, 1e-3  # of the camera [rad], of its readings [m]


def turned_camera(seed=0):
    """A stage that is set along two axes, seen by a camera that is turned against them."""
    rng = np.random.default_rng(seed)
    runs = []
    for k, use in enumerate(("fit", "fit", "fit", "select", "select", "test")):
        east, north = rng.uniform(-1.0, 1.0, (2, 60))
        seen = np.stack([east + TURN * north, north - TURN * east], 1)
        measured = seen + BLUR * rng.normal(size=seen.shape)
        commands = {"east": east, "north": north}
        runs.append(Run(f"run_{k}", 0.1 * np.arange(60), measured, commands, f"run_{k}", k, use))
    channels = (Channel("x", "m", "x", BLUR), Channel("y", "m", "y", BLUR))
    commands = (Command("east", "m"), Command("north", "m"))
    model = {
        "system": "bench",
        "readings": {"x": "a*east", "y": "b*north"},
        "parameters": {n: {"value": 1.0, "percent": 0.5} for n in "ab"},
    }
    return Study("camera", "bench", channels, tuple(runs), commands=commands, model=model)


@pytest.mark.cpu(8)
def test_two_laws_at_once_are_found_and_said_as_one_rotation():
    report = found(turned_camera())
    assert report.verdict == "described"
    held = [law for law in report.described.laws if law.name in report.named]
    places = {(law.entry["kind"], law.entry["target"], law.form) for law in held}
    assert places == {("reading", "x", "line"), ("reading", "y", "line")} and len(held) == 2
    for law in held:  # what was set, or the other reading, which shows it
        assert law.variables[0] in (("north", "y") if law.entry["target"] == "x" else ("east", "x"))
    for law in held:
        size = law.numbers["amplitude"]
        assert size.low < (TURN if law.entry["target"] == "x" else -TURN) < size.high
    said = re.search(
        r"together they are a rotation of the axes by ([\d.]+) deg", report.sentences[1]
    )
    assert float(said.group(1)) == pytest.approx(np.degrees(TURN), rel=0.05)


@pytest.mark.story  # a further law of the same kind
def test_damping_that_falls_with_a_recorded_temperature_is_found():
    """The column is in no formula: it is named before every memory, and its slope is right."""
    study = turntable_study(thinner_when_warm, uses=("fit", "fit"), noise=NOISE, count=160)
    with few_laws():
        laws = fitted_laws(study)
    best = laws.screened[0]
    assert (best.entry.kind, best.entry.target, best.variable.name) == ("number", "c", "temp")
    assert best.share > 0.95 and best.variable.columns == ("temp",)
    first = laws.laws[0]
    assert (first.entry.target, first.variable.name) == ("c", "temp")
    fitted = next(f for f in laws.fitted if f.candidate.variable.name == "temp")
    # c is free, so that of a law its slope over its value counts
    curve = fitted.curve
    slope, level = np.polyfit(curve.u - 298.0, curve.values, 1, w=1.0 / curve.sd)
    assert slope / (1.0 + level) == pytest.approx(-0.024, rel=0.1)
    # a form that slopes promise to be closer than bumps counts by what it gains
    for gained in (3.0, -3.0):
        promised = replace(fitted, left=fitted.forms[0].nats + gained)
        assert promised.reach - fitted.fit.nats == pytest.approx(max(gained, 0.0), abs=1e-9)


def stiffer_when_warm(angle, speed, temp):
    return -5e-4 * (temp - 298.0) * angle


@pytest.mark.story  # all laws of one variable, then of two
def test_a_law_of_two_variables_is_found_where_none_of_them_explains_as_much():
    """A spring that only warmth makes: it pulls by the angle times the temperature above a zero."""
    study = turntable_study(stiffer_when_warm, uses=("fit", "fit"), noise=NOISE, count=120)
    laws = fitted_laws(study)
    best = max(laws.fitted, key=lambda f: f.nats)
    pair = best.candidate.variable
    assert best.candidate.entry.words == "force at shaft" and best.num_pairs > 0
    assert {pair.own_name, pair.times.name} == {"temp", "angle"}
    alone = max(f.nats for f in laws.fitted if f.candidate.variable.times is None)
    assert best.nats > alone + 10.0
    assert laws.laws[0].variable.times is not None
    law = next(law for law in laws.laws if law.variable.own_name == "temp")
    assert law.form == "line" and law.variable.times.name == "angle"
    assert law.shapes["zero"].value == pytest.approx(298.0, abs=1.0)


def test_one_variable_is_enough_where_it_explains_all():
    """No law of two stands beside a cogging, whatever noise promises of one."""
    laws = fitted_laws(turntable_study(cogging, uses=("fit", "fit"), noise=NOISE, count=120))
    assert laws.fitted and all(f.candidate.variable.times is None for f in laws.fitted)


def test_the_row_of_such_a_law_holds_both_variables():
    study = turntable_study(uses=("fit", "fit"), noise=NOISE, count=20)
    port = setup_of(study).laws
    by_name = {v.name: v for v in port.variables()}
    pair = by_name["temp"].with_factor(by_name["angle"])
    assert pair.name == "temp times angle" and pair.columns == ("temp",)
    shaft = next(e for e in port.entries if e.words == "force at shaft")
    law = Law("warm_spring", shaft, pair, "line", "size*(u - zero)", 2e-3, "N m",
              {"zero": Shape(298.0, 1.0)})  # fmt: skip
    assert port.block(law)["term"] == "((size*((temp) - zero))*(angle))/(J)"


def test_a_saved_law_judges_another_study(cogs, tmp_path, capsys):
    """Its formula comes with the model: the study of the new runs does not know of it."""
    cogs.save(tmp_path / "saved")
    other = turntable_study(cogging, uses=("test", "test"), noise=NOISE, seed=5, count=150)
    other = replace(other, runs=tuple(replace(r, name=f"later_{r.order}") for r in other.runs))
    saved = read_extended(tmp_path / "saved")
    assert saved.verdict == "described" and len(saved.frame["laws"]) >= 1
    before, again = extended_model(cogs.best), load_extended(tmp_path / "saved", other)
    made = rebuilt(saved, setup_of(saved.framed(other)))
    for run in other.runs:
        expected = before.predict(run, before.at_prior()).numpy()
        for model in (again, made):
            np.testing.assert_allclose(
                model.predict(run, model.at_prior()).numpy(), expected, rtol=1e-9, atol=1e-12
            )
    save_study(other, tmp_path / "study")
    folders = ["--model", str(tmp_path / "saved"), "--out", str(tmp_path / "out")]
    assert cli.main(["diagnose", "judge", str(tmp_path / "study"), "--debug", *folders]) == 0
    judged = json.loads((tmp_path / "out" / "judge.json").read_text())
    first, second = judged["errors"]
    assert first["after"] < 1.1 * NOISE and first["before"] > 5.0 * NOISE
    # a third of a turn below all fitted angles the wave number's own error shows
    assert second["after"] < 2.0 * NOISE and second["before"] > 20.0 * NOISE
    assert "confirmed" in capsys.readouterr().out


@pytest.mark.story  # a further law of the same kind
def test_weight_off_the_shaft_is_told_in_less_than_a_turn():
    """Bumps follow it where runs went, and lead elsewhere; what an angle brings back holds."""
    noise = 1e-3  # [rad]
    report = found(
        turntable_study(
            lambda angle, speed, temp: -0.2 * np.sin(angle + 0.4), noise=noise, count=130
        )
    )
    (law,) = report.described.laws
    assert law.entry == {"kind": "force", "target": "shaft"} and law.variables == ("angle",)
    assert law.form == "periodic" and "unbalance" in law.looks_like
    assert law.numbers["amplitude"].value == pytest.approx(0.2, rel=0.02)
    (row,) = report.errors
    assert row.after < 1.5 * noise < 100.0 * noise < row.before
