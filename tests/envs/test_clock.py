"""A swimmer's clock: what it shows, and who listens to it."""

import math

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs
from diffsim.envs.soft_tasks import Advance, Reach
from diffsim.learn.recipes import RECIPES, recipe
from diffsim.learn.setup import clock_gains, first_controller
from tests.envs.cases import block


def test_it_shows_the_time_since_the_start() -> None:
    task = Advance(block(), 9, clock=(0.5, 2.0), substeps=2)
    state = task.start(2, np.random.default_rng(0))
    for _ in range(3):
        state, _ = task.step(state, torch.zeros(2, 1, dtype=torch.float64))
    time = 3 * 0.02
    hands = [f(2.0 * math.pi * rate * time) for rate in (0.5, 2.0) for f in (math.sin, math.cos)]
    torch.testing.assert_close(
        task.observe(state)[:, -4:], torch.tensor([hands] * 2, dtype=torch.float64)
    )
    plain = Advance(block(), 9, substeps=2)
    torch.testing.assert_close(task.observe(state)[:, :-4], plain.observe(state))


def test_members_of_a_batch_have_times_of_their_own() -> None:
    env = envs.TaskVectorEnv(Advance(block(), 9, clock=(1.0,)), 2, autoreset_mode="Disabled")
    env.reset(seed=0)
    env.step(np.zeros((2, 1)))
    seen, _ = env.reset(options={"reset_mask": np.array([True, False])})
    assert seen[0, -1] == 1.0
    assert seen[1, -1] == pytest.approx(math.cos(2.0 * math.pi * 0.01))


def test_it_is_on_the_data_sheet() -> None:
    task = Reach(block(), 9, clock=(1.0,), goal_low=(0.0,) * 3, goal_high=(0.1,) * 3)
    names = [entry.name for entry in task.observations]
    assert [names[k] for k in task.clock_inputs] == [
        "sine of a clock of 1 Hz",
        "cosine of a clock of 1 Hz",
    ]
    state = task.start(1, np.random.default_rng(0))
    assert task.observe(state)[0, list(task.clock_inputs)].tolist() == [0.0, 1.0]
    assert Advance(block(), 9).clock_inputs == ()


def test_a_balanced_network_hears_it_as_loud_as_its_sensors() -> None:
    task = Advance(block(), 9, clock=(0.5, 1.0))
    net, plain = (first_controller(task, 0, 2, balance_clock=b) for b in (True, False))
    gains = clock_gains(task)
    clocked = list(task.clock_inputs)
    assert float(gains[clocked].square().sum()) == pytest.approx(task.num_observations - 4)
    torch.testing.assert_close(net.layers[0].weight, plain.layers[0].weight * gains)
    assert net.layers[0].weight[:, clocked].norm() > net.layers[0].weight[:, :-4].norm() * 0.5


def test_bad_frequencies() -> None:
    with pytest.raises(ValueError, match="clock"):
        Advance(block(), 9, clock=(0.0,))


def test_recipes_fit_their_tasks_and_what_is_given_goes_first() -> None:
    for name, one in RECIPES.items():
        options = {} if "Copter" in name else {"robot": {"coarse": True}}
        if name != "SoftBody":  # which is nothing without a file
            one.setup_of(name, task_options=options).make_task()
        assert one.gradient_options(batch=7).batch == 7
    setup = recipe("diffsim/SharkSwim-v0").setup_of(
        "SharkSwim", task_options={"clock": ()}, seed=3, output_gain=0.1
    )
    assert (setup.task_options["clock"], setup.seed, setup.output_gain) == ((), 3, 0.1)
    assert recipe("CowWalk").setup_of("CowWalk").output_gain == 0.01  # none was measured
