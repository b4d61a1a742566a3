"""Many starts: seeds, failures, and the lower of two valleys."""

import numpy as np
import pytest

from diffsim.core import open_executor
from diffsim.core.errors import DiffsimError
from diffsim.optim import Budget, Log, Options, minimize, multi_start, screen, uniform_points

BOUNDS = (np.array([-2.0, -1.0]), np.array([2.0, 1.0]))


def valleys(x):
    """(x^2 - 1)^2 + 0.3 x + y^2: the lower one of two valleys lies near x = -1."""
    value = (x[0] ** 2 - 1.0) ** 2 + 0.3 * x[0] + x[1] ** 2
    return value, np.array([4.0 * x[0] * (x[0] ** 2 - 1.0) + 0.3, 2.0 * x[1]])


def test_points_are_those_of_the_seed_and_begin_alike():
    points = uniform_points(BOUNDS, 50, seed=4)
    assert points.shape == (50, 2)
    assert (points >= BOUNDS[0]).all() and (points <= BOUNDS[1]).all()
    np.testing.assert_array_equal(points[:7], uniform_points(BOUNDS, 7, seed=4))
    assert not np.array_equal(points, uniform_points(BOUNDS, 50, seed=5))
    with pytest.raises(ValueError, match="finite bounds"):
        uniform_points((np.zeros(1), np.array([np.inf])), 2)


def test_descents_begin_at_the_best_starts_and_find_the_lower_valley():
    assert minimize(valleys, np.array([0.9, 0.5]), BOUNDS).x[0] > 0.9  # one start: the higher one
    found = multi_start(valleys, BOUNDS, count=12, keep=3, seed=1)
    values = sorted(e.value for e in found.starts)
    assert [d.history[0].value for d in found.descents] == values[:3]
    assert found.result.value == min(d.value for d in found.descents)
    assert found.result.x == pytest.approx([-1.0355, 0.0], abs=1e-3)
    again = multi_start(valleys, BOUNDS, count=12, keep=3, seed=1)
    np.testing.assert_array_equal(found.result.x, again.result.x)
    points = uniform_points(BOUNDS, 12, seed=1)
    np.testing.assert_array_equal([e.x for e in found.starts], points)


def test_value_alone_is_enough_for_the_starts():
    gradients = []

    def counted(x):
        gradients.append(x)
        return valleys(x)

    found = multi_start(counted, BOUNDS, Options(Budget(5)), count=9, value=lambda x: valleys(x)[0])
    assert len(gradients) == found.result.num_evaluations == 5
    assert all(e.gradient is None for e in found.starts)


def test_failed_starts_are_left_out():
    def half(x):
        if x[0] > 0.0:
            raise DiffsimError("no solution there")
        return valleys(x)

    found = multi_start(half, BOUNDS, count=10, keep=10)
    failed = [e for e in found.starts if e.failure]
    assert 0 < len(failed) < 10 and len(found.descents) == 10 - len(failed)
    with pytest.raises(DiffsimError, match=r"none of 3 random starts.*no solution there"):
        multi_start(half, (np.array([1.0, 0.0]), np.array([2.0, 1.0])), count=3)


def test_screening_may_be_ended():
    made = screen(valleys, uniform_points(BOUNDS, 9), callback=lambda p: p.count == 4)
    assert len(made) == 4


def test_an_executor_changes_nothing(tmp_path):
    alone_log, log = Log(tmp_path / "alone.jsonl"), Log(tmp_path / "log.jsonl")
    options = Options(Budget(20))
    alone = multi_start(valleys, BOUNDS, options, count=6, keep=3, seed=1, log=alone_log)
    with open_executor("processes:2") as workers:
        found = multi_start(
            valleys, BOUNDS, options, count=6, keep=3, seed=1, log=log, executor=workers
        )
        with pytest.raises(ValueError, match="leave out callback or executor"):
            multi_start(valleys, BOUNDS, count=2, callback=print, executor=workers)
    for one, other in zip(alone.descents, found.descents, strict=True):
        np.testing.assert_array_equal([e.x for e in one.history], [e.x for e in other.history])
    assert [e.value for e in alone.starts] == [e.value for e in found.starts]
    for name in ("descent 1", "descent 2", "descent 3"):  # the file holds all, to be gone on from
        again = [entry["x"] for entry in Log(log.path)[name]]
        assert again == [entry["x"] for entry in alone_log[name]] and again
