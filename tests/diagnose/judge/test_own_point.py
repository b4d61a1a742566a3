"""Values that belong to one run, fitted to it alone while all others stay."""

from dataclasses import dataclass

import numpy as np
import pytest

from diffsim.data.study import Run
from diffsim.diagnose.judge import own_values
from diffsim.diagnose.judge.own_values import held_out_point, own_point
from diffsim.identify import Problem
from tests.diagnose import linear

RUN = Run("new", np.arange(30.0), np.zeros((30, 1)), {}, "new")
TRUE = np.array([0.0, 0.3, 2.2])


@dataclass
class Sliding:
    """A run whose slide ends at a time that hangs on its own start and spin."""

    names: tuple[str, ...] = ("friction", "speed@new", "spin@new")
    num_base: int = 3
    bounds: tuple[np.ndarray, np.ndarray] = (np.full(3, -np.inf), np.full(3, np.inf))
    asked: int = 0

    def motion(self, x: np.ndarray) -> np.ndarray:
        time = np.linspace(0.0, 1.0, 30)
        speed, spin = 1.0 + 0.5 * x[1], 0.5 * x[2]
        end = np.clip(0.6 * abs(speed - spin), 0.05, None)
        slid = np.minimum(time, end)
        sign = np.sign(speed - spin)
        return 1000.0 * (speed * time - sign * (slid * time - 0.5 * slid**2))

    def residual(self, x: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(0).standard_normal(30)
        return self.motion(x) - self.motion(TRUE) - noise

    def linearize(self, x: np.ndarray, only: list[int]) -> tuple[np.ndarray, np.ndarray]:
        self.asked += 1
        steps = [1e-5 * np.eye(3)[k] for k in only]
        slopes = [(self.residual(x + s) - self.residual(x - s)) / 2e-5 for s in steps]
        return self.residual(x), -np.stack(slopes, 1)


def test_what_is_no_straight_function_is_fitted_to_the_end():
    """A ball that slides, then rolls: slopes of its first guess led nowhere."""
    problem = Sliding()
    point, left = own_point(problem, np.zeros(3), RUN)
    assert np.array_equal(left, problem.residual(point))
    assert problem.asked < 8  # slopes, where they were wrong
    assert left @ left < 1.5 * len(left)
    assert point[1:] == pytest.approx(TRUE[1:], abs=0.1)
    assert point[0] == 0.0


@dataclass
class Unexplained(Sliding):
    """A straight line in the values, and what no value explains."""

    runs: int = 0

    def motion(self, x: np.ndarray) -> np.ndarray:
        time = np.linspace(0.0, 1.0, 30)
        return 60.0 * x[1] + 20.0 * x[2] * time

    def residual(self, x: np.ndarray) -> np.ndarray:
        self.runs += 1
        return super().residual(x) + WAVES


WAVES = 20.0 * np.cos(6.0 * np.linspace(0.0, 1.0, 30))


@pytest.mark.parametrize("wrong", [0.0, 0.02, -0.02])
def test_slopes_of_the_fit_serve_although_a_little_wrong(wrong):
    """They may lead to ever shorter steps, none of which lowers the misfit."""
    slopes = Unexplained().linearize(np.zeros(3), [0, 1, 2])[1]
    ends = []
    for given in (slopes + wrong * WAVES[:, None], None):
        problem = Unexplained()
        point, _ = own_point(problem, np.zeros(3), RUN, given)
        ends.append(float(np.sum(problem.residual(point) ** 2) + point @ point))
        assert problem.runs < 12 or given is None
        assert given is None or not problem.asked
    assert ends[0] <= 1.02 * ends[1]


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit's problem and coordinates."""

    problem: Problem
    x: np.ndarray


def test_a_run_that_was_not_fitted_is_fitted_once(monkeypatch):
    """By gain, errors, page and recording alike; another run, or another point, is another fit."""
    asked = []

    def one(problem, x, run, unmet=()):
        asked.append(run.name)
        return x + len(asked), None

    monkeypatch.setattr(own_values, "own_point", one)
    problem = linear.problem()
    fit, other = Fitted(problem, np.zeros(2)), Fitted(problem, np.ones(2))
    runs = [linear.run(name, 3) for name in ("new", "newer")]
    points = [held_out_point(f, r)[0] for f in (fit, other) for r in (*runs, *runs)]
    assert asked == ["new", "newer"] * 2
    assert [float(p[0]) for p in points] == [1.0, 2.0, 1.0, 2.0, 4.0, 5.0, 4.0, 5.0]
    points[0][:] = 99.0  # what one reader does with it is not the next one's
    assert float(held_out_point(fit, runs[0])[0][0]) == 1.0
    held_out_point(fit, linear.run("new", 3))  # the same name, another record
    assert len(asked) == 5
