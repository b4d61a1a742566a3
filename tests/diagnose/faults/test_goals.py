"""Rows of one goal are one witness, and neither a missed goal nor a misread row is a fault."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from diffsim.data import load_study
from diffsim.diagnose.faults import judge_faults
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.goals import Rows, Tails, rows_at
from diffsim.diagnose.faults.learn import learn
from diffsim.diagnose.faults.verdict import CERTAIN, SILENT
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of

STUDY = """\
name: stage
model:
  system: bench
  parameters: {stands_1: &s {value: 0, sd: 100, per: run}, stands_2: *s}
  define: {told_1: goal_1, told_2: goal_2}
  readings: {x1: told_1, x2: told_2}
  effects:
    only: []
    own:
      - {name: off_1, changes: {told_1: told_1 + size}, typical: 20}
      - {name: off_2, changes: {told_2: told_2 + size}, typical: 20}
      - {name: stuck_1, changes: {told_1: told_1 + size*(stands_1 - told_1)}, typical: 1}
      - {name: stuck_2, changes: {told_2: told_2 + size*(stands_2 - told_2)}, typical: 1}
channels: [{name: x1, unit: "-", sd: 0.5}, {name: x2, unit: "-", sd: 0.5}]
commands: [{name: goal_1, unit: "-"}, {name: goal_2, unit: "-"}]
faults:
  per: run
  scatter: [[stands_1, stands_2]]
  sizes: {stuck_1: 1, stuck_2: 1}
  known: {fact: said, causes: {sound: []}}
runs:
  - {file: "known{n}.csv", setup: {said: sound}}
  - {file: "{n}.csv", use: test, setup: {said: "-"}}
"""
NUM_GOALS, NUM_ROWS, REST = 5, 8, 3.0
SEED = 3


def write(path: Path, rng: np.random.Generator, change: str = "") -> None:
    """A run of two axes that rest a little off each goal, once for all its rows."""
    goals = rng.uniform(-100.0, 100.0, (NUM_GOALS, 2))
    rests = goals + REST * rng.standard_normal((NUM_GOALS, 2))
    if change == "off":
        rests[:, 0] += 25.0
    elif change == "stuck":
        rests[:, 1] = 40.0
    elif change == "missed":
        rests[2, 0] = rests[1, 0] + 70.0
    rows = np.repeat(rests, NUM_ROWS, axis=0) + 0.5 * rng.standard_normal((40, 2))
    if change == "misread":
        rows[[4, 17, 30], 1] = [-16000.0, 900.0, 32000.0]
    table = np.column_stack([0.1 * np.arange(40), rows, np.repeat(goals, NUM_ROWS, axis=0)])
    body = "\n".join(",".join(f"{v:.4f}" for v in row) for row in table)
    path.write_text(f"time_s,x1,x2,goal_1,goal_2\n{body}\n")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("stage"), np.random.default_rng(SEED)
    for n in range(6):
        write(folder / f"known{n}.csv", rng, "missed" if n == 5 else "")
    for change in ("sound", "off", "stuck", "missed", "misread"):
        for n in range(3):
            write(folder / f"{change}_{n}.csv", rng, change)
    (folder / "study.yaml").write_text(STUDY.replace('"{n}.csv"', '"{n}_{k}.csv"'))
    return load_study(folder)


@pytest.fixture(scope="module")
def verdicts(study):
    return {v.group: v for v in judge_faults(study, setup_of(study)).verdicts}


@pytest.mark.parametrize("change", ["sound", "missed", "misread"])
def test_what_happens_once_accuses_nobody(verdicts, change):
    found = [verdicts[f"{change}_{n}"] for n in range(3)]
    assert [v.status for v in found] == [SILENT] * 3
    if change == "missed":
        assert all(any("x1 of missed" in said for said in v.set_aside) for v in found)
    if change == "misread":
        assert all("samples far off those beside" in v.set_aside[0] for v in found)


@pytest.mark.parametrize(("change", "cause"), [("off", "off_1"), ("stuck", "stuck_2")])
def test_what_holds_at_all_goals_is_named(verdicts, change, cause):
    found = [verdicts[f"{change}_{n}"] for n in range(3)]
    assert [(v.status, v.causes) for v in found] == [(CERTAIN, (cause,))] * 3
    sizes = [v.sizes[0].interval for v in found]
    if change == "stuck":
        assert all((s.low, s.value, s.high) == pytest.approx((1.0, 1.0, 1.0)) for s in sizes)
    else:
        # 5 rests of sd 3 tell it to 1.3; 40 independent rows of sd 0.5 would say 0.08
        assert all(s.low < 25.0 < s.high and 2.0 < s.high - s.low < 9.0 for s in sizes)


def test_offsets_of_goals_are_learned_beside_one_that_was_missed(study):
    setup = setup_of(study)
    given = take_apart(study, setup)
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    tails = learn(problem, given.layout, given.groups, seed=0).tails
    # 30 goals an axis: their sd is known to 13 %
    assert tails.narrow * 0.5 == pytest.approx([REST, REST], rel=0.4)
    assert 0.5 / 60 < tails.missed < 3 / 60


def test_best_fits_do_not_hang_on_what_is_set_aside(study):
    """The same explanation of a run, with and without rows that are garbage."""
    setup = setup_of(study)
    given = take_apart(study, setup)
    run = next(r for r in study.runs if r.name == "off_1")
    garbled = run.measured.copy()
    garbled[5] = -16000.0
    effects = [e for e in setup.effects if e.name == "off_1"]
    found = []
    for measured in (run.measured, garbled):
        runs = (replace(run, measured=measured),)
        problem = Problem(setup.model, runs, WhiteNoise(study.channels), setup.effects)
        rows = rows_at(problem, given.layout, np.zeros(len(problem.names)), effects)
        prior = np.eye(rows.slopes.shape[1])
        fit = rows.robust(Tails.first(problem), prior, np.zeros(len(prior)))
        found.append(fit.at[-1])
    assert found[1] == pytest.approx(found[0], rel=0.02)


def test_most_causes_may_be_stated_alone(study):
    def given(**keys):
        assert study.faults is not None
        changed = replace(study, faults=study.faults.model_copy(update=keys))
        return take_apart(changed, setup_of(changed))

    def sets(**keys):
        return given(**keys).sets

    assert len(sets()) == len(sets(max_causes=1)) == 4
    assert len(sets(max_causes=2)) == 4 + 6
    assert len(sets(together=("off_1", "off_2"))) == 4 + 1
    # as a name is spelled in a file of 1.0.0, or by hand
    assert given(together=("OFF_1", "off_2")).keys.together == ("off_1", "off_2")
    assert given(sizes={"Off_1": 1.0}).keys.sizes == {"off_1": 1.0}
    with pytest.raises(ValueError, match="no cause 'stuck'"):
        sets(sizes={"stuck": 1.0})


def test_what_is_trusted_and_what_it_says_are_those_of_the_densities():
    """Against scipy's densities, and the normal law of rows that share their goal's offset."""
    rng = np.random.default_rng(7)
    num, each = 120, 4
    goal = np.repeat(np.arange(num), each)
    residual = (6.0 * rng.standard_normal(num))[goal] + rng.standard_normal(num * each)
    residual += np.where(rng.random(num * each) < 0.3, 15.0 * rng.standard_normal(num * each), 0.0)
    shared = rng.random(num) < 0.8
    rows = Rows(
        goal, np.zeros(num, int), shared, (), (0,), (), ("c",), residual, rng.normal(size=(480, 2))
    )
    spreads, odds = shared * np.array([[2.0], [6.0], [30.0]]), np.log([0.8, 0.15, 0.05])
    choice = rows._choose(residual, spreads, odds)

    def price(off):
        return stats.norm.logpdf(0.0) - stats.cauchy.logpdf(off, scale=10.0) - np.log(0.01)

    level = 0.0
    for k in range(num):
        own = residual[goal == k]

        def cost(center, own=own):
            usual = stats.norm.logpdf(0.0) - stats.norm.logpdf(center / np.hypot(2.0, 0.5))
            off = stats.norm.logpdf(0.0) - stats.norm.logpdf(own - center)
            return np.minimum(off, price(own - center)).sum() + min(usual, price(center))

        center = min([*own, 0.0], key=cost) if shared[k] else 0.0
        kept = 0.5 * (own - center) ** 2 <= price(own - center)
        np.testing.assert_array_equal(choice.kept[goal == k], kept)
        level -= price(own - center)[~kept].sum()
        if shared[k] and kept.any():
            wide = np.sqrt(spreads[:, k] ** 2 + 1.0 / kept.sum())
            likely = stats.norm.logpdf(own[kept].mean(), scale=wide) + odds
            assert choice.part[k] == np.argmax(likely)
            level += odds[choice.part[k]]
        else:
            assert choice.part[k] == 0
    assert choice.level == pytest.approx(level, rel=1e-9)
    assert 0.05 < 1.0 - choice.kept.mean() < 0.5 and len(set(choice.part)) == 3

    spread = np.choose(choice.part, spreads)
    local, kept = rows._local(choice, spread), choice.kept
    same = goal[kept][:, None] == goal[kept]
    covariance = np.eye(kept.sum()) + same * spread[goal[kept]] ** 2
    whole = np.column_stack([rows.slopes[kept], residual[kept]])
    gram = whole.T @ np.linalg.solve(covariance, whole)
    np.testing.assert_allclose(local.curvature, gram[:2, :2], rtol=1e-9)
    np.testing.assert_allclose(local.slope, gram[:2, 2], rtol=1e-9, atol=1e-9)
    assert local.square == pytest.approx(gram[2, 2], rel=1e-9)
    half = 0.5 * np.linalg.slogdet(covariance)[1]
    assert local.level == pytest.approx(level - half, rel=1e-9)
