"""Pictures as observations, by gymnasium's own wrapper: alone, and beside the numbers."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import gymnasium
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation

import diffsim.envs  # noqa: F401  # registers the environments


def hover():
    return gymnasium.make("diffsim/CopterHover-v0", render_mode="rgb_array", max_episode_steps=3)


def test_a_picture_is_the_observation() -> None:
    env = AddRenderObservation(hover(), render_only=True)
    first, _ = env.reset(seed=0)
    assert env.observation_space.contains(first)
    assert first.shape == (360, 480, 3)
    for _ in range(2):
        last, *_ = env.step(np.ones(4, dtype=np.float32))
    assert int(np.abs(last.astype(int) - first).max()) > 100  # it has moved
    assert (last != 255).any(axis=-1).mean() > 0.002  # lines on white


def test_a_picture_stands_beside_the_numbers() -> None:
    env = AddRenderObservation(hover(), render_only=False, render_key="picture", obs_key="state")
    seen, _ = env.reset(seed=0)
    assert seen["state"].shape == (22,)
    np.testing.assert_array_equal(seen["picture"], env.render())
    check_env(env, skip_render_check=True)
