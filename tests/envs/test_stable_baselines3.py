"""The adapter to stable-baselines3."""

import tempfile

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs
from tests.envs.cases import OPTIONS, STEPS
from tests.optional import needs

needs("stable_baselines3", reason="the adapter needs the extra 'rl'")


@pytest.mark.parametrize("name", ["CopterHover", "SharkSwim"])
def test_single_environments_pass_its_checker(name: str) -> None:
    from stable_baselines3.common.env_checker import check_env

    check_env(envs.TaskEnv(envs.make_task(name, **OPTIONS[name])))


def test_truncated_episodes_are_marked_and_counted() -> None:
    from stable_baselines3.common.vec_env import VecMonitor

    inner = envs.make_vector("SharkSwim", 2, **OPTIONS["SharkSwim"])
    env = VecMonitor(envs.Sb3VecEnv(inner))
    env.seed(1)
    first = env.reset()
    env.seed(1)
    np.testing.assert_array_equal(env.reset(), first)
    total = np.zeros(2)
    for _ in range(STEPS):
        observation, reward, done, infos = env.step(0.5 * np.ones((2, 1), dtype=np.float32))
        total += reward
    assert done.all()
    for k, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"].shape == observation[k].shape
        assert info["episode"]["l"] == STEPS
        np.testing.assert_allclose(info["episode"]["r"], total[k], rtol=1e-4, atol=1e-6)


def test_failed_episodes_are_not_truncated() -> None:
    inner = envs.make_vector("CopterHover", 2)
    env = envs.Sb3VecEnv(inner)
    env.reset()
    inner.state["position"][0] += 100.0
    _, _, done, infos = env.step(np.zeros((2, 4), dtype=np.float32))
    assert done.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is False


def test_ppo_learns_something_runnable(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))  # a folder in /tmp otherwise
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    inner = envs.make_vector("CopterHover", 4, **OPTIONS["CopterHover"])
    env = VecNormalize(VecMonitor(envs.Sb3VecEnv(inner)))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == (4, 4)


def test_training_leaves_no_folder_behind(tmp_path, monkeypatch) -> None:
    from stable_baselines3 import PPO

    from diffsim.learn.stable_baselines3 import learn

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    env = envs.Sb3VecEnv(envs.make_vector("CopterHover", 2, **OPTIONS["CopterHover"]))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    assert learn(model, 32).steps == 32
    assert not list(tmp_path.iterdir())


def test_interface_of_vec_env() -> None:
    env = envs.Sb3VecEnv(envs.make_vector("CopterHover", 3, render_mode="rgb_array"))
    env.reset()
    assert env.get_attr("num_envs", [0, 2]) == [3, 3]
    assert env.env_is_wrapped(object) == [False] * 3
    assert len(env.get_images()) == 3
    with pytest.raises(RuntimeError, match="step_async"):
        env.step_wait()
