"""End to end on the toy bed; ``tests.diagnose.confusion`` measures many fresh cases."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

from diffsim.core.errors import FactorizationError
from diffsim.data.study import Run, Study
from diffsim.diagnose import diagnose, next_run
from diffsim.diagnose.checks.gates import GateResult, data_gate
from diffsim.diagnose.checks.numerics import (
    could_be_misfit,
    numerical_effects,
    numerical_shift,
    numerics_gate,
)
from diffsim.diagnose.judge.crosscheck import swap_probability
from diffsim.diagnose.say.next_run import Narrowing, narrowing
from diffsim.identify import (
    DiagnosisSettings,
    Numerics,
    Problem,
    SearchSettings,
    WhiteNoise,
    coarse,
    extended_model,
    fit,
)
from diffsim.identify.problem import PredictionError
from tests.diagnose import linear, toy

FEW = (toy.DRAG, toy.DELAY, toy.BIAS, toy.SCALE)
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
    report = solve(12, step=0.02, settings=replace(QUICK, refine_budget=1.0))
    assert report.verdict == "numerical"
    gate = next(g for g in report.gates if g.name == "time_step")
    assert not gate.passed and gate.value > 2.0


def test_a_step_that_leaves_nothing_is_no_misfit(monkeypatch):
    """A servo in MuJoCo that its own step explains to the noise was `numerical`: refined steps move
    friction, and then explain it no more."""
    monkeypatch.setattr("diffsim.diagnose.diagnosis.could_be_misfit", lambda fit, gates: True)
    assert solve(11).verdict == "none"


def test_a_coarse_step_ends_an_answer_only_where_it_could_be_the_misfit():
    failed = GateResult("time_step", False, 3.0, 2.0, "")
    gates = (failed, GateResult("data", False, 99.0, 1.0, ""))
    left = {sd: SimpleNamespace(chi2=100.0 + sd**2, num_samples=100) for sd in (4.0, 80.0)}
    assert could_be_misfit(left[4.0], gates) and not could_be_misfit(left[80.0], gates)


def test_exact_twins_are_ambiguous():
    twins = (toy.DRAG, toy.DELAY, toy.CLOCK_OFFSET)
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
        ({}, {"color": 0.7}, "none"),
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
            # two commands of five blocks each
            runs = [
                replace(linear.run(f"r{k}", 100 * seed + k), group=f"g{k // 2}") for k in range(4)
            ]
            runs = [replace(r, measured=r.measured + 3 * shared) for r in runs]
            problem = linear.problem((), runs)
            x = np.zeros(2)
            values.append(swap_probability(problem, problem.residual(x), seed=0))
        probabilities[common] = np.array(values)
    # under noise alone the probability is uniform: 20 draws below 0.02 at most twice (p = 0.007)
    assert (probabilities[0.0] < 0.02).sum() <= 2
    assert np.median(probabilities[1.0]) < np.median(probabilities[0.0])


def test_one_loud_block_does_not_hide_that_all_others_repeat():
    """All ten blocks repeat, two a hundred times as loud: those alone decided, one in four."""
    shape = np.full((linear.NUM_SAMPLES, 1), 20.0)
    shape[:3] *= 100.0
    runs = [replace(linear.run(f"r{k}", k), group=f"g{k // 2}") for k in range(4)]
    runs = [replace(r, measured=r.measured + shape) for r in runs]
    problem = linear.problem((), runs)
    x = np.zeros(2)
    assert swap_probability(problem, problem.residual(x), seed=0) <= 0.02


def test_data_gate_refuses_what_cannot_be_judged():
    study = toy.generate(1)
    few = replace(study, runs=tuple(r for r in study.runs if r.group == "chirp"))
    gates = {g.name: g for g in data_gate(few)}
    assert not gates["commands"].passed and not gates["held_out"].passed
    with pytest.raises(ValueError, match=r"'chirp_a' must be finite and increase, .* sample 1"):
        replace(study.runs[0], time_s=toy.TIME[::-1])
    with pytest.raises(ValueError, match=r"share names: \['drag'\]"):
        diagnose(study, toy.model(study.runs), (toy.DRAG, toy.DRAG), seed=0)


@pytest.mark.reference
def test_next_run_distance_is_what_a_refit_leaves():
    effects = (linear.line("push"), linear.line("pull"))
    fits = [
        fit(linear.model(), [linear.run("r1", 1)], linear.CHANNELS, effects=(e,)) for e in effects
    ]
    bank = [linear.run("bank_1", 5), linear.run("bank_2", 6)]
    advice = next_run(fits, bank)
    for run in bank:
        apart, columns, priors = 0.0, [], []
        for sign, f, e in zip((1, -1), fits, effects, strict=True):
            y, a = linear.matrices((e,), [run])
            apart = apart + sign * (y - a @ f.problem.scaled(f.x))
            root = np.linalg.cholesky(f.covariance)
            columns.append(a * f.problem.stretch(f.x))
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


def test_a_run_that_no_rival_can_follow_is_no_advice(monkeypatch):
    """A quadrotor's answer was lost at its last step: a set's forces did not settle in a run."""
    effects = (linear.line("push"), linear.line("pull"))
    runs = [linear.run("r1", 1)]
    fits = [fit(linear.model(), runs, linear.CHANNELS, effects=(e,)) for e in effects]
    bank = [linear.run("bank_1", 5), linear.run("wild", 6)]
    plain = Problem.linearize

    def unsettled(problem, *given, **more):
        if any(run.name == "wild" for run in problem.runs):
            raise FactorizationError("not definite", pivot=0, value=-1.0)
        return plain(problem, *given, **more)

    monkeypatch.setattr(Problem, "linearize", unsettled)
    assert set(next_run(fits, bank).chi2_gain) == {"bank_1"}
    with pytest.raises(PredictionError, match="none of the 1 runs"):
        next_run(fits, bank[1:])


@pytest.mark.reference
def test_what_a_run_narrows_is_what_a_fit_with_it_knows():
    push = linear.line("push")
    runs = [linear.run("r1", 1), linear.run("r2", 5)]
    now, then = (
        fit(linear.model(), given, linear.CHANNELS, effects=(push,)) for given in (runs[:1], runs)
    )
    again = replace(now, jacobian=then.problem.linearize(now.x)[1])  # slopes where it is now
    found = narrowing(now, [runs[1]], ["push"])
    k = now.problem.names.index("push")
    expected = np.sqrt(again.covariance[k, k] / now.covariance[k, k])
    assert found.shares["r2"]["push"] == pytest.approx(expected, rel=1e-9)
    assert found.best == "r2" and found.words.endswith(f"of push to {expected:.2g} of its width")
    useless = Narrowing("r2", {"r2": {"push": 0.97}})
    assert useless.words == "none of these runs narrows an interval by more than 5 %"
    with pytest.raises(ValueError, match="names is empty"):
        narrowing(now, runs, [])


def test_threads_change_nothing():
    runs = (linear.run("r1", 1), linear.run("r2", 2))
    one = Problem(linear.model(), runs, WhiteNoise(linear.CHANNELS))
    two = replace(one, workers=2)
    for a, b in zip(one.linearize(np.ones(2)), two.linearize(np.ones(2)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_numerical_cause_is_named_where_accepted():
    report = solve(12, step=0.02, settings=replace(QUICK, accept_numerics=True))
    row = next(r for r in report.table if r.effect == "coarse_time_step")
    assert row.status in ("named", "rival")
    # a first-order method: halving the step halves the error, so the whole error is phi near 2
    assert 1.0 < row.size["size"] < 3.0


@pytest.mark.reference
def test_numerical_shift_is_what_a_refit_to_the_refined_record_moves():
    runs = [linear.run("r1", 1), linear.run("r2", 2)]
    effect = linear.line("push")
    rng = np.random.default_rng(0)
    changes = [rng.normal(size=(2, *runs[0].measured.shape)) for _ in range(2)]
    before = fit(linear.model(), runs, linear.CHANNELS, effects=(effect,))
    moved = []
    for change in changes:
        shifted = [replace(r, measured=r.measured + c) for r, c in zip(runs, change, strict=True)]
        after = fit(linear.model(), shifted, linear.CHANNELS, effects=(effect,))
        moved.append(after.x - before.x)
    found = numerical_shift(before, {str(k): c.ravel() for k, c in enumerate(changes)})
    # linear in base parameters; the prior of a size is not normal, so it moves a little otherwise
    np.testing.assert_allclose(found, np.linalg.norm(moved, axis=0), rtol=0.03)


@pytest.mark.reference
def test_numerics_gate_is_the_distance_under_the_marginal_normal():
    """The nats that a cause of just that shape could have, whatever base parameters take up."""
    runs = [linear.run("r1", 1), linear.run("r2", 2)]
    sd = np.array([c.sd for c in linear.CHANNELS])
    found = fit(linear.model(), runs, linear.CHANNELS)
    _, a = linear.matrices((), runs)
    absorbed = a[:, 0] * 10.0  # of the kind that base parameters take up, ten prior sd far
    cases = {"random": np.random.default_rng(0).normal(size=len(a)), "absorbed": absorbed}
    raw = {k: (c.reshape(-1, 2) * sd).ravel() for k, c in cases.items()}
    gates = {g.name: g for g in numerics_gate(found, raw)}
    for name, change in cases.items():
        squared = change @ np.linalg.solve(np.eye(len(a)) + a @ a.T, change)
        assert gates[name].value == pytest.approx(np.sqrt(squared), rel=1e-6)
    assert not gates["absorbed"].passed
    rounding = {"time_step": 1e-9 * raw["random"], "mesh": raw["random"]}
    assert [e.name for e in numerical_effects(found, rounding)] == ["coarse_mesh"]


def test_numerical_cause_blends_predictions_one_by_one_and_many():
    run = toy.generate(1).runs[0]
    model = toy.model([run], 0.02)
    cause, q = coarse("time_step", Numerics(time_step=0.5)), torch.zeros(5)
    q = q.double()
    rough, fine = (model.predict(run, q, None, Numerics(time_step=h)) for h in (1.0, 0.5))
    sizes = torch.tensor([[0.0], [0.4], [1.0]], dtype=torch.float64)
    expected = torch.stack([rough, 0.6 * rough + 0.4 * fine, fine])
    many = model.predict_many(run, q.expand(3, 5), {cause: sizes})
    np.testing.assert_allclose(many, expected, atol=1e-12)
    for size, want in zip(sizes, expected, strict=True):
        np.testing.assert_allclose(model.predict(run, q, {cause: size}), want, atol=1e-12)


def test_interrupted_diagnosis_goes_on_from_its_cache(tmp_path):
    study = toy.generate(2, {"drag": 0.2})
    reports, made = [], []

    def stop(stage, fraction, message):
        reports.append((stage, fraction))
        if stage == "gain":
            raise KeyboardInterrupt

    def go(progress=None, cache=tmp_path):
        model = toy.model(study.runs)
        built = model.build
        made.append(0)

        def build(*given):
            made[-1] += 1
            return built(*given)

        model.build = build
        return diagnose(study, model, FEW, seed=0, settings=QUICK, progress=progress, cache=cache)

    with pytest.raises(KeyboardInterrupt):
        go(stop)
    assert [f for _, f in reports] == sorted(f for _, f in reports)
    again, fresh = go(), go(cache=None)
    assert again.verdict == fresh.verdict == "named" and again.named == fresh.named
    row, same = (next(r for r in x.table if r.effect == "drag") for x in (again, fresh))
    assert abs(row.size["size"] - same.size["size"]) < 0.1 * row.sd["size"]
    # what was read back counts as it did when it was simulated: budgets end at the same place
    assert again.settings["work"] == fresh.settings["work"]
    assert made[1] < 0.7 * made[2]
    for file in tmp_path.rglob("*.npz"):  # not whole: simulated again
        file.write_bytes(file.read_bytes()[:100])
    assert go().named == ("drag",)


def test_model_is_prepared_at_the_null_fit():
    study, seen = toy.generate(2, {"drag": 0.2}), []

    class Prepared(type(toy.model(study.runs))):
        def prepared_at(self, q, runs=()):
            seen.append(q)
            return Prepared(self.build, self.base, "prepared", batched=True)

    plain = toy.model(study.runs)
    model = Prepared(plain.build, plain.base, "plain", batched=True)
    report = diagnose(study, model, FEW[:1], seed=0, settings=QUICK)
    assert len(seen) == 1 and seen[0].shape == (len(plain.base),)
    assert report.null.problem.model.name == "prepared"
    assert report.verdict == "named"


def test_force_map_finds_where_a_push_acts():
    report = solve(
        21, {"pulse": 0.3}, library=(toy.BIAS,), unknowns=[toy.unknown_force()], settings=QUICK
    )
    found = report.force_map
    assert found.values.shape == found.noise.shape == (3, 21)
    # generated at 1.7 s; knots every 0.2 s
    at = 0.2 * np.abs(found.z).argmax(axis=1)
    assert np.abs(at - 1.7).max() < 0.5
    quiet = solve(11, library=(toy.BIAS,), unknowns=[toy.unknown_force()]).force_map
    assert np.abs(quiet.z).max() < 5.0 < np.abs(found.z).max()
    json.dumps(report.to_dict())


def test_what_select_runs_refute_is_withdrawn_and_says_so():
    """A push that every fitted run asks for and that is opposite in the run that selects."""
    push, other = linear.line("push"), linear.line("other")

    def recorded(name, seed, size, **changes):
        run = linear.run(name, seed, **changes)
        model = linear.model()
        clean = model.predict(run, model.at_prior(), {push: torch.tensor([size]).double()})
        return replace(run, measured=run.measured + clean.numpy())

    runs = [recorded(f"r{k}", k, 1.0) for k in range(3)]
    runs.append(recorded("last", 3, -1.0, use="select"))
    study = Study("refuted", "copter", linear.CHANNELS, tuple(runs))
    report = diagnose(study, linear.model(), (push, other), seed=0, settings=QUICK)
    row = next(r for r in report.table if r.effect == "push")
    assert (row.status, row.note) == ("withdrawn", "worse on unseen runs")
    assert row.gain is not None and row.gain.high < 0.0
    assert "push" not in report.named
    assert report.verdict == "unknown"


def repeated_pair(shared, *, num_samples=600, step_s=0.01):
    """A problem of two repeats of white noise that share a course."""
    rng = np.random.default_rng(7)
    time = step_s * np.arange(num_samples)
    sd = np.array([c.sd for c in linear.CHANNELS])
    runs = [
        Run(name, time, sd * (rng.normal(size=(num_samples, 2)) + shared(time)[:, None]), {}, "g")
        for name in ("a", "b")
    ]
    problem = linear.problem((), runs)
    return problem, np.concatenate([(run.measured / sd).ravel() for run in runs])


@pytest.mark.parametrize("frequency_Hz", [0.3, 4.0, 20.0])
def test_repeats_show_what_is_faster_than_the_knots_of_any_force(frequency_Hz):
    """A third of the noise at any frequency; forty knots over 6 s follow 1 Hz."""
    problem, left = repeated_pair(lambda t: 0.5 * np.sin(2.0 * np.pi * frequency_Hz * t))
    assert swap_probability(problem, left, seed=0) <= 0.02
    apart = left * np.repeat([1.0, -1.0], len(left) // 2)  # as loud, but not the same
    assert swap_probability(problem, apart, seed=0) > 0.1


def test_something_is_called_repeatable_only_where_repeats_show_it():
    """A pulse of the surroundings with its repeats, and with a single run of each command."""
    study = toy.generate(21, {"pulse": 0.3})
    single = replace(study, runs=tuple(r for r in study.runs if not r.name.endswith("_b")))
    said = {}
    for name, runs in (("repeats", study), ("single", single)):
        report = diagnose(
            runs,
            toy.model(runs.runs),
            (toy.BIAS,),
            seed=0,
            unknowns=[toy.unknown_force()],
            settings=QUICK,
        )
        assert report.verdict == "unknown"
        said[name] = " ".join(report.sentences)
    assert "real and repeatable" in said["repeats"]
    assert "repeatable is missing" not in said["single"]
    assert "cannot be checked: no repeated run" in said["single"]


def test_repeats_too_short_to_tell_do_not_refute_an_unknown_cause():
    """One pair of 1.5 s makes five blocks: one draw in 32 swaps nothing."""
    runs = [replace(linear.run(f"r{k}", k), group="g") for k in range(2)]
    problem = linear.problem((), runs)
    x = np.zeros(2)
    assert swap_probability(problem, problem.residual(x), seed=0) is None
