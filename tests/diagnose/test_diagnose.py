"""End to end on the toy bed; ``tests.diagnose.confusion`` measures many fresh cases."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from diffsim.diagnose import DiagnosisSettings, SearchSettings, diagnose, extended_model, next_run
from diffsim.diagnose.crosscheck import swap_probability
from diffsim.diagnose.evidence import Linearisation
from diffsim.diagnose.gates import data_gate, gradient_gate
from diffsim.diagnose.unknown import UnknownDrift
from diffsim.identify import Problem, WhiteNoise, fit
from tests.diagnose import linear, toy

FEW = (toy.Drag(), toy.Delay(), toy.Bias(), toy.Scale())
QUICK = DiagnosisSettings(search=SearchSettings(num_refits=2))


def solve(seed, hidden=None, *, library=FEW, step=None, unknowns=(), settings=QUICK, **options):
    study = toy.generate(seed, hidden, **options)
    return diagnose(
        study, toy.model(study.runs, step), library, seed=0, unknowns=unknowns, settings=settings
    )


@pytest.fixture(scope="module")
def drag_report():
    return solve(2, {"drag": 0.2})


def test_single_effect_is_named_with_its_size(drag_report):
    report = drag_report
    assert (report.verdict, report.named) == ("named", ("drag",))
    row = next(r for r in report.table if r.effect == "drag")
    assert abs(row.size["size"] - 0.2) < 3 * row.sd["size"] < 0.03
    assert report.gain is not None and report.gain.low > 0.5
    assert "turbulent drag of the surroundings" in row.aliases
    assert report.sentences[0].startswith("The model lacks drag (0.")


def test_extended_model_is_an_ordinary_model(drag_report):
    report = drag_report
    extended = report.extended_model()
    assert [p.name for p in extended.base][-1] == "drag"
    run = report.study.fit_runs[0]
    best = report.best
    expected = best.problem.predict(run, torch.from_numpy(best.x))
    np.testing.assert_allclose(extended.predict(run, extended.at_prior()), expected, atol=1e-9)
    refitted = fit(extended, report.study.fit_runs, report.study.channels)
    assert refitted.chi2 < fit(report.model, report.study.fit_runs, report.study.channels).chi2
    assert extended_model(best).name == "oscillator + drag"


def test_report_is_saved(drag_report, tmp_path):
    drag_report.save(tmp_path)
    plain = json.loads((tmp_path / "report.json").read_text())
    assert plain["verdict"] == "named"
    assert plain["hypotheses"][0]["effects"] == ["drag"]
    extended = yaml.safe_load((tmp_path / "extended_model.yaml").read_text())
    assert extended["effects"]["drag"]["value"] == pytest.approx(0.2, rel=0.1)
    assert extended["parameters"]["frequency"]["unit"] == "Hz"


def test_null_gives_none_and_says_what_it_could_have_seen():
    report = solve(11)
    assert (report.verdict, report.named) == ("none", ())
    assert all(0 < r.smallest_visible["size"] < np.inf for r in report.table)


def test_coarse_time_step_is_numerical():
    report = solve(12, step=0.02)
    assert report.verdict == "numerical"
    gate = next(g for g in report.gates if g.name == "time_step")
    assert not gate.passed and gate.value > 2.0


def test_exact_twins_are_ambiguous():
    twins = (toy.Drag(), toy.Delay(), toy.ClockOffset())
    report = solve(13, {"delay": 0.02}, library=twins)
    assert report.verdict == "ambiguous"
    assert {report.named, *report.rivals} == {("delay",), ("clock_offset",)}
    row = next(r for r in report.table if r.effect == "delay")
    assert "clock_offset" in row.aliases


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "options", "verdict"),
    [
        ({"pulse": 0.3}, {}, "unknown"),
        ({"tide": 0.2}, {}, "unknown"),
        ({}, {"scatter": 0.2}, "unrepeatable"),
        ({}, {"tails": True}, "none"),
        ({}, {"spikes": True}, "none"),
        ({}, {"colour": 0.7}, "none"),
        ({}, {"lost_repeat": True}, "none"),
    ],
)
def test_verdicts_beside_names(hidden, options, verdict):
    report = solve(
        21,
        hidden,
        library=toy.LIBRARY,
        unknowns=[toy.unknown_force()],
        settings=DiagnosisSettings(),
        **options,
    )
    assert report.verdict == verdict


@pytest.mark.slow
def test_two_effects_are_both_named():
    report = solve(
        22, {"drag": 0.15, "scale": 0.08}, library=toy.LIBRARY, settings=DiagnosisSettings()
    )
    assert set(report.named) == {"drag", "scale"}


def test_repeats_confirm_a_repeatable_cause_and_not_noise():
    probabilities = {}
    for common in (0.0, 1.0):
        values = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            shared = common * rng.normal() * np.linspace(-1, 1, linear.NUM_SAMPLES)[:, None]
            runs = [replace(linear.run(f"r{k}", 100 * seed + k), group="g") for k in range(2)]
            runs = [replace(r, measured=r.measured + 3 * shared) for r in runs]
            problem = linear.problem((), runs)
            x = np.zeros(2)
            mean = problem.residual(x)
            values.append(swap_probability(problem, x, mean, UnknownDrift(0, "drift"), seed=0))
        probabilities[common] = np.array(values)
    # under noise alone the probability is uniform: 20 draws below 0.02 at most twice (p = 0.007)
    assert (probabilities[0.0] < 0.02).sum() <= 2
    assert np.median(probabilities[1.0]) < np.median(probabilities[0.0])


@pytest.mark.grad
def test_gradient_gate_passes_and_sees_a_wrong_gradient():
    class Wrong(linear.Line):
        def apply(self, scene, size, run):
            scene = super().apply(scene, size, run)
            # same value, 1 % more slope
            return replace(
                scene,
                record=scene.record
                + 0.01 * (linear.shapes(self.name, run) @ (size - size.detach())),
            )

    effects = (linear.Line("push"), Wrong("pull"))
    problem, x = linear.problem(effects), np.zeros(4)
    at = Linearisation(problem, x, *problem.linearise(x), [], 1)
    gates = {g.name: g for g in gradient_gate(at)}
    assert gates["gradient:push"].passed
    assert not gates["gradient:pull"].passed


def test_data_gate_refuses_what_cannot_be_judged():
    study = toy.generate(1)
    few = replace(study, runs=tuple(r for r in study.runs if r.group == "chirp"))
    gates = {g.name: g for g in data_gate(few)}
    assert not gates["commands"].passed and not gates["held_out"].passed
    back = replace(study.runs[0], time_s=toy.TIME[::-1])
    with pytest.raises(ValueError, match=r"chirp_a: time_s must increase, .* sample 1"):
        data_gate(replace(study, runs=(back,)))
    with pytest.raises(ValueError, match=r"share names: \['drag'\]"):
        diagnose(study, toy.model(study.runs), (toy.Drag(), toy.Drag()), seed=0)


@pytest.mark.reference
def test_next_run_distance_is_what_a_refit_leaves():
    effects = (linear.Line("push"), linear.Line("pull"))
    fits = [
        fit(linear.model(), [linear.run("r1", 1)], linear.CHANNELS, effects=(e,)) for e in effects
    ]
    bank = [linear.run("bank_1", 5), linear.run("bank_2", 6)]
    advice = next_run(fits, bank)
    for run in bank:
        apart, columns, priors = 0.0, [], []
        for sign, f, e in zip((1, -1), fits, effects, strict=True):
            y, a = linear.matrices((e,), [run])
            apart = apart + sign * (y - a @ f.x)
            root = np.linalg.cholesky(f.covariance)
            columns.append(a)
            priors.append(np.linalg.inv(root))
        # smallest |apart - A d|^2 + d' C^-1 d over both rivals' parameters, by least squares
        stacked = np.block(
            [[columns[0], columns[1]], [priors[0], np.zeros((3, 3))], [np.zeros((3, 3)), priors[1]]]
        )
        target = np.concatenate([apart, np.zeros(6)])
        left = target - stacked @ np.linalg.lstsq(stacked, target, rcond=None)[0]
        np.testing.assert_allclose(advice.chi2_gain[run.name], left @ left, rtol=1e-6)
    with pytest.raises(ValueError, match="at least two fits"):
        next_run(fits[:1], bank)


def test_threads_change_nothing():
    runs = (linear.run("r1", 1), linear.run("r2", 2))
    one = Problem(linear.model(), runs, WhiteNoise(linear.CHANNELS))
    two = replace(one, workers=2)
    for a, b in zip(one.linearise(np.ones(2)), two.linearise(np.ones(2)), strict=True):
        np.testing.assert_array_equal(a, b)
