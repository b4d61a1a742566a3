"""Tasks of described soft bodies: simulated as in a study, differentiable, checked key by key."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import diffsim.envs as envs  # noqa: E402
from diffsim.envs.soft_body import SoftBody  # noqa: E402
from tests.envs.soft_files import FISH, block_on_floor, finger, with_model, written  # noqa: E402
from tests.envs.test_gradients import check_step  # noqa: E402

SHORT = {"seconds": 0.2}


def made(keys: dict[str, Any], **more: Any) -> SoftBody:
    task = envs.make_task("SoftBody", **{**keys, **more})
    assert isinstance(task, SoftBody)
    return task


def stepped(task: SoftBody, batch: int, steps: int = 3, seed: int = 0) -> envs.TaskState:
    state = task.start(batch, np.random.default_rng(seed))
    commands = torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, (steps, task.num_actions)))
    for command in commands:
        state, _ = task.step(state, command.expand(batch, -1))
    return state


@pytest.mark.reference
def test_it_moves_as_the_scene_that_predicts_recordings() -> None:
    """Without forces of water or hung weights to the last bits of the solver's tolerance."""
    task = made(finger())
    action = torch.tensor([[0.7]], dtype=torch.float64)
    state = task.start(1, np.random.default_rng(0))
    for _ in range(3):
        state, _ = task.step(state, action)
    held = torch.full((8, 1), 0.7 * 0.2, dtype=torch.float64)
    plain = task.robot.scene
    scene = plain.changed(
        commands=replace(plain.commands, values=held.mT),
        command_dt=0.01,
        observe=lambda x: x.flatten(-2),
        start="rest",
    )
    moved = scene.motion(6)[-1].reshape(-1, 3)
    assert float((moved - task.robot.body.x_rest).abs().max()) > 1e-3
    torch.testing.assert_close(state["x"][0], moved, rtol=0.0, atol=1e-9)


def test_a_tip_reaches_up_and_is_paid_for_it() -> None:
    task = made(finger())
    start = task.start(1, np.random.default_rng(0))
    up, reward = task.step(start, torch.ones(1, 1, dtype=torch.float64))
    _, away = task.step(start, -torch.ones(1, 1, dtype=torch.float64))
    assert float(task.robot.middle(["tip"], up["x"])[0, 2]) > 0.01
    assert float(reward) > float(away)
    seen = task.observe(start)[0]
    torch.testing.assert_close(seen[-3:], torch.tensor([-0.01, 0.0, 0.03]).double())


def test_goals_are_drawn_from_their_box() -> None:
    box = {"markers": ["tip", "middle"], "low": [0.0, 0.01, 0.0], "high": ["8 cm", 0.01, 0.04]}
    state = made(finger(goal=box)).start(50, np.random.default_rng(0))
    low, high = (torch.tensor(c).double() for c in ([0.0, 0.01, 0.0], [0.08, 0.01, 0.04]))
    assert bool(((state["goal"] >= low - 1e-6) & (state["goal"] <= high + 1e-6)).all())
    assert float(state["goal"][:, 0].std()) > 0.01


@pytest.mark.grad
@pytest.mark.parametrize("kind", ["finger", "floor"])
def test_gradients_against_finite_differences(kind: str) -> None:
    keys = finger() if kind == "finger" else block_on_floor()
    small = {"bar": {"size": [0.08, 0.02, 0.02], "cells": [2, 1, 2]}}
    task = made(with_model(keys, body=small))
    check_step(task, stepped(task, 1, 2), ("x", "v") if kind == "finger" else ("v",))


@pytest.mark.grad
@pytest.mark.parametrize("term", ["speed", "drift", "distance", "change", "energy", "effort"])
def test_gradients_of_a_swimmers_rewards(term: str) -> None:
    """Along one direction: water bends so much with its angle that steps must be short."""
    keys = with_model(finger(current=0.05, reward=[{"term": term}]), fixed=[], water={})
    task = made(keys)
    state = stepped(task, 1, 2)
    at = {"x": state["x"], "v": state["v"], "action": torch.tensor([[0.9]]).double()}
    generator = torch.Generator().manual_seed(0)
    way = {n: torch.randn(v.shape, generator=generator).double() for n, v in at.items()}

    def reward(values: dict[str, torch.Tensor]) -> torch.Tensor:
        moved = {n: values[n] for n in ("x", "v")}
        return task.step(state | moved, values["action"])[1].sum()

    inputs = {n: v.clone().requires_grad_() for n, v in at.items()}
    parts = torch.autograd.grad(reward(inputs), list(inputs.values()), allow_unused=True)
    slopes = {n: g for n, g in zip(inputs, parts, strict=True) if g is not None}
    assert "action" in slopes
    for name, slope in slopes.items():
        ends = [float(reward({**at, name: at[name] + e * way[name]})) for e in (1e-7, -1e-7)]
        known = float((slope * way[name]).sum())
        # halves of 1e-7 of curved rewards, and rounding of 1e-13 over it
        assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(known, rel=1e-3, abs=1e-5)


def test_a_start_that_is_stirred_neither_travels_nor_moves_what_is_held() -> None:
    free, held = made(block_on_floor(), start_speed=0.05), made(finger(), start_speed=0.05)
    v = free.start(4, np.random.default_rng(0))["v"]
    still = torch.zeros(4, 3, dtype=torch.float64)
    torch.testing.assert_close(free.robot.center(v), still, rtol=0.0, atol=1e-12)
    assert 0.005 < float(v.norm(dim=-1).max()) < 0.25
    fixed = held.start(4, np.random.default_rng(0))["v"][:, held.robot.body.fixed]
    assert not bool(fixed.any())


@pytest.mark.parametrize("keys", [finger(), block_on_floor()], ids=["finger", "floor"])
def test_a_batch_is_its_members(keys: dict[str, Any]) -> None:
    task = made(keys, start_speed=0.05)
    many = task.start(3, np.random.default_rng(0))
    action = torch.tensor([[0.5], [-1.0], [0.1]], dtype=torch.float64)
    after, rewards = task.step(many, action)
    for k in range(3):
        one = {name: value[k : k + 1] for name, value in many.items()}
        alone, reward = task.step(one, action[k : k + 1])
        torch.testing.assert_close(alone["x"][0], after["x"][k], rtol=0.0, atol=1e-10)
        torch.testing.assert_close(reward[0], rewards[k], rtol=1e-6, atol=1e-8)


def test_random_factors_act_on_each_member() -> None:
    names = ("drives", "stiffness", "density")
    plain = stepped(made(finger()), 2)
    same = stepped(made(finger(), randomization={n: [1.0, 1.0] for n in names}), 2)
    torch.testing.assert_close(same["x"], plain["x"], rtol=0.0, atol=1e-12)
    for name in names:
        other = stepped(made(finger(), randomization={name: [0.5, 0.8]}), 2)
        assert float((other["x"][0] - other["x"][1]).abs().max()) > 1e-5


def test_a_command_twice_as_far_is_two_muscles_shortened() -> None:
    """Actions between the stated ends; a delay holds them back."""
    task = made(finger(commands={"bend": [0.0, 0.2]}, action_delay=1))
    state = task.start(1, np.random.default_rng(0))
    state, _ = task.step(state, torch.ones(1, 1, dtype=torch.float64))
    assert float(task._command(state, state["action"])) == pytest.approx(0.1)  # the middle
    state, _ = task.step(state, torch.ones(1, 1, dtype=torch.float64))
    assert float(task._command(state, state["action"])) == pytest.approx(0.2)


def test_energy_that_comes_back_pays_nothing() -> None:
    """A muscle that lets go takes energy out of the body."""
    task = made(finger(reward=[{"term": "energy", "per": "1 mW"}], control_step=0.01))
    state = task.start(1, np.random.default_rng(0))
    one = torch.ones(1, 1, dtype=torch.float64)
    for k in range(20):  # until it rests
        state, pays = task.step(state, one)
        assert k or float(pays) < 0.0
    assert float(task.step(state, 0.5 * one)[1]) == 0.0


@pytest.mark.filterwarnings("ignore:.*observation space:UserWarning")
def test_gymnasium_checks_the_fish() -> None:
    env = gymnasium.make("diffsim/Task-v0", name=str(FISH), render_mode="rgb_array", **SHORT)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.task.name == "fish"
    assert env.unwrapped.render().std() > 5.0
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    seen = [each.reset(seed=3)[0] for each in (env, copy)]
    np.testing.assert_array_equal(*seen)
    batch = gymnasium.make_vec("diffsim/Task-v0", num_envs=2, name=str(FISH), **SHORT)
    batch.reset(seed=0)
    assert batch.unwrapped.task.max_steps == 5
    for _ in range(6):
        observations, rewards, _, truncated, _ = batch.step(batch.action_space.sample())
    assert observations.shape == (2, 28)
    assert np.isfinite(rewards).all()
    assert not truncated.any()


def test_episodes_end_as_the_file_says() -> None:
    task = made(block_on_floor())
    state = task.start(4, np.random.default_rng(0))
    turned, far = state["x"][1].clone(), state["x"][2].clone()
    turned[:, [0, 2]] = state["x"][1][:, [2, 0]] * torch.tensor([1.0, -1.0]).double()
    state["x"][1], state["x"][2] = turned, far + 0.6
    assert task.failed(state).tolist() == [False, True, True, False]
    low = made(finger(ends={"below": "2 cm"}))
    assert bool(low.failed(low.start(1, np.random.default_rng(0))))


def test_tendons_are_driven_in_their_unit() -> None:
    tendon = {"name": "cable", "command": "pull", "path": [[0, 0.01, 0.018], [0.08, 0.01, 0.018]],
              "axial_stiffness": 50}  # fmt: skip
    task = made(with_model(finger(commands={"pull": [0, "5 mm"]}), muscles=[], tendons=[tendon]))
    assert task.robot.units == ("m",)
    start = task.start(1, np.random.default_rng(0))
    after, _ = task.step(start, torch.ones(1, 1, dtype=torch.float64))
    assert float(task.robot.middle(["tip"], after["x"])[0, 2]) > 0.0101
    with pytest.raises(ValueError, match=r"commands\.pull: unit 'kPa'"):
        made(with_model(finger(commands={"pull": [0, "5 kPa"]}), muscles=[], tendons=[tendon]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"comands": {}}, r"no key 'comands' here; did you mean"),
        ({"commands": {"bent": [0, 1]}}, r"driven by 'bent'; did you mean 'bend'"),
        ({"commands": {}}, r"commands: bend is missing"),
        ({"commands": {"bend": [0.1, 0.1]}}, r"commands\.bend must be two finite numbers"),
        ({"reward": []}, r"reward: must have 1 or more"),
        ({"reward": [{"term": "sped"}]}, r"reward\[0\]: term must be one of.*speed"),
        ({"reward": [{"term": "speed", "per": 0}]}, r"reward\[0\]\.per: must be above 0"),
        ({"reward": [{"term": "speed", "along": [0, 0, 0]}]}, r"reward\[0\]\.along: must be a dir"),
        ({"reward": [{"weight": 1}]}, r"reward\[0\]: must be a mapping with `term`"),
        ({"reward": [{"term": "alive"}] * 2}, r"the term alive stands twice"),
        ({"goal": None}, r"goal is missing, which distance needs"),
        ({"goal": {"markers": "tipp", "at": [0, 0, 0]}}, r"no marker 'tipp' in model"),
        ({"goal": {"markers": "tip", "low": [0, 0, 0]}}, r"give at, or low and high"),
        ({"control_step": 0.015}, r"control_step must be a whole number of the model's time steps"),
        ({"current": 0.1}, r"current must be 0: model has no water"),
        ({"randomization": {"water": [1, 2]}}, r"randomization must be one of"),
        ({"seconds": -1}, r"seconds: must be above 0, got -1"),
        ({"seconds": float("nan")}, r"seconds: must be"),
        ({"folder": "/"}, r"no key 'folder'"),
    ],
)
def test_a_wrong_key_is_told_with_its_path(tmp_path, changes, message) -> None:
    path = written(tmp_path, finger(**changes))
    with pytest.raises(ValueError, match=message) as caught:
        envs.make_task(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"muscles": []}, "nothing drives the body|nothing in model is driven"),
        ({"numerics": {"motion": "quasi_static"}}, r"model\.numerics\.motion must be dynamic"),
        ({"walls": [{"normal": [0, 0, 1]}]}, r"model\.numerics\.integrator must be one of"),
        ({"fixed": [], "start": {}}, r"model\.start\.shape: no equilibrium"),
        ({"fixed": [{"x": 1}]}, r"fixed\[0\]: no node of the body lies there"),
        ({"markers": {"tip": [1, 0, 0]}}, r"markers\.tip: .* lies outside of the body"),
        ({"body": {"file": {"path": "../fish.inp"}}}, "must stay in its folder"),
        ({"body": {"file": {"path": "none.inp"}}}, "none.inp"),
        ({"materials": {}}, r"model: no key 'materials' here; did you mean"),
    ],
)
def test_a_wrong_model_is_told_with_its_path(tmp_path, changes, message) -> None:
    path = written(tmp_path, with_model(finger(), **changes))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        envs.make_task(path)
