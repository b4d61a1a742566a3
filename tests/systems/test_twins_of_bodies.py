"""Diagnosed copters and soft bodies under new commands: gradients, draws, what mending buys."""

import numpy as np
import pytest
import torch

from diffsim.sim_to_real import best_command, worth
from diffsim.systems import Twin
from tests.systems import slack_starfish, weak_copter
from tests.systems.test_multicopter_description import SPEEDS

CASES = {"copter": (weak_copter, "weak_rotor_2"), "starfish": (slack_starfish, "slack")}


@pytest.fixture(scope="module")
def copter(tmp_path_factory):
    folder = tmp_path_factory.mktemp("copter")
    study, given = weak_copter.fitted_copter(folder), weak_copter.TASK
    return Twin.read(folder, study, given.time_s, start=given.start), given.for_study(study)


@pytest.fixture(scope="module")
def starfish(tmp_path_factory):
    folder = tmp_path_factory.mktemp("starfish")
    study, given = slack_starfish.fitted_starfish(folder), slack_starfish.TASK
    return Twin.read(folder, study, given.time_s), given.for_study(study)


@pytest.fixture(params=["copter", "starfish"])
def made(request):
    """A twin and its task."""
    return request.getfixturevalue(request.param)


@pytest.mark.grad
@pytest.mark.cpu(16)  # the fixtures fit
def test_gradient_of_commands(made):
    twin, task = made
    rng = np.random.default_rng(2)
    knots = torch.from_numpy(rng.uniform(0.4, 0.6, task.num_knots)).requires_grad_()
    way, h = torch.from_numpy(rng.standard_normal(task.num_knots)), 1e-6

    def cost(u: torch.Tensor) -> torch.Tensor:
        return task.misses(twin.simulate(task.commands(u))).square().sum()

    (slope,) = torch.autograd.grad(cost(knots), knots)
    with torch.no_grad():
        difference = (cost(knots + h * way) - cost(knots - h * way)) / (2.0 * h)
    assert float(slope @ way) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.grad
def test_gradient_of_what_the_data_allow(made):
    twin, task = made
    commands = task.commands(torch.full((task.num_knots,), 0.5, dtype=torch.float64))
    q = twin.draw(1, np.random.default_rng(4))[0].requires_grad_()
    h, way = 1e-5, torch.randn(len(q), generator=torch.Generator().manual_seed(0)).double()

    def cost(at: torch.Tensor) -> torch.Tensor:
        return task.misses(twin.simulate(commands, at)).square().sum()

    (slope,) = torch.autograd.grad(cost(q), q)
    with torch.no_grad():
        difference = (cost(q + h * way) - cost(q - h * way)) / (2.0 * h)
    assert float(slope @ way) == pytest.approx(float(difference), rel=1e-4)


def test_draws_differ_and_come_again_by_their_seed(made):
    twin, task = made
    commands = task.commands(torch.full((task.num_knots,), 0.55, dtype=torch.float64))
    drawn = twin.draw(3, np.random.default_rng(1))
    assert torch.equal(drawn, twin.draw(3, np.random.default_rng(1)))
    with torch.no_grad():
        seen = twin.simulate(commands, drawn)
        assert torch.equal(seen, twin.simulate(commands, drawn))
        alone = twin.simulate(commands, drawn[2])
    torch.testing.assert_close(seen[2], alone, rtol=0.0, atol=1e-12)
    assert seen.shape[0] == 3 and (seen[0] - seen[1]).abs().max() > 1e-6


@pytest.mark.cpu(12)
def test_the_copter_flies_the_path_by_the_diagnosed_models_command(copter):
    twin, task = copter
    misses = []
    for model in (twin, twin.plain()):
        best = best_command(model, task, starts=[], evaluations=30)
        commands = task.commands(torch.from_numpy(best.knots))
        speeds = torch.stack([commands[n] for n in SPEEDS], -1).numpy()
        seen = twin.simulate(commands)
        seen[:, :3] = torch.from_numpy(weak_copter.fly_open_loop(speeds, task.given.every))
        misses.append(float(task.score(seen)))
    assert misses[0] < 0.2 * misses[1]


def test_a_planned_flight_starts_where_it_is_told_and_rests_there(copter):
    twin, task = copter
    hover = {n: torch.full((len(task.given.time_s),), weak_copter.HOVER) for n in SPEEDS}
    place = [twin.channels.index(a) for a in "xyz"]
    sound = twin.with_share(0.0)
    seen = sound.simulate({n: c.double() for n, c in hover.items()})[:, place]
    np.testing.assert_allclose(seen[0], [0.0, 0.0, 1.0], atol=1e-4)
    weak = twin.simulate({n: c.double() for n, c in hover.items()})[:, place]
    assert weak[-1, 2] < seen[-1, 2] - 0.02 and (weak[-1, :2] - seen[-1, :2]).norm() > 0.02


@pytest.mark.cpu(8)
def test_the_legs_close_by_the_diagnosed_models_command(starfish):
    twin, task = starfish
    shown = slack_starfish.truth_of(twin.study)
    misses = []
    for model in (twin, twin.plain()):
        best = best_command(model, task, starts=[], evaluations=30)
        with torch.no_grad():
            commands = task.commands(torch.from_numpy(best.knots))
        first = twin.study.runs[0]
        run = type(first)(
            first.name,
            task.given.time_s,
            np.full((len(task.given.time_s), 1), np.nan),
            {"contraction": commands["contraction"].numpy()},
            "new",
        )
        misses.append(float(task.score(torch.from_numpy(shown(run)))))
    assert misses[0] < 0.5 * misses[1]


@pytest.mark.story
@pytest.mark.parametrize("case", CASES)
def test_what_it_buys_to_mend_the_cause(case, request):
    twin, task = request.getfixturevalue(case)
    found = {row.cause: row for row in worth(twin, task, evaluations=40)}
    row = found[CASES[case][1]]
    assert 1.01 * row.none < row.whole < row.unaware and row.half < row.whole


def test_a_start_is_of_what_says_where_it_starts(starfish, copter):
    study = starfish[0].study
    with pytest.raises(ValueError, match="says itself how its runs start"):
        Twin.read(starfish[0].saved, study, slack_starfish.T, start={"closing": 0.01})
    with pytest.raises(ValueError, match="start: channel"):
        Twin.read(copter[0].saved, copter[0].study, weak_copter.TASK.time_s, start={"zz": 1.0})
