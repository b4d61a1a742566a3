"""The evidence of a law beside a fit, and what it gains where it was not fitted."""

import numpy as np
import pytest
from scipy import sparse, special, stats

from diffsim.diagnose.discover.follow import Reach, ReachInRun
from diffsim.diagnose.discover.screen import (
    NUM_BUMPS,
    Candidate,
    Weigher,
    bumps,
    range_of,
    trend,
)
from diffsim.diagnose.search.evidence import AMPLITUDES
from diffsim.identify.law import Entry, Variable

COUNT = 48


@pytest.fixture
def problem():
    """Record, slopes by two shared numbers and two of one part alone, columns of a law."""
    rng = np.random.default_rng(3)
    folds = np.repeat(np.arange(4), COUNT // 4)
    shared = rng.normal(size=(COUNT, 2))
    own = np.stack([np.where(folds == k, rng.normal(size=COUNT), 0.0) for k in (1, 3)], 1)
    slopes = np.hstack([shared, 2.0 * own])
    columns = rng.normal(size=(COUNT, 3))
    columns /= np.sqrt(np.sum(columns**2) / COUNT)
    missing = columns @ [0.8, -1.5, 0.4] + slopes @ [0.5, -1.0, 2.0, 1.0] + rng.normal(size=COUNT)
    return missing, slopes, columns, folds


@pytest.mark.reference
def test_a_gain_is_the_ratio_of_two_normal_densities(problem):
    missing, slopes, columns, folds = problem
    plain = np.eye(COUNT) + slopes @ slopes.T
    zero = np.zeros(COUNT)
    without = stats.multivariate_normal(zero, plain).logpdf(missing)
    scaled = columns / np.sqrt(np.sum(columns**2) / COUNT)
    each = [
        stats.multivariate_normal(zero, plain + a**2 * scaled @ scaled.T).logpdf(missing) - without
        for a in AMPLITUDES
    ]
    weigher = Weigher.of_slopes(missing, slopes, folds)
    ((nats, amplitude),) = weigher.gains(scaled, [columns.shape[1]])
    assert nats == pytest.approx(special.logsumexp(each) - np.log(len(each)), abs=1e-9)
    assert amplitude == pytest.approx(AMPLITUDES[int(np.argmax(each))])


def without_own(rows, slopes, folds, left):
    """Misfit of a part, what only this part tells fitted to it."""
    own = slopes[rows][:, [k for k in range(slopes.shape[1]) if not slopes[~rows, k].any()]]
    return left @ np.linalg.solve(np.eye(len(left)) + own @ own.T, left)


@pytest.mark.reference
def test_what_a_law_gains_is_what_refits_without_each_part_say(problem):
    missing, slopes, columns, folds = problem
    before = after = 0.0
    for k in range(4):
        rows = folds == k
        for block in (slopes, np.hstack([slopes, columns])):
            rest = block[~rows]
            told = np.linalg.solve(rest.T @ rest + np.eye(block.shape[1]), rest.T @ missing[~rows])
            misfit = without_own(rows, slopes, folds, missing[rows] - block[rows] @ told)
            if block is slopes:
                before += misfit
            else:
                after += misfit
    gained, share = Weigher.of_slopes(missing, slopes, folds).left_out(columns)
    assert gained == pytest.approx(0.5 * (before - after), rel=1e-9)
    assert share == pytest.approx((before - after) / max(before - COUNT, before - after), rel=1e-9)


def test_of_a_force_and_a_fixed_number_that_do_the_same_the_force_comes_first():
    height, basis = Variable("height", "h", "m"), bumps(0.0, 1.0)
    of = {
        kind: Candidate(Entry(kind, "rotor", "-", 1.0), height, basis, score, 90.0, 1.0, 1.0)
        for kind, score in (("number", 80.001), ("force", 80.0), ("reading", 81.0))
    }
    ranked = sorted(of.values(), key=lambda c: c.rank)
    assert [c.entry.kind for c in ranked] == ["reading", "force", "number"]


def test_columns_of_chance_gain_nothing_where_they_were_not_fitted(problem):
    missing, slopes, columns, folds = problem
    rng = np.random.default_rng(0)
    asked = Weigher.of_slopes(missing, slopes, folds)
    chance = [asked.left_out(rng.normal(size=columns.shape))[0] for _ in range(200)]
    assert np.mean(chance) < 0.0 < asked.left_out(columns)[0]


def cost_of(problem, factors):
    """Misfit with factors of the law, the model's numbers at their best beside their prior."""
    missing, slopes, columns, _ = problem
    left = missing - columns @ factors
    return left @ np.linalg.solve(np.eye(COUNT) + slopes @ slopes.T, left)


@pytest.mark.reference
def test_what_a_record_tells_is_the_misfit_of_all_factors(problem):
    missing, slopes, columns, folds = problem
    root, target = Weigher.of_slopes(missing, slopes, folds).misfit_of(columns)
    tried = np.random.default_rng(1).normal(size=(5, columns.shape[1]))
    told = [np.sum((target - root @ f) ** 2) for f in tried]
    expected = [cost_of(problem, f) for f in tried]
    np.testing.assert_allclose(np.subtract(told, told[0]), np.subtract(expected, expected[0]))


@pytest.mark.reference
def test_beside_a_law_evidence_is_that_of_both(problem):
    missing, slopes, columns, folds = problem
    first, second = columns[:, :1], columns[:, 1:] / np.sqrt(np.sum(columns[:, 1:] ** 2) / COUNT)
    plain = np.eye(COUNT) + slopes @ slopes.T + first @ first.T
    zero = np.zeros(COUNT)
    without = stats.multivariate_normal(zero, plain).logpdf(missing)
    each = [
        stats.multivariate_normal(zero, plain + a**2 * second @ second.T).logpdf(missing) - without
        for a in AMPLITUDES
    ]
    weigher = Weigher.of_slopes(missing, slopes, folds).with_columns(first)
    ((nats, _),) = weigher.gains(second, [second.shape[1]])
    assert nats == pytest.approx(special.logsumexp(each) - np.log(len(each)), abs=1e-9)


@pytest.mark.reference
def test_a_waves_score_is_what_refits_take_away(problem):
    """Of a sine and a cosine, the model's numbers fitted anew beside their prior."""
    missing, slopes, _, folds = problem
    rng = np.random.default_rng(2)
    # a run's terms at twenty samples drive five knots, those of the other are read at once
    course, spread = rng.normal(size=(COUNT // 2, 5)), rng.normal(size=(5, 20))
    knots, at_once = sparse.csr_array(spread), sparse.csr_array(rng.normal(size=(COUNT // 2, 20)))
    here = sparse.eye_array(COUNT // 2, format="csr")
    basis, mixed = np.linalg.qr(course)
    entry = Reach((ReachInRun(mixed, knots, basis), ReachInRun(here, at_once, here)))
    terms = [rng.normal(size=(20, 6)) for _ in range(2)]
    pairs = np.concatenate([course @ spread @ terms[0], at_once @ terms[1]])
    np.testing.assert_allclose(entry.columns(terms), pairs, rtol=1e-9, atol=1e-9)
    seen = Weigher.of_slopes(missing, slopes, folds).seen_by(entry)
    found = seen.scores(entry.coordinates(terms))
    metric = np.linalg.inv(np.eye(COUNT) + slopes @ slopes.T)
    for k in range(3):
        pair = pairs[:, [k, k + 3]]
        asked = pair.T @ metric @ missing
        taken = asked @ np.linalg.solve(pair.T @ metric @ pair, asked)
        assert found[k] == pytest.approx(taken, rel=1e-9)


@pytest.mark.parametrize("make", [bumps, trend])
def test_a_basis_is_what_its_formulas_say(make):
    low, high = -2.0, 5.0
    basis = make(low, high)
    u = np.linspace(low, high, 37)
    said = [eval(term, {"exp": np.exp, "u": u}) for term in basis.terms]
    np.testing.assert_allclose(basis.values(u), np.stack(said, 1), rtol=1e-12, atol=1e-15)


def test_bumps_overlap_so_that_they_can_be_level():
    values = bumps(-1.0, 1.0).values(np.linspace(-0.6, 0.6, 101)).sum(1)
    assert values.shape == (101,) and np.ptp(values) < 0.05 * values.mean()
    assert len(bumps(-1.0, 1.0).terms) == NUM_BUMPS


def test_a_memory_that_diverged_is_no_variable_of_a_law():
    """That of a slide pushed four times as hard reached 6e42: its eighth power ended the answer."""
    rest, course = np.full(40, 2.0), np.linspace(-1e-9, 3.0, 40)
    assert range_of(course) == (-1e-9, 3.0)
    assert range_of(rest) is None and range_of(np.full(40, np.nan)) is None
    memory = np.cumprod(np.full(40, 12.0))
    assert memory[-1] > 1e42 and range_of(memory) is None
    low, high = range_of(memory[:35])
    assert np.isfinite((high - low) ** 8)
