"""Random starts and the adjoint's descent, on a decaying exponential."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel, Run
from diffsim.identify import Parameter, Problem, WhiteNoise, fit
from diffsim.identify.model import SimModel
from labs.balls.multi_start import descend, random_starts

TIME = np.linspace(0.0, 2.0, 30)
BASE = [Parameter("height", 1.0, 1.0, "m"), Parameter("rate", 1.0, 0.5, "1/s", log=True)]


@dataclass(frozen=True)
class Decay:
    """height exp(-rate t); fails where the height is below ``lowest``."""

    height: Tensor
    rate: Tensor
    lowest: float = -np.inf

    def simulate(self) -> Tensor:
        if float(self.height.detach()) < self.lowest:
            raise DiffsimError("too low")
        return (self.height * torch.exp(-self.rate * torch.from_numpy(TIME)))[:, None]


def problem_of(lowest: float = -np.inf) -> Problem:
    measured = (2.5 * np.exp(-0.6 * TIME))[:, None]
    run = Run("only", TIME, measured, {}, "only")
    model = SimModel(lambda v, run, numerics: Decay(v["height"], v["rate"], lowest), BASE)
    return Problem(model, (run,), WhiteNoise([Channel("y", "m", "position", 0.01)]))


def test_starts_are_sorted_and_the_prior_is_among_them():
    starts = random_starts(problem_of(), 12, seed=3)
    assert bool((np.diff(starts.cost) >= 0).all())
    assert (starts.x == 0.0).all(1).sum() == 1
    again = random_starts(problem_of(), 12, seed=3)
    np.testing.assert_array_equal(starts.x, again.x)


def test_fixed_coordinates_stay_and_failures_count_as_infinite():
    starts = random_starts(problem_of(lowest=1.0), 20, fixed=("rate",))
    assert (starts.x[:, 1] == 0.0).all()
    assert 1 <= np.isfinite(starts.cost).sum() < 20
    with pytest.raises(DiffsimError, match="none of 5"):
        random_starts(problem_of(lowest=99.0), 5)


def test_descent_ends_where_gauss_newton_does():
    problem = problem_of()
    seen: list[float] = []
    down = descend(problem, np.array([0.3, 0.4]), max_evaluations=60, report=seen.append)
    found = fit(problem.model, problem.runs, [Channel("y", "m", "position", 0.01)])
    np.testing.assert_allclose(down.x, found.x, atol=1e-3)
    assert tuple(seen) == down.cost and len(down.cost) <= 60
    assert min(down.cost) < 1e-3 * down.cost[0]


def test_descent_keeps_to_its_budget_and_its_best():
    problem = problem_of()
    down = descend(problem, np.array([0.3, 0.4]), max_evaluations=3)
    assert len(down.cost) == 3
    r = problem.residual(down.x)
    assert 0.5 * float(r @ r + down.x @ down.x) == pytest.approx(min(down.cost))


def test_fit_by_lbfgs_turns_back_and_says_so():
    channels = [Channel("y", "m", "position", 0.01)]
    whole = problem_of()
    options = {"method": "lbfgs", "gradient": "autograd", "start": np.array([5.0, 1.0])}
    truth = fit(whole.model, whole.runs, channels, max_evaluations=100, **options)
    fragile = problem_of(lowest=2.45)  # on the way, not at the end
    found = fit(fragile.model, fragile.runs, channels, max_evaluations=100, **options)
    assert "trial points could not be simulated" in found.message
    np.testing.assert_allclose(found.x, truth.x, atol=1e-4)


def test_descent_turns_back_where_the_simulation_fails():
    problem = problem_of(lowest=0.9)
    start = np.array([0.0, 1.5])
    down = descend(problem, start, max_evaluations=30, first_step=1e3)
    assert np.isinf(down.cost).any()  # the first step is far too long
    assert min(down.cost) < down.cost[0]
    assert np.isfinite(problem.residual(down.x)).all()
