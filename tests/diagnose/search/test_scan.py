"""Effects with kinks: found where slopes at zero show nothing, alone and masked by each other."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from diffsim.data.study import Study
from diffsim.diagnose.checks.gates import budget_gates
from diffsim.diagnose.checks.noise import noise_floor
from diffsim.diagnose.search import fitted_sets as beside_unknowns
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.fit import Case, Null
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.scan import (
    first_runs,
    groups,
    least_tried,
    num_points,
    records_for,
    run_for_scans,
    scan,
)
from diffsim.diagnose.search.search import (
    FIT_NATS,
    FIT_RTOL,
    _better_subset,
    begin,
    repaired,
    search_sets,
)
from diffsim.diagnose.search.simulations import Simulations
from diffsim.diagnose.search.store import Store
from diffsim.identify import DiagnosisSettings, Effect, SearchSettings, UnknownDrift
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import linearization_at
from tests.diagnose import linear

TYPICAL = 0.5
WAVE = 4.0 * torch.sin(torch.linspace(0.0, 12.0, linear.NUM_SAMPLES, dtype=torch.float64))


def clipped(name="limit", signed=False):
    """Nothing happens below the size 0.25; above, the wave's tips are cut: a limit 1 / size."""

    def apply(scene, size, run):
        lost = WAVE - WAVE.clamp(
            -1.0 / size.abs().clamp(min=1e-9), 1.0 / size.abs().clamp(min=1e-9)
        )
        return replace(scene, record=scene.record - size.sign() * lost[:, None])

    return kinked(name, apply, signed)


def kinked(name, apply, signed=False, masks=()):
    return Effect(
        name=name,
        family=name,
        kind="actuator",
        unit="-",
        typical=TYPICAL,
        signed=signed,
        smooth=False,
        masks=masks,
        apply=apply,
    )


class Pair:
    """Two causes of which each shows only beside the other."""

    def __init__(self):
        self.slack = kinked("slack", self.act("slack"), masks=("rate_limit",))
        self.rate_limit = kinked("rate_limit", self.act("rate_limit"))

    @staticmethod
    def act(name):
        def apply(scene, size, run):
            seen = {**getattr(scene, "sizes", {}), name: (size[..., 0] / TYPICAL - 0.5).clamp(0.0)}
            record = scene.record
            if len(seen) == 2:
                moved = linear.shapes("both", run)[..., 0]
                record = record + 3.0 * moved * torch.sqrt(seen["slack"] * seen["rate_limit"])
            after = linear.LinearScene(record)
            after.sizes = seen
            return after

        return apply


def searched(effects, truth, settings=None, unknowns=()):
    """Search on runs that hold effects of these sizes."""
    model = linear.model()
    runs = []
    for r in (linear.run("r1", 1), linear.run("r2", 2)):
        scene = linear.LinearScene(torch.zeros(linear.NUM_SAMPLES, 2, dtype=torch.float64))
        for e, size in truth.items():
            scene = e.apply(scene, torch.tensor([size], dtype=torch.float64), r)
        runs.append(replace(r, measured=r.measured + scene.record.numpy()))
    study = Study("kinks", "soft_body", linear.CHANNELS, tuple(runs))
    case = Case(study, model, tuple(effects), unknowns, settings or DiagnosisSettings())
    noise = noise_floor(
        runs, study.channels, {r.name: linear.run(r.name, 1).measured for r in runs}
    )
    problem = case.problem(noise.whitener)
    fit, at = gauss_newton(problem, linearization_at(problem, np.zeros(2)))
    null = Null(case, noise, fit, at, 0)
    return search_sets(begin(null, Simulations(null.wide)))


def best_of(search):
    return max(search.posteriors, key=search.nats).effects


def test_a_pair_is_weighed_and_begins_at_the_size_that_was_tried_of_one_of_both():
    effects = (linear.line("push"), clipped())
    search = searched(effects, {effects[0]: 0.3, effects[1]: 4.0})
    made, plain = search.simulations, search.plain
    at_zero = made.center(frozenset(), plain.at, 1)
    center, _ = replace(made, scans={}).scanned(at_zero, search.settings, 1)
    both = frozenset({0, 1})
    assert center.towards(both) is center.scanned[frozenset({1})]
    more = center.weigh(both).nats - at_zero.weigh(both).nats
    alone = center.weigh(frozenset({1})).nats - at_zero.weigh(frozenset({1})).nats
    assert more > 0.5 * alone > KEEP_NATS
    assert center.towards(frozenset({0})) is center  # its own size was not tried


@pytest.mark.parametrize(("signed", "size"), [(False, 4.0), (False, 0.6), (True, -3.0)])
def test_a_limit_that_acts_only_at_large_sizes_is_found(signed, size):
    effects = (linear.line("push"), clipped(signed=signed))
    search = searched(effects, {effects[1]: size})
    assert best_of(search) == {1}
    fit = search.fit_of(frozenset({1}))
    assert fit.values["limit"] == pytest.approx(size, abs=4.0 * fit.sd["limit"])


def test_sizes_that_an_effect_names_are_tried_instead_of_decades():
    """Between 0.5 and 1.5 of the typical size lies nothing but what the effect asks for."""
    narrow = replace(clipped(), tries=(0.7, 0.8))
    assert (num_points([clipped()]), num_points([narrow])) == (6, 2)


def test_many_sizes_are_tried_in_one_run_and_looked_around():
    """Of forty sizes up to six times the usual one the true one is none; the scan comes nearer."""
    close = replace(clipped(), tries=tuple(np.linspace(0.15, 6.0, 40)))
    assert (num_points([close]), num_points([close], 4)) == (66, 23)
    problem = linear.problem((close,))
    lost = (WAVE - WAVE.clamp(-0.5, 0.5)).numpy()[:, None]
    runs = [replace(r, measured=r.measured - lost) for r in problem.runs]
    problem = replace(problem, runs=tuple(runs))
    at = linearization_at(problem, np.zeros(3), screen=True)
    found = scan(problem, [0, 1], at, [0])
    coarse = scan(replace(problem, effects=(clipped(),)), [0, 1], at, [0])
    assert found.num_points == num_points([close], len(first_runs(problem.runs)))
    measured = np.concatenate([np.nan_to_num(run.measured).ravel() for run in problem.runs])
    costs = [np.sum(np.square(measured - f.at.record)) for f in (found, coarse)]
    assert costs[0] < costs[1]
    assert least_tried(close) == pytest.approx(0.15 * TYPICAL) and least_tried(clipped()) == 0.0


def test_sizes_that_all_runs_cannot_pay_are_tried_in_the_worst_one():
    """Where each is a simulation; fits that begin there have all runs."""
    effect = clipped()
    problem = linear.problem((effect,))
    lost = (WAVE - WAVE.clamp(-0.5, 0.5)).numpy()[:, None]
    first, *others = problem.runs
    runs = (replace(first, measured=first.measured - lost), *others)
    problem = replace(problem, runs=runs, model=copy(problem.model))
    at = linearization_at(problem, np.zeros(3), screen=True)
    points, group = num_points([effect]), [frozenset({0})]
    enough = points * problem.cost()
    problem.model.batched = True  # then all runs are cheap
    assert run_for_scans(problem, at, group, (400.0, enough - 1.0)) is None
    problem.model.batched = False
    assert run_for_scans(problem, at, group, (400.0, enough)) is None
    assert run_for_scans(problem, at, group, (points - 1.0, enough - 1.0)) is None
    assert run_for_scans(problem, at, group, (400.0, enough - 1.0)) == 0
    tally, counts = problem.model.simulations, []
    for run in (None, 0):
        before = tally.count
        found = scan(problem, [0, 1], at, [0], run)
        counts.append(tally.count - before)
        assert len(found.at.record) == len(at.record)
    assert counts[0] - counts[1] == points * (len(first_runs(runs)) - 1) > 0


def test_without_scans_it_is_not():
    """The slope at a tenth of the typical size is zero."""
    effects = (linear.line("push"), clipped())
    settings = DiagnosisSettings(search=SearchSettings(scan_points=0))
    assert 1 not in best_of(searched(effects, {effects[1]: 4.0}, settings))


def test_causes_that_mask_each_other_enter_as_a_pair():
    pair = Pair()
    effects = (linear.line("push"), pair.slack, pair.rate_limit)
    search = searched(effects, {pair.slack: 6.0, pair.rate_limit: 2.0})
    assert best_of(search) == {1, 2}
    for alone in ({1}, {2}):
        key = Hypothesis(frozenset(alone))
        entries = {**search.linear, **search.posteriors}
        assert entries[key].nats < search.nats(Hypothesis()) + 1.0
    alone = tuple(replace(e, masks=()) for e in effects)
    assert best_of(searched(alone, {pair.slack: 6.0, pair.rate_limit: 2.0})) != {1, 2}


def test_the_number_of_points_is_bounded_and_as_told():
    pair = Pair()
    assert num_points([pair.slack]) == 6 and num_points([clipped(signed=True)]) == 12
    assert num_points([pair.slack, pair.rate_limit]) == 25
    effects = (pair.slack, pair.rate_limit, linear.line("push"))
    names = [sorted(g) for g in groups(effects, frozenset(), 3)]
    assert names == [[0], [1], [0, 1]]
    assert [sorted(g) for g in groups(effects, frozenset({0}), 1)] == [[1]]
    placed = (replace(pair.slack, name="slack_b"), replace(pair.rate_limit, name="rate_limit_b"))
    assert frozenset({0, 1}) in groups(placed, frozenset(), 2)
    lag = replace(linear.line("lag"), masks=("slack",))
    pairs = [sorted(g) for g in groups((lag, pair.slack, pair.rate_limit), frozenset(), 2)]
    assert pairs[2:] == [[1, 2], [0, 1]]  # the one of two kinks first
    few = DiagnosisSettings(search=SearchSettings(scan_points=12))
    search = searched(effects, {pair.slack: 6.0, pair.rate_limit: 2.0}, few)
    assert sum(s.num_points for s in search.simulations.scans.values()) <= 12


def test_a_scan_refits_the_rest_and_says_where_nothing_is_better():
    effect = clipped()
    problem = linear.problem((effect,))
    at = linearization_at(problem, np.zeros(3), screen=True)
    assert scan(problem, [0, 1], at, [0]).at is None  # pure noise
    lost = (WAVE - WAVE.clamp(-0.5, 0.5)).numpy()[:, None]
    runs = [
        replace(
            r,
            measured=r.measured - lost + 2.0 * 0.7 * linear.shapes("mass", r).numpy()[..., 0],
        )
        for r in problem.runs
    ]
    problem = replace(problem, runs=tuple(runs))
    at = linearization_at(problem, np.zeros(3), screen=True)
    found = scan(problem, [0, 1], at, [0])
    size = problem.size_units[0] * problem.scaled(found.at.x)[2]
    assert size == pytest.approx(3.0 * TYPICAL)  # of the scanned ones, next to 2


def test_a_set_is_never_worse_than_its_subset():
    """A set whose fit ended in a bad place is repaired from its subset's optimum."""
    effects = (linear.line("push"), linear.line("pull"))
    search = searched(effects, {effects[0]: 2.0})
    both, one = frozenset({0, 1}), frozenset({0})
    far = search.simulations.wide
    x = np.array([4.0, -4.0, 0.0, 1.0])
    stopped = linearization_at(far, x)
    made = replace(search.simulations, fitted={**search.simulations.fitted, both: stopped})
    residual, slopes = far.linearize(x)
    bad = summary(far, x, residual, slopes, False, "stuck", 3)
    search = replace(search, simulations=made).with_fit(both, bad)
    assert bad.chi2 + bad.prior > search.fit_of(one).chi2 + search.fit_of(one).prior
    after = repaired(search).fit_of(both)
    assert after.converged
    assert after.chi2 + after.prior <= search.fit_of(one).chi2 + search.fit_of(one).prior + 1e-6


@pytest.mark.property
def test_a_subset_is_better_by_misfit_and_prior_together():
    rng, both = np.random.default_rng(4), frozenset({0, 1})
    names = (frozenset(), frozenset({0}), frozenset({1}), both)
    found = set()
    for misfit in (0.0, 300.0):
        for costs in rng.uniform(0.0, 40.0, (40, 4, 2)):
            fits = {
                s: SimpleNamespace(chi2=misfit + chi2, prior=prior, num_samples=100)
                for s, (chi2, prior) in zip(names, costs, strict=True)
            }
            search = SimpleNamespace(fits=fits, fit_of=fits.__getitem__)
            best = names[np.argmin(costs[:3].sum(1))]
            lead = 0.5 * (costs[3].sum() - costs[:3].sum(1).min())
            exact = max(FIT_NATS, FIT_RTOL * 0.5 * max(fits[both].chi2 - 100.0, 0.0))
            assert _better_subset(search, both) == (best if lead > exact else None)
            found.add(lead > exact)
    assert found == {True, False}


def test_scans_end_when_their_budget_is_spent():
    pair = Pair()
    effects = (pair.slack, pair.rate_limit, linear.line("push"))
    short = DiagnosisSettings(search=SearchSettings(scan_steps=-1.0))
    search = searched(effects, {pair.slack: 6.0, pair.rate_limit: 2.0}, short)
    assert not search.simulations.scans
    (said,) = budget_gates(len(search.simulations.scans_late), 0, search.settings, search.null.fit)
    assert said.value > 0.0 and not said.passed and "were spent before" in said.note
    assert not tuple(budget_gates(0, 0, search.settings, search.null.fit))


def test_an_interrupted_diagnosis_does_not_scan_again(tmp_path, monkeypatch):
    effects = (linear.line("push"), clipped())
    problem = linear.problem(effects)
    made = Simulations(problem, Store(tmp_path, "key", problem.model.simulations))
    at = linearization_at(problem, np.zeros(4), screen=True)
    made = replace(made, screened={frozenset(): at})
    center = made.center(frozenset(), at, 2)
    settings = SearchSettings()
    first, counted = made.scanned(center, settings, 2)
    calls = []
    monkeypatch.setattr("diffsim.diagnose.search.simulations.scan", lambda *a: calls.append(a))
    again, kept = made.scanned(center, settings, 2)
    assert not calls
    assert set(again.scanned) == set(first.scanned)
    assert kept.scan_steps == counted.scan_steps > 0


def test_a_set_beside_an_unknown_cause_is_worth_what_a_simulation_says(monkeypatch):
    """A response that saturates: its slopes promise what no size does."""

    def apply(scene, size, run):
        moved = linear.shapes("push", run)[..., 0] * torch.tanh(0.3 * size[..., 0])
        return replace(scene, record=scene.record + moved)

    bent = replace(linear.line("push"), apply=apply)
    weighed, weigh = [], beside_unknowns._weigh_beside

    def spy(*args):
        weighed.append(weigh(*args))
        return weighed[-1]

    monkeypatch.setattr(beside_unknowns, "_weigh_beside", spy)
    search = searched((bent,), {linear.line("push"): 3.0}, unknowns=(UnknownDrift(0, "drift"),))
    key = Hypothesis(frozenset({0}), 0)
    evidence, _ = search.simulations.with_unknowns(
        search.plain, search.unknowns, search.num_families
    )
    start = replace(search, posteriors={**search.posteriors, key: evidence.weigh(key)})
    found = beside_unknowns.relinearized(start, key, evidence)
    promised, simulated = (w.nats for w in weighed[-2:])
    assert found.nats(key) == simulated < promised - 1.0


def test_of_repeats_only_the_first_is_simulated():
    """A repeat moves as the first run of its command does, off by what it is off at the center."""
    runs = [linear.run(f"r{k}", k) for k in (1, 2, 3)]
    runs[1] = replace(runs[1], group="r1")  # linear.run: a group each
    problem = linear.problem((linear.line("push"),), runs)
    points = np.array([[0.1, -0.2, 0.5], [0.0, 0.0, 2.0]])
    here = problem.record(np.zeros(3))
    before = problem.model.simulations.count
    first, repeat, other = np.split(records_for(problem, points, here), 3, axis=1)
    assert problem.model.simulations.count - before == 2 * len(points)
    exact = np.split(problem.records(points), 3, axis=1)
    own = np.split(here, 3)
    np.testing.assert_array_equal(first, exact[0])
    np.testing.assert_array_equal(other, exact[2])
    np.testing.assert_allclose(repeat, exact[0] + own[1] - own[0])
    assert np.abs(own[1] - own[0]).max() > 0.1


@pytest.mark.parametrize(
    "change",
    [{"setup": {"load_kg": 0.1}}, {"command": {"u": np.ones(linear.NUM_SAMPLES)}}, {"group": "r2"}],
)
def test_other_commands_and_setups_are_simulated(change):
    first = replace(linear.run("r1", 1), command={"u": np.zeros(linear.NUM_SAMPLES)})
    runs = (first, replace(first, **{"name": "r2", **change}))
    problem = linear.problem((linear.line("push"),), runs)
    points = np.array([[0.1, -0.2, 0.5]])
    made = records_for(problem, points, problem.record(np.zeros(3)))
    np.testing.assert_array_equal(made, problem.records(points))
