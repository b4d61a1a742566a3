"""Benches that a study describes by laws: any propeller, any material, what bends a law."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.identify import fit
from diffsim.identify.model_file import read_extended
from diffsim.systems.registry import setup_of
from tests.diagnose.discover.answers import answer

SPEED = np.r_[np.linspace(100.0, 900.0, 18), np.linspace(890.0, 110.0, 18)]
WAY = np.sign(np.gradient(SPEED))
NOISE = 0.02  # [N]
MODEL = {
    "system": "bench",
    "define": {"thrust": "c*speed**2"},
    "readings": {"thrust_N": "thrust"},
    "parameters": {"c": {"value": 1e-5, "percent": 30, "per": "propeller"}},
    "laws": [{"name": "thrust", "of": "speed", "unit": "N", "per": "propeller", "sweeps": True}],
}
RUNS = (("A", "fit"), ("B", "fit"), ("C", "fit"), ("A", "test"))
SCALES = {"A": 1.0, "B": 1.2, "C": 0.9}


def bench(law=lambda w: 1e-5 * w**2, runs=RUNS, model=None, seed=0, scales=SCALES):
    """Sweeps of several propellers up and down."""
    rng = np.random.default_rng(seed)
    made = []
    for order, (propeller, use) in enumerate(runs):
        y = scales.get(propeller, 1.0) * law(SPEED) + NOISE * rng.normal(size=len(SPEED))
        made.append(
            Run(
                f"{propeller}_{order}",
                np.arange(float(len(SPEED))),
                y[:, None],
                {"speed": SPEED},
                f"g{order}",
                order,
                use,
                {"propeller": propeller},
            )
        )
    channels = (Channel("thrust_N", "N", "force", NOISE),)
    return Study("bench", "bench", channels, tuple(made), model=model or copy.deepcopy(MODEL))


HIDDEN = {
    "exponent_of_thrust": (0.12, lambda w: 1e-5 * w**2 * (w / 500.0) ** 0.12),
    "hysteresis_of_thrust": (0.03, lambda w: 1e-5 * w**2 * (1.0 + 0.03 * WAY)),
    "hysteresis_loop_of_thrust": (
        0.02,
        lambda w: 1e-5 * w**2 - 0.02 * 8.1 * WAY * (w - 100.0) * (900.0 - w) / 4e2**2,
    ),
    "run_drift_of_thrust": (
        -0.04,
        lambda w: 1e-5 * w**2 * (1.0 - 0.04 * np.linspace(0.0, 1.0, len(w))),
    ),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_a_bent_law_is_named_with_its_size(name):
    size, law = HIDDEN[name]
    model = copy.deepcopy(MODEL)
    model["laws"][0]["sweeps"] = "hysteresis" in name
    report = answer(bench(law, model=model))
    assert (report.verdict, report.named) == ("named", (name,))
    for label in "ABC":
        own = report.best.values[f"{name}.all"] + report.best.values[f"{name}.[propeller={label}]"]
        assert own == pytest.approx(size, abs=0.014)


def test_what_nobody_listed_is_a_law_of_what_was_set():
    """A resonance of the stand at one speed, the same in all sweeps: no drift of each."""
    model = copy.deepcopy(MODEL)
    model["effects"] = {"only": ["exponent_of_thrust", "zero_of_thrust"]}
    study = bench(lambda w: 1e-5 * w**2 + 0.06 * np.exp(-(((w - 500.0) / 70.0) ** 2)), model=model)
    report = answer(study)
    assert report.verdict == "unknown"
    nats = {h.unknown: h.nats for h in report.hypotheses if not h.effects}
    law, drift = "unknown law of thrust_N over speed", "unknown drift of thrust_N"
    assert nats[law] > nats[drift] + 3.0
    unknowns = {u.name: u for u in setup_of(study).unknowns}
    assert set(unknowns) == {law, "unknown course of thrust_N over a sweep"}
    problem = fit(setup_of(study).model, study.fit_runs, study.channels).problem
    moved = unknowns[law].responses(problem, np.zeros(problem.num_base))
    ways = moved.reshape(len(study.fit_runs), len(SPEED), -1)
    np.testing.assert_allclose(ways, ways[:1].repeat(len(ways), axis=0))  # one law for all runs


def test_a_drift_over_an_even_sweep_is_not_told_from_a_loop():
    report = answer(bench(HIDDEN["run_drift_of_thrust"][1]))
    assert report.verdict == "ambiguous"
    told = {c.name for c in report.causes if c.status in ("likely", "cannot be told from")}
    assert {"hysteresis_loop_of_thrust", "run_drift_of_thrust"} <= told


def test_nothing_is_named_where_the_law_is_right():
    assert answer(bench()).named == ()


def test_a_propeller_that_was_never_fitted_shares_what_the_others_have():
    law = HIDDEN["exponent_of_thrust"][1]
    known = copy.deepcopy(MODEL)
    known["parameters"] = {"c": {"value": 1e-5, "percent": 3}}
    study = bench(law, runs=(*RUNS[:3], ("D", "test")), model=known, scales={})
    s = setup_of(study)
    exponent = next(e for e in s.effects if e.name == "exponent_of_thrust")
    errors = []
    for effects in ((), (exponent,)):
        fitted = fit(s.model, study.fit_runs, study.channels, effects=effects)
        unseen = study.test_runs[0]
        left = unseen.measured - fitted.problem.predict(unseen, torch.from_numpy(fitted.x)).numpy()
        errors.append(np.sqrt(np.mean(left**2)))
    assert errors[1] < 0.5 * errors[0]


def test_a_table_is_a_curve_of_straight_lines():
    model = {
        "system": "bench",
        "tables": {"curve": {"of": "speed/100", "at": [1, 3, 9], "values": [0, 4, 1]}},
        "readings": {"thrust_N": "curve*gain"},
        "parameters": {"gain": {"value": 2, "percent": 10}},
    }
    study = bench(model=model)
    s = setup_of(study)
    predicted = s.model.predict(study.runs[0], s.model.at_prior())[:, 0]
    np.testing.assert_allclose(predicted, 2.0 * np.interp(SPEED / 100, [1, 3, 9], [0, 4, 1]))


ZEROS = (0.3, -0.2, 0.15, -0.35, 0.25)  # of a scale that is tared by hand before each sweep [N]
SWEEPS = (*(("A", "fit"),) * 4, ("A", "test"))


def tared(runs=SWEEPS, zeros=ZEROS, seed=0):
    study = bench(runs=runs, scales={}, seed=seed)
    made = [replace(r, measured=r.measured + z) for r, z in zip(study.runs, zeros, strict=True)]
    return replace(study, runs=tuple(made))


def test_a_zero_of_each_run_is_named_and_an_unseen_run_tells_its_own():
    report = answer(tared())
    assert (report.verdict, report.named) == ("named", ("zero_per_run_of_thrust_N",))
    (cause,) = [c for c in report.causes if c.name in report.named]
    # of the test run, to which nothing was fitted, nothing is said
    assert list(cause.size) == [f"@A_{k}" for k in range(4)]
    for k, size in enumerate(cause.size.values()):
        assert size.low <= ZEROS[k] <= size.high and size.high - size.low < 0.1
    (row,) = report.errors
    assert row.before > 5.0 * NOISE and row.after == pytest.approx(NOISE, rel=0.3)
    assert row.num_fitted == 1
    assert "in 4 runs)" in report.sentences[0]


def test_a_saved_zero_of_each_run_is_judged_on_runs_of_another_study(tmp_path):
    study = tared()
    answer(study).save(tmp_path)
    fresh = tared((("A", "test"), ("A", "test")), (0.4, -0.3), seed=9)
    fresh = replace(fresh, runs=tuple(replace(r, name=f"new_{r.name}") for r in fresh.runs))
    saved = read_extended(tmp_path / "extended_model.yaml")
    made = setup_of(saved.framed(fresh))
    judged = judge_saved(Inputs(fresh, made, 0, {}), saved)
    for row in judged.errors:
        assert row.before > 5.0 * NOISE and row.after == pytest.approx(NOISE, rel=0.3)


def test_two_runs_do_not_ask_for_a_zero_each():
    s = setup_of(bench(runs=RUNS[1:]))
    zero = next(e for e in s.effects if e.name == "zero_per_run_of_thrust_N")
    assert zero.needs(bench(runs=RUNS[1:])) == "3 runs to fit"


def test_a_size_for_all_and_one_for_each_are_certain_together():
    """Of two propellers neither size alone excludes zero; what both have together does."""
    runs = (*(("A", "fit"), ("B", "fit")) * 2, ("A", "test"))
    report = answer(bench(HIDDEN["exponent_of_thrust"][1], runs=runs))
    (cause,) = [c for c in report.causes if c.name == "exponent_of_thrust"]
    assert all(size.low <= 0.0 <= size.high for size in cause.size.values()), cause.size
    assert cause.status == "certain"


def test_a_reading_that_no_parameter_enters_has_a_scale():
    """Two encoders side by side: nothing is fitted before causes are asked."""
    rng, t, runs = np.random.default_rng(0), 0.05 * np.arange(60.0), []
    for k, use in enumerate(("fit", "fit", "select", "test")):
        angle = 0.5 * np.sin((1.0 + k) * t) + 0.1 * np.sin(0.3 * t)
        seen = 1.2 * angle + rng.normal(0.0, 1e-3, len(t))
        runs.append(Run(f"r{k}", t, seen[:, None], {"motor": 50.0 * angle}, f"r{k}", k, use))
    channels = (Channel("joint", "rad", "angle", sd=1e-3),)
    model = {"system": "bench", "readings": {"joint": "motor/50"}}
    report = answer(Study("encoders", "bench", channels, tuple(runs), model=model))
    assert report.named == ("sensor_scale",)
    (size,) = next(c for c in report.causes if c.name == "sensor_scale").size.values()
    assert size.value == pytest.approx(0.2, abs=2e-3)
