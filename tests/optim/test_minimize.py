"""The driver of L-BFGS: scipy's bits, an exact budget, a wall, a callback."""

import numpy as np
import pytest
from scipy import optimize

from diffsim.core.errors import DiffsimError
from diffsim.optim import (
    Budget,
    Options,
    Progress,
    Sample,
    Tolerances,
    Wall,
    minimize,
    progress_bar,
)

START = np.array([-1.2, 1.0, 0.7, -0.4])
BOUNDS = (np.full(4, -2.0), np.array([2.0, 0.5, 2.0, np.inf]))  # the second binds


def rosenbrock(x):
    return optimize.rosen(x), optimize.rosen_der(x)


def scipys(start, bounds, **options):
    """Scipy's own result, and every point that it asked for."""
    points = []

    def kept(x):
        points.append(x.copy())
        return rosenbrock(x)

    pairs = None if bounds is None else list(zip(*bounds, strict=True))
    found = optimize.minimize(
        kept, start, jac=True, method="L-BFGS-B", bounds=pairs, options=options
    )
    return found, np.array(points)


@pytest.mark.reference
@pytest.mark.parametrize("bounds", [None, BOUNDS])
@pytest.mark.parametrize("ftol", [1e-4, 1e-12])
def test_every_bit_is_scipys(bounds, ftol):
    theirs, points = scipys(START, bounds, ftol=ftol, gtol=1e-9, maxls=7, maxcor=5)
    tolerances = Tolerances(ftol=ftol, gtol=1e-9, line_search=7, memory=5)
    ours = minimize(rosenbrock, START, bounds, Options(Budget(None), tolerances))
    assert ours.ended == "converged" and ours.converged
    assert ours.message == theirs.message
    np.testing.assert_array_equal(np.array([e.x for e in ours.history]), points)
    np.testing.assert_array_equal(ours.final.x, theirs.x)
    assert ours.final.value == theirs.fun
    np.testing.assert_array_equal(ours.final.gradient, theirs.jac)
    assert ours.num_evaluations == theirs.nfev
    assert ours.value == min(e.value for e in ours.history) <= theirs.fun
    np.testing.assert_array_equal(ours.gradient, optimize.rosen_der(ours.x))


def test_defaults_are_scipys():
    theirs, points = scipys(START, None)
    ours = minimize(rosenbrock, START)
    np.testing.assert_array_equal(np.array([e.x for e in ours.history]), points)
    np.testing.assert_array_equal(ours.final.x, theirs.x)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_budget_is_exact(count):
    whole = minimize(rosenbrock, START, BOUNDS)
    part = minimize(rosenbrock, START, BOUNDS, Options(Budget(count)))
    assert part.ended == "budget" and part.num_evaluations == count
    assert part.message == f"limit of {count} evaluations"
    for a, b in zip(part.history, whole.history, strict=False):
        np.testing.assert_array_equal(a.x, b.x)
    assert part.value == min(e.value for e in whole.history[:count])
    assert part.final.value <= part.history[0].value


@pytest.mark.reference
@pytest.mark.parametrize("count", [1, 3, 10])
def test_a_line_search_may_be_finished_as_scipy_does(count):
    theirs, _ = scipys(START, BOUNDS, maxfun=count)
    ours = minimize(rosenbrock, START, BOUNDS, Options(Budget(count, finish_line_search=True)))
    assert ours.ended == "budget" and ours.num_evaluations == theirs.nfev > count
    np.testing.assert_array_equal(ours.final.x, theirs.x)
    assert ours.message == theirs.message


def test_iterations_are_limited_as_scipys():
    theirs, _ = scipys(START, BOUNDS, maxiter=4)
    ours = minimize(rosenbrock, START, BOUNDS, Options(Budget(None, iterations=4)))
    assert ours.ended == "budget" and ours.num_evaluations == theirs.nfev
    np.testing.assert_array_equal(ours.final.x, theirs.x)


class Cliff:
    """Rosenbrock's function that cannot be evaluated from some x_0 on."""

    def __init__(self, error, edge=0.5):
        self.error, self.edge = error, edge

    def __call__(self, x):
        if x[0] > self.edge:
            if isinstance(self.error, Exception):
                raise self.error
            return self.error, np.zeros_like(x)
        return rosenbrock(x)


@pytest.mark.parametrize("error", [DiffsimError("no\nsolution"), np.nan, np.inf, -np.inf])
def test_failures_are_walls_from_which_the_line_search_backs_off(error):
    start = np.array([-1.2, 1.0])
    found = minimize(Cliff(error, -0.5), start, None, Options(Budget(200)))
    assert found.num_failed > 0
    assert found.x[0] <= -0.5 and found.x[0] == pytest.approx(-0.5, abs=1e-2)
    assert all((e.value == np.inf) == bool(e.failure) for e in found.history)
    expected = "no solution" if isinstance(error, Exception) else f"value is not finite: {error}"
    assert {e.failure for e in found.history} == {"", expected}


def test_gradient_that_is_not_finite_is_a_failure():
    def holed(x):
        value, slope = rosenbrock(x)
        return value, slope if x[0] < -0.5 else slope * np.nan

    found = minimize(holed, np.array([-1.2, 1.0]))
    assert "gradient is not finite" in {e.failure for e in found.history}
    assert np.isfinite(found.gradient).all()


def test_start_must_be_possible_and_other_exceptions_end_the_search():
    with pytest.raises(DiffsimError, match="no solution"):
        minimize(Cliff(DiffsimError("no solution")), np.array([0.6, 0.0]))
    start = np.array([-1.2, 1.0])
    with pytest.raises(KeyError):
        minimize(Cliff(KeyError("bug"), -0.5), start)
    with pytest.raises(DiffsimError, match="no solution"):
        minimize(Cliff(DiffsimError("no solution"), -0.5), start, None, Options(wall=None))
    with pytest.raises(ArithmeticError, match="not finite"):
        minimize(Cliff(np.nan, -0.5), start, None, Options(wall=None))
    wall = Wall(failures=(KeyError,))
    assert minimize(Cliff(KeyError("k"), -0.5), start, None, Options(wall=wall)).num_failed > 0


@pytest.mark.reference
def test_after_an_infinite_value_scipy_alone_stops_where_it_began():
    """Why a wall is finite; should this fail with a newer scipy, the wall may be reconsidered."""

    def cliff(x):
        if x[0] > 0.5:
            return np.inf, np.zeros(2)
        return 100.0 * (x[0] - 0.45) ** 2 + x[1] ** 2, np.array([200.0 * (x[0] - 0.45), 2.0 * x[1]])

    start = np.array([0.0, -0.3])
    theirs = optimize.minimize(cliff, start, jac=True, method="L-BFGS-B")
    assert theirs.success and np.array_equal(theirs.x, start)
    np.testing.assert_allclose(minimize(cliff, start).x, [0.45, 0.0], atol=1e-6)


def test_height_of_the_wall():
    assert Wall().value(0.2, 0.1) == 1e3
    assert Wall().value(-5.0, -7.0) == 5e3
    assert Wall(height=1.0, over_first=0.0, over_best=10.0).value(50.0, 2.0) == 20.0


def test_search_is_the_same_in_any_unit():
    plain = minimize(rosenbrock, START, BOUNDS, Options(unit=None))
    first = plain.history[0].value
    explicit = minimize(rosenbrock, START, BOUNDS, Options(unit=first))
    np.testing.assert_array_equal(plain.x, explicit.x)
    scaled = minimize(
        lambda x: tuple(1024.0 * part for part in rosenbrock(x)),  # a power of two: no rounding
        START,
        BOUNDS,
        Options(unit=1024.0 * first),
    )
    np.testing.assert_array_equal(plain.x, scaled.x)
    assert scaled.value == 1024.0 * plain.value


def test_callback_sees_every_evaluation_and_may_end_the_search():
    seen: list[Progress] = []
    found = minimize(rosenbrock, START, BOUNDS, callback=seen.append)
    assert [p.count for p in seen] == list(range(1, found.num_evaluations + 1))
    assert [p.evaluation for p in seen] == list(found.history)
    assert seen[-1].best == found.value and not any(p.replayed for p in seen)
    stopped = minimize(rosenbrock, START, BOUNDS, callback=lambda p: p.count == 4)
    assert stopped.ended == "callback" and stopped.num_evaluations == 4


def test_a_line_search_without_descent_is_said_to_have_failed():
    start = np.array([1.0, 2.0])
    found = minimize(lambda x: (5.0 + float((x != start).any()), np.ones(2)), start)
    assert found.ended == "failed" and "ABNORMAL" in found.message
    assert found.value == 5.0


def test_notes_are_kept_and_objectives_may_write_into_their_point():
    def careless(x):
        value, slope = rosenbrock(x)
        x[:] = np.nan
        return Sample(value, slope, {"half": value / 2})

    found = minimize(careless, START, BOUNDS)
    np.testing.assert_array_equal(found.x, minimize(rosenbrock, START, BOUNDS).x)
    assert all(e.notes["half"] == e.value / 2 for e in found.history)


def test_start_beyond_the_bounds_is_moved_to_them():
    found = minimize(rosenbrock, np.full(4, 9.0), BOUNDS, Options(Budget(1)))
    np.testing.assert_array_equal(found.x, [2.0, 0.5, 2.0, 9.0])


def test_bar_shows_what_is_best(capsys):
    with progress_bar("down", 5, unit=2.0) as bar:
        minimize(rosenbrock, START, BOUNDS, Options(Budget(5)), callback=bar)
    shown = capsys.readouterr().err
    assert "down: 5 of 5" in shown and "best=" in shown
    with progress_bar("down", 5, show=False) as bar:
        minimize(rosenbrock, START, BOUNDS, Options(Budget(5)), callback=bar)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: minimize(rosenbrock, np.zeros(0)), "start must be a vector"),
        (lambda: minimize(rosenbrock, np.array([np.nan])), "start must be a vector"),
        (lambda: minimize(rosenbrock, START, (np.zeros(3), np.ones(3))), "start's shape"),
        (lambda: minimize(rosenbrock, START, (np.ones(4), np.zeros(4))), "must not lie above"),
        (lambda: minimize(lambda x: (0.0, np.zeros(3)), START), "gradient must have shape"),
        (lambda: minimize(lambda x: Sample(0.0), START), "must return its gradient"),
    ],
)
def test_mistakes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    "wrong", ["ab", None, [[0.0, 1.0]], [0.0, float("nan")], [], [1j], [[0], 1]]
)
def test_starts_and_bounds_that_are_no_numbers_are_refused(wrong):
    with pytest.raises((TypeError, ValueError), match="start must"):
        minimize(lambda x: (float(x @ x), 2.0 * x), wrong)
    with pytest.raises((TypeError, ValueError), match="bounds"):
        minimize(lambda x: (float(x @ x), 2.0 * x), np.ones(2), (wrong, np.ones(2)))


def test_a_start_of_whole_numbers_is_taken():
    found = minimize(lambda x: (float(x @ x), 2.0 * x), [3, 4])
    assert found.ended == "converged" and found.final.value < 1e-9
