"""Every registered environment keeps gymnasium's contracts."""

import pickle

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

import diffsim.envs as envs  # noqa: E402
from tests.envs.cases import OPTIONS, STEPS  # noqa: E402

NAMES = sorted(OPTIONS)


def make(name: str, **more: object) -> gymnasium.Env:
    return gymnasium.make(f"diffsim/{name}-v0", **OPTIONS[name], **more)


def actions(name: str, count: int, seed: int = 0) -> np.ndarray:
    task = envs.make_task(name, **OPTIONS[name])
    shape = (count, STEPS, task.num_actions)
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


def test_all_ids_are_covered() -> None:
    assert sorted(envs.ENV_IDS) == sorted(f"diffsim/{name}-v0" for name in OPTIONS)
    assert all(name in gymnasium.registry for name in envs.ENV_IDS)


@pytest.mark.parametrize("name", NAMES)
def test_check_env(name: str) -> None:
    env = make(name, render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    picture = env.unwrapped.render()
    assert picture.dtype == np.uint8
    assert picture.shape == (360, 480, 3)
    assert picture.std() > 5.0  # something is drawn


@pytest.mark.parametrize("name", NAMES)
def test_equal_seeds_equal_rollouts_also_after_pickling(name: str) -> None:
    env = make(name, sensor_noise=0.01)
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    again = gymnasium.make(pickle.loads(pickle.dumps(env.spec)))
    runs = []
    for each in (env, copy, again):
        seen = [each.reset(seed=7)[0]]
        for action in actions(name, 1)[0][:3]:
            observation, reward, *_ = each.step(action)
            seen.append(np.append(observation, reward))
        runs.append(np.concatenate(seen))
    for run in runs[1:]:
        np.testing.assert_array_equal(run, runs[0])
    other, _ = env.reset(seed=8)
    assert (other != runs[0][: len(other)]).any()


@pytest.mark.parametrize("name", NAMES)
def test_vector_member_is_the_single_environment(name: str) -> None:
    vector = gymnasium.make_vec(f"diffsim.envs:diffsim/{name}-v0", num_envs=2, **OPTIONS[name])
    vector.reset(seed=3)
    singles = []
    for k in range(2):
        single = make(name).unwrapped
        single.reset(seed=0)
        single.state = {key: value[k : k + 1].clone() for key, value in vector.state.items()}
        singles.append(single)
    for row in actions(name, 2).transpose(1, 0, 2)[:-1]:
        observations, rewards, *_ = vector.step(row)
        for k, single in enumerate(singles):
            observation, reward, *_ = single.step(row[k])
            np.testing.assert_allclose(observations[k], observation, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(rewards[k], reward, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["CopterTrack", "StarfishSwim", "TorusRoll"])
def test_episodes_restart_within_the_step(name: str) -> None:
    vector = gymnasium.make_vec(f"diffsim/{name}-v0", num_envs=2, **OPTIONS[name])
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    vector.reset(seed=0)
    rows = actions(name, 2).transpose(1, 0, 2)
    for k, row in enumerate(rows):
        before = {key: value.clone() for key, value in vector.state.items()}
        observations, _, terminated, truncated, info = vector.step(row)
        assert not terminated.any()
        assert truncated.all() == (k == STEPS - 1)
        assert ("final_obs" in info) == (k == STEPS - 1)
    after, _ = vector.task.step(before, torch.from_numpy(row).double())
    last = vector.task.observe(after).detach().numpy().astype(np.float32)
    np.testing.assert_allclose(np.stack(info["final_obs"]), last, rtol=1e-5, atol=1e-7)
    assert (vector.state["step"] == 0).all()
    assert not np.array_equal(observations, last)


def test_a_fallen_robot_ends_its_episode() -> None:
    env = make("QuadrupedWalk").unwrapped
    env.reset(seed=0)
    x = env.state["x"]
    env.state["x"] = torch.stack([x[..., 0], -x[..., 2] + 0.1, x[..., 1] + 0.1], -1)
    *_, terminated, truncated, _ = env.step(np.zeros(8, dtype=np.float32))
    assert terminated
    assert not truncated
    assert not make("StarfishSwim").unwrapped.task.failed({"step": torch.zeros(1)}).any()
