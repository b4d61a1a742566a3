"""Known sizes keep their sign, and draws of spreads follow their posterior."""

import numpy as np
import pytest

from diffsim.diagnose.faults import judge_faults
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.learn import NUM_DRAWS, learn, log_posterior
from diffsim.diagnose.faults.local import Local
from diffsim.diagnose.faults.one_sided import Terms, above_zero
from diffsim.diagnose.faults.verdict import SILENT
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import WhiteNoise
from tests.diagnose.faults import days


@pytest.mark.parametrize("mean", [-6.0, -1.0, 0.0, 0.4, 5.0])
def test_moments_above_zero_are_those_of_numerical_integration(mean):
    sd = 1.7
    x = np.linspace(0.0, max(mean, 0.0) + 10.0 * sd, 200_001)
    weight = np.exp(-0.5 * ((x - mean) / sd) ** 2 + 0.5 * (min(mean, 0.0) / sd) ** 2)
    weight /= weight.sum()
    center = float(weight @ x)
    found = above_zero(np.array([mean]), np.array([sd**2]))
    # the grid's step is 1e-4 of the sd, and its first point counts whole
    assert found[0][0] == pytest.approx(center, abs=1e-4)
    assert found[1][0] == pytest.approx(float(weight @ (x - center) ** 2), abs=2e-4)


def test_terms_give_a_size_the_moments_of_its_positive_side():
    local = Local((), (), ("cut",), np.array([[4.0]]), np.array([-2.0]), 0.0, 1)
    mean, variance = np.array([-0.5]), np.array([0.25])
    terms = Terms.none(local).renewed(local, mean, variance, {"cut"})
    held = terms.on(local)
    above, left = above_zero(mean, variance)
    assert held.slope[0] / held.curvature[0, 0] == pytest.approx(above[0])
    assert 1.0 / held.curvature[0, 0] == pytest.approx(left[0])
    again = terms.renewed(local, above, left, {"cut"})  # settled: once more changes nothing
    assert again.slope[0] == pytest.approx(terms.slope[0])
    assert not Terms.none(local).renewed(local, mean, variance, ()).slope.any()


def one_kit_was_always_changed(rng: np.random.Generator) -> list:
    """Sound days of one kit, and days of another with a known fault of the first reading."""
    runs = [r for k in range(5) for r in days.group(f"sound{k}", rng, {}, "sound", kit="old")]
    for k, size in enumerate((0.02, 0.05, 0.15, 0.25, 0.3)):
        runs += days.group(f"known{k}", rng, {"first": size}, "first", kit="worn")
    return runs


def test_a_fault_is_seen_in_a_state_that_nobody_saw_without_it(monkeypatch):
    """A reading that was always changed has no level of its own but for the sign of the change."""
    monkeypatch.setitem(days.KITS, "old", (1.0, 1.0, 1.0, 1.0))
    monkeypatch.setitem(days.KITS, "worn", (1.03, 0.95, 1.05, 0.95))
    monkeypatch.setattr(days, "DAY", 0.01)
    rng = np.random.default_rng(0)
    runs = one_kit_was_always_changed(rng)
    for label, sizes in {"null": {}, "first": {"first": 0.15}}.items():
        runs += days.group(label, rng, sizes, kit="worn")
        for run in runs[-days.NUM_RUNS :]:
            run.setup["kit"] = "?"
    study = days.study(runs, state="kit")
    said = {v.group: v for v in judge_faults(study, days.setup(study)).verdicts}
    assert said["null"].status == SILENT
    assert said["first"].causes == ("first",)


def test_draws_of_spreads_follow_their_posterior():
    """A normal distribution about the best spreads gives large ones far more than is theirs."""
    rng = np.random.default_rng(2)
    study = days.study(
        [r for k in range(6) for r in days.group(f"sound{k}", rng, {}, "sound")],
        scatter=[["gain_0", "gain_1", "gain_2", "gain_3"]],
    )
    setup = days.setup(study)
    given = take_apart(study, setup)
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    groups: tuple[Group, ...] = given.groups
    learned = learn(problem, given.layout, groups, seed=0)
    at = np.linspace(-3.0, 2.0, 501)
    level = np.array([log_posterior(given.layout, learned.locals, np.array([t]))[0] for t in at])
    share = np.exp(level - level.max())
    share /= share.sum()
    mean = float(share @ at)
    sd = float(np.sqrt(share @ (at - mean) ** 2))
    # 32 stratified draws of 128: the mean of 128 independent ones scatters by sd / 11
    assert abs(learned.draws.mean() - mean) < 3.0 * sd / np.sqrt(128)
    assert learned.draws.shape == (NUM_DRAWS, 1)
    assert 0.75 * sd < learned.draws.std() < 1.25 * sd


@pytest.mark.slow  # 30 CPU s: 10 rigs of 24 hidden groups
def test_rates_where_one_kit_was_always_changed(monkeypatch):
    """Faults in that kit are named (6 of 40 without the sign), and sound days rarely accused."""
    monkeypatch.setattr(days, "DAY", 0.01)
    named, alarms, holds = 0, 0, []
    for seed in range(100, 110):
        rng = np.random.default_rng(seed)
        for kit in ("old", "worn"):
            monkeypatch.setitem(days.KITS, kit, tuple(1.0 + 0.06 * rng.standard_normal(4)))
        runs = one_kit_was_always_changed(rng)
        true = {}
        for kit in ("old", "worn"):
            for k in range(4):
                true[f"null_{kit}{k}"] = (kit, {})
                true[f"first_{kit}{k}"] = (kit, {"first": rng.uniform(0.1, 0.25)})
                true[f"second_{kit}{k}"] = (kit, {"second": rng.uniform(0.1, 0.25)})
        for label, (kit, sizes) in true.items():
            runs += days.group(label, rng, sizes, kit=kit)
            for run in runs[-days.NUM_RUNS :]:
                run.setup["kit"] = "?"
        study = days.study(runs, state="kit")
        for verdict in judge_faults(study, days.setup(study)).verdicts:
            sizes = true[verdict.group][1]
            named += verdict.group.startswith("first_worn") and verdict.causes == ("first",)
            alarms += not sizes and verdict.status != SILENT
            holds += [
                s.interval.low <= sizes[s.cause] <= s.interval.high
                for s in verdict.sizes
                if s.cause in sizes
            ]
    assert named >= 25  # of 40; 29 when this was written
    assert alarms <= 4  # of 80; a fault has even odds beforehand, so some are to be expected
    assert 0.84 < np.mean(holds) < 0.96  # of about 140, 90 % wanted: two sd of their number
