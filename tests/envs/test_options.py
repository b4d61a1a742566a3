"""Delay, randomization, noise, currents and substeps do what they say; refusals are clear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs  # noqa: E402
from diffsim.envs import registry  # noqa: E402
from diffsim.envs.soft_tasks import Advance, Reach  # noqa: E402
from diffsim.envs.task import where  # noqa: E402
from tests.envs.cases import OPTIONS, block  # noqa: E402


def run(task: envs.Task, commands: torch.Tensor, batch: int = 1, seed: int = 0) -> envs.TaskState:
    state = task.start(batch, np.random.default_rng(seed))
    for command in commands:
        state, _ = task.step(state, command.expand(batch, -1))
    return state


COMMANDS = torch.tensor([[1.0], [-0.5], [0.3], [0.8]], dtype=torch.float64)


@pytest.mark.parametrize("delay", [1, 2])
def test_delay_is_a_shift(delay: int) -> None:
    late = run(Advance(block(), 9, action_delay=delay), COMMANDS)
    zeros = torch.zeros(delay, 1, dtype=torch.float64)
    shifted = run(Advance(block(), 9), torch.cat([zeros, COMMANDS[:-delay]]))
    torch.testing.assert_close(late["x"], shifted["x"], rtol=0.0, atol=0.0)
    assert late["commands"].shape == (1, delay, 1)


@pytest.mark.parametrize(
    ("name", "quantities"),
    [
        ("SharkSwim", ("muscles", "water")),
        ("QuadrupedWalk", ("muscles",)),
        ("CopterHover", ("thrust",)),
    ],
)
def test_factors_of_one_are_nominal_and_others_are_not(name: str, quantities: tuple) -> None:
    def end(low: float, high: float) -> envs.TaskState:
        factors = dict.fromkeys(quantities, (low, high))
        task = envs.make_task(name, randomization=envs.Randomization(factors), **OPTIONS[name])
        return run(task, 0.7 * torch.ones(3, task.num_actions).double(), batch=2)

    task = envs.make_task(name, **OPTIONS[name])
    nominal = run(task, 0.7 * torch.ones(3, task.num_actions).double(), batch=2)
    same, other = end(1.0, 1.0), end(0.5, 0.9)
    key = "x" if "x" in nominal else "velocity"
    torch.testing.assert_close(same[key], nominal[key], rtol=0.0, atol=0.0)
    assert not torch.allclose(other[key], nominal[key])
    for quantity in quantities:
        drawn = other[f"random.{quantity}"]
        assert bool((drawn >= 0.5).all() and (drawn <= 0.9).all())
        assert drawn[0] != drawn[1]  # per member


def test_substeps_are_steps_under_a_held_command() -> None:
    fast = run(Advance(block(), 9), COMMANDS.repeat_interleave(3, 0))
    slow = Advance(block(), 9, substeps=3)
    assert slow.dt == pytest.approx(0.03)
    torch.testing.assert_close(run(slow, COMMANDS)["x"], fast["x"], rtol=0.0, atol=0.0)


def test_rewards_sum_to_the_distance() -> None:
    task = Advance(block(on_floor=True), 9, substeps=2, drift_weight=0.0, speed_scale=1.0)
    state = task.start(1, np.random.default_rng(0))
    first, total = task.robot.center(state["x"]), 0.0
    for command in COMMANDS:
        state, reward = task.step(state, command[None])
        total += float(reward) * task.dt
    assert total == pytest.approx(float(task.robot.center(state["x"])[0, 0] - first[0, 0]))


def test_current_carries_a_swimmer() -> None:
    task = Advance(block(water=True), 9, current=0.5)
    state = task.start(3, np.random.default_rng(0))
    current = state["current"].clone()
    for _ in range(5):
        state, _ = task.step(state, torch.zeros(3, 1, dtype=torch.float64))
    torch.testing.assert_close(state["current"], current)
    gained = task.robot.center(state["v"])
    assert bool(((gained * current).sum(-1) > 0.0).all())


def test_start_is_stirred_but_at_rest_as_a_whole() -> None:
    task = Advance(block(water=True), 9, start_speed=0.1)
    state = task.start(4, np.random.default_rng(0))
    torch.testing.assert_close(
        task.robot.center(state["v"]), torch.zeros(4, 3, dtype=torch.float64)
    )
    assert 0.02 < float(state["v"].norm(dim=-1).max()) < 1.0


def test_noise_is_seeded_and_of_its_size() -> None:
    quiet = envs.make_vector("CopterHover", 64, start_spread=0.0)
    noisy = envs.make_vector("CopterHover", 64, start_spread=0.0, sensor_noise=0.1)
    plain, _ = quiet.reset(seed=1)
    first, _ = noisy.reset(seed=1)
    again, _ = noisy.reset(seed=1)
    np.testing.assert_array_equal(first, again)
    assert (first - plain).std() == pytest.approx(0.1, rel=0.1)
    other, _ = noisy.reset(seed=2)
    assert (other != first).all()
    per_sensor = np.zeros(quiet.task.num_observations)
    per_sensor[0] = 1.0
    only, _ = envs.make_vector("CopterHover", 4, start_spread=0.0, sensor_noise=per_sensor).reset(
        seed=0
    )
    np.testing.assert_array_equal(only[:, 1:], plain[:4, 1:])


def test_goals_lie_in_their_box() -> None:
    low, high = (-0.1, 0.0, 0.2), (0.1, 0.0, 0.3)
    task = Reach(block(), 5, goal_low=low, goal_high=high)
    state = task.start(50, np.random.default_rng(0))
    away = state["goal"] - task.robot.body.x_rest[task.node]
    assert bool((away >= torch.tensor(low) - 1e-9).all())
    assert bool((away <= torch.tensor(high) + 1e-9).all())
    torch.testing.assert_close(task.observe(state)[:, -3:], away)


def test_observations_match_their_data_sheet() -> None:
    for name, options in OPTIONS.items():
        task = envs.make_task(name, **options)
        state = task.start(2, np.random.default_rng(0))
        assert task.observe(state).shape == (2, task.num_observations)
        sheet = task.data_sheet()
        assert sheet.count("\n| ") == task.num_actions + task.num_observations + 1
        env = getattr(registry, f"{name}Env")
        assert "actions" in env.__doc__ or "As ``" in env.__doc__
        assert "versions" in env.__doc__


def test_where_and_attitude() -> None:
    yes, no = {"a": torch.ones(2, 3)}, {"a": torch.zeros(2, 3)}
    assert where(torch.tensor([True, False]), yes, no)["a"].sum(1).tolist() == [3.0, 0.0]
    robot = block(on_floor=True)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double()
    x = robot.body.x_rest @ turn.T + 3.0
    torch.testing.assert_close(robot.attitude(x), turn)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"num_steps": 0}, "num_steps must be a whole number"),
        ({"substeps": 1.5}, "substeps must be a whole number"),
        ({"current": 0.1}, "not in water"),
        ({"start_speed": -1.0}, "start_speed"),
        ({"action_delay": -1}, "action_delay"),
        ({"randomization": envs.Randomization({"water": (0.5, 1.0)})}, "randomization"),
        ({"randomization": envs.Randomization({"muscles": (1.0, 0.5)})}, "low <= high"),
    ],
)
def test_refusals(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Advance(block(), **({"num_steps": 5} | options))


def test_refusals_of_environments() -> None:
    with pytest.raises(ValueError, match="StarfishSwim"):
        envs.make_task("StarfishSwin")
    env = envs.TaskEnv(Advance(block(), 5))
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(np.zeros(1))
    vector = envs.TaskVectorEnv(Advance(block(), 5), 2)
    with pytest.raises(RuntimeError, match="reset"):
        vector.step(np.zeros((2, 1)))
    vector.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        vector.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="render_mode"):
        envs.TaskEnv(Advance(block(), 5), render_mode="window")
    with pytest.raises(ValueError, match="goal_low"):
        Reach(block(), 5, goal_low=(0.0, 0.0, 0.1), goal_high=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="drive must have shape"):
        replace(block(), command_names=("a", "b"))
