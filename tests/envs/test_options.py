"""Delay, randomization, noise, currents and substeps do what they say; refusals are clear."""

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


@pytest.mark.parametrize("on_floor", [False, True])
def test_the_reward_of_advancing_is_that_of_its_data_sheet(on_floor: bool) -> None:
    weights = {"drift_weight": 0.7, "rise_weight": 0.3, "speed_scale": 0.2}
    task = Advance(block(on_floor=on_floor), 9, substeps=2, **weights)
    rng = np.random.default_rng(0)
    state, moved = task.start(3, rng), 0.003 * rng.standard_normal((3, 3))
    after = {**state, "x": state["x"] + torch.from_numpy(moved)[:, None]}
    ahead, aside, up = (moved / (0.2 * task.dt)).T
    across = np.hypot(aside, 0.0 if on_floor else up)
    expected = ahead - 0.7 * (np.hypot(across, 0.01) - 0.01) + 0.3 * up
    found = sum(task.reward_terms(state, COMMANDS[:3], after).values())
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_reward_of_reaching_is_that_of_its_data_sheet() -> None:
    goals = {"goal_low": [0.01, 0.0, -0.05], "goal_high": [0.05, 0.02, 0.0]}
    task = Reach(block(), 9, node=7, effort_weight=0.2, **goals)
    state = task.start(3, np.random.default_rng(0))
    away = np.linalg.norm(state["goal"] - state["x"][:, 7], axis=1) / 0.2  # m, of a robot that long
    effort = (COMMANDS[:3].numpy() ** 2).mean(1)
    found = task.reward_terms(state, COMMANDS[:3], state)
    np.testing.assert_allclose(found["distance"], 0.01 - np.hypot(away, 0.01), rtol=1e-9)
    np.testing.assert_allclose(found["effort"], -0.2 * effort, rtol=1e-12)


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


# mistakes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"desing": "quadcopter"},
            "option of CopterHover .*'desing'; did you mean 'design'",
        ),
        ({"randomisation": {}}, "'randomisation'; did you mean 'randomization'"),
        ({"randomization": {"thurst": (0.9, 1.1)}}, "'thurst'; did you mean 'thrust'"),
        ({"randomization": {"thrust": 0.9}}, r"randomization\['thrust'\] must be \(low, high\)"),
        ({"randomization": {"thrust": (0.9, np.inf)}}, r"must be \(low, high\)"),
        (
            {"randomization": [0.9, 1.1]},
            r"randomization must map .*\{'thrust': \(0.8, 1.2\)\}",
        ),
        ({"action_delay": 1.5}, "action_delay must be a whole number >= 0, got 1.5"),
        ({"action_delay": "one"}, "action_delay must be a number, got str"),
        ({"dt": [0.02]}, "dt must be a number, got list"),
    ],
)
def test_wrong_options_are_named(options: dict, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        envs.make_task("CopterHover", **options)


def test_wrong_options_of_a_robot_offer_the_closest() -> None:
    with pytest.raises(ValueError, match=r"option of robot starfish .*did you mean 'coarse'"):
        envs.make_task("StarfishSwim", robot={"coarser": True})
    with pytest.raises(ValueError, match=r"num_steps must be a whole number >= 1, got 5.5"):
        envs.make_task("StarfishSwim", **{**OPTIONS["StarfishSwim"], "num_steps": 5.5})
    with pytest.raises(ValueError, match=r"option of StarfishSwim .*'rise_wieght'.*'rise_weight'"):
        gymnasium.make("diffsim/StarfishSwim-v0", rise_wieght=1.0)


def test_a_plain_mapping_randomizes() -> None:
    task = envs.make_task("CopterHover", randomization={"thrust": [0.5, 0.9]})
    drawn = task.start(3, np.random.default_rng(0))["random.thrust"]
    assert bool((drawn >= 0.5).all() and (drawn <= 0.9).all()) and drawn[0] != drawn[1]


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ([0.1, 0.2], r"sensor_noise must have shape \(22,\), got \(2,\); give one standard"),
        (-0.1, "sensor_noise must lie in .*got -0.1"),
        ([0.1] * 21 + [np.nan], "sensor_noise must lie in .*got nan"),
        (np.inf, "sensor_noise must lie in .*got inf"),
        ("loud", "sensor_noise must be numbers, got 'loud'"),
    ],
)
def test_wrong_noise_is_named(noise: object, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        envs.TaskEnv(envs.make_task("CopterHover"), sensor_noise=noise)  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [2.5, 0, True, "two", None, np.nan])
def test_wrong_numbers_of_members_are_refused(count: object) -> None:
    with pytest.raises((TypeError, ValueError), match="num_envs must"):
        envs.make_vector("CopterHover", count)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros((2, 2)), r"action must have shape \(4,\).* got \(2, 2\)"),
        (np.zeros((1, 4)), r"got \(1, 4\)"),
        (np.zeros(3), r"got \(3,\)"),
        (0.0, r"got \(\)"),
        ([0.0, 0.0, np.nan, 0.0], "action must be finite"),
        ([0.0, "up", 0.0, 0.0], "action must be numbers"),
        (None, "action must"),
    ],
)
def test_wrong_actions_are_named(action: object, message: str) -> None:
    env = envs.TaskEnv(envs.make_task("CopterHover"))
    env.reset(seed=0)
    with pytest.raises((TypeError, ValueError), match=message):
        env.step(action)  # type: ignore[arg-type]
    vector = envs.make_vector("CopterHover", 2)
    vector.reset(seed=0)
    with pytest.raises((TypeError, ValueError), match=r"action must"):
        vector.step(action)  # type: ignore[arg-type]


def test_lists_are_actions_too() -> None:
    ends = []
    for action in ([0.1, 0.2, 0.3, 0.4], np.array([0.1, 0.2, 0.3, 0.4]), torch.arange(1, 5) / 10):
        env = envs.TaskEnv(envs.make_task("CopterHover"))
        env.reset(seed=0)
        ends.append(env.step(action)[0])  # type: ignore[arg-type]
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_allclose(ends[0], ends[2], atol=1e-6)


def test_stepping_past_the_end_is_refused() -> None:
    env = envs.TaskEnv(envs.make_task("CopterHover", seconds=0.04))
    env.reset(seed=0)
    assert [env.step(np.zeros(4))[3] for _ in range(2)] == [False, True]
    with pytest.raises(gymnasium.error.ResetNeeded, match="has ended after 2 steps; call reset"):
        env.step(np.zeros(4))
    env.reset(seed=0)
    env.step(np.zeros(4))


def test_options_of_reset_are_not_dropped() -> None:
    env = envs.TaskEnv(envs.make_task("CopterHover"))
    with pytest.raises(ValueError, match=r"options\['gust'\] is no quantity of"):
        env.reset(options={"gust": 3.0})
