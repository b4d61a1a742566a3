"""Many coordinates act in one run each: nothing depends on whether their zeros are used."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from diffsim.diagnose.search import gauss_newton
from diffsim.diagnose.search.evidence import Hypothesis, LaplaceEvidence
from diffsim.identify import Parameter, Problem, SimModel, WhiteNoise
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import MIN_SPARSE, gram_of
from tests.diagnose import linear

NUM_RUNS = MIN_SPARSE // 2 + 1
EFFECTS = (linear.line("push"), linear.line("wind", components=("x", "y"), signed=False))


def begun(bend: float = 0.0) -> Problem:
    """Runs with two starts of their own each, in which the record bends by ``bend``."""

    def build(values, run, numerics):
        record = linear.model().build(values, run, numerics).record
        for name in ("q", "w"):
            start = values[f"{name}@{run.name}"]
            shape = linear.shapes(name, run)[..., 0]
            record = record + (start + bend * start**2) * shape
        return linear.LinearScene(record)

    runs = tuple(linear.run(f"r{k}", k) for k in range(NUM_RUNS))
    runs = tuple(
        replace(r, measured=r.measured + 0.6 * linear.shapes("push", r).numpy()[..., 0])
        for r in runs
    )
    starts = [Parameter(f"{n}@{r.name}", 0.2, 0.8, "m") for r in runs for n in ("q", "w")]
    model = SimModel(build, [*linear.model().base, *starts], f"begun {bend}")
    return Problem(model, runs, WhiteNoise(linear.CHANNELS), EFFECTS)


@pytest.mark.parametrize("members", [(), (0,), (1,), (0, 1)])
def test_evidence_is_that_of_all_coordinates_at_once(members):
    problem = begun()
    x = np.zeros(len(problem.names))
    evidence = LaplaceEvidence(problem, x, *problem.linearize(x), [], 2)
    assert evidence.local is not None
    assert len(evidence.local.own) == 2 * NUM_RUNS
    found = evidence.weigh(Hypothesis(frozenset(members)))
    evidence.local = None
    known = evidence.weigh(Hypothesis(frozenset(members)))
    for name in ("nats", "x", "sd", "chi2"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), rtol=1e-8, atol=1e-9)


def test_what_is_made_by_parts_is_what_is_made_at_once():
    problem = begun()
    _, slopes = problem.linearize(np.zeros(len(problem.names)))
    precision = slopes.T @ slopes
    np.testing.assert_allclose(gram_of(slopes), precision, atol=1e-12)
    inverse = np.linalg.inv(precision + np.eye(len(precision)))
    np.testing.assert_allclose(posterior_covariance(slopes), inverse, atol=1e-13)


def test_an_update_explains_its_step_and_keeps_starts_out_of_other_runs():
    problem = begun(bend=0.3)
    begin = np.zeros(len(problem.names))
    before = gauss_newton._first(problem, linearization_at(problem, begin))
    step = np.random.default_rng(0).normal(0.0, 0.3, len(begin))
    after = before._advance(step)
    off = after.at.record - before.at.record - before.at.columns @ step
    assert np.abs(off).max() > 0.1  # the record bends
    change = after.at.columns @ step
    np.testing.assert_allclose(change, after.at.record - before.at.record, atol=1e-12)
    np.testing.assert_allclose(after.jacobian, problem.whiten_all(after.at.columns))
    edges = np.cumsum([0, *(r.measured.size for r in problem.runs)])
    for run, first, last in zip(problem.runs, edges[:-1], edges[1:], strict=True):
        own = f"@{run.name}"
        others = [i for i, n in enumerate(problem.names) if "@" in n and not n.endswith(own)]
        assert not after.at.columns[first:last, others].any()


def test_steps_end_at_the_minimum():
    problem = begun(bend=0.3)
    x = np.zeros(len(problem.names))
    found, _ = gauss_newton.gauss_newton(problem, linearization_at(problem, x))
    best = optimize.least_squares(
        lambda v: np.concatenate([problem.residual(v), v]),
        x,
        jac=lambda v: np.vstack([-problem.linearize(v)[1], np.eye(len(v))]),
        bounds=problem.bounds,
        method="dogbox",
        xtol=1e-12,
    )
    assert found.chi2 + found.prior == pytest.approx(2.0 * best.cost, abs=0.05)
    assert found.num_evaluations < 12
