"""What gymnasium's registry says of the environments, and time limits."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

import diffsim.envs as envs  # noqa: E402
from tests.envs.cases import COARSE  # noqa: E402


@pytest.mark.parametrize("env_id", envs.ENV_IDS)
def test_the_registered_length_is_the_tasks(env_id: str) -> None:
    options = {} if "Copter" in env_id else COARSE
    length = envs.make_task(env_id, **options).max_steps
    assert gymnasium.spec(env_id).max_episode_steps == length
    assert gymnasium.make(env_id, **options).spec.max_episode_steps == length


def test_thresholds_are_below_the_best_and_above_standing_still() -> None:
    spec = gymnasium.spec("diffsim/CopterHover-v0")
    assert 0.5 * spec.max_episode_steps < spec.reward_threshold < spec.max_episode_steps
    assert gymnasium.spec("diffsim/CowWalk-v0").reward_threshold is None  # nothing measured


def end_of(env: gymnasium.Env) -> int:
    env.reset(seed=0)
    for k in range(1, 1000):
        *_, terminated, truncated, _ = env.step(np.zeros(4, dtype=np.float32))
        assert not terminated
        if truncated:
            return k
    raise AssertionError


def test_lengths() -> None:
    still = {"start_spread": 0.0}
    assert end_of(gymnasium.make("diffsim/CopterHover-v0", max_episode_steps=4, **still)) == 4
    assert end_of(gymnasium.make("diffsim/CopterHover-v0", seconds=0.1, **still)) == 5
    longer = gymnasium.make("diffsim/CopterHover-v0", seconds=4.2, max_episode_steps=210, **still)
    assert end_of(longer) == 210


def test_a_time_limit_that_cuts_the_task_is_reported() -> None:
    """``seconds`` alone does not move gymnasium's limit."""
    env = gymnasium.make("diffsim/CopterHover-v0", seconds=5.0, start_spread=0.0)
    with pytest.warns(UserWarning, match="max_episode_steps=250"):
        assert end_of(env) == 200
        env.reset()


@pytest.mark.parametrize("length", [3, 250])
def test_lengths_of_the_native_batch(length: int) -> None:
    make = gymnasium.make_vec
    env = make("diffsim/CopterHover-v0", num_envs=2, max_episode_steps=length)
    assert env.unwrapped.task.max_steps == length
    env = make("diffsim/CopterHover-v0", num_envs=2, seconds=0.1)
    assert env.unwrapped.task.max_steps == 5
    with pytest.raises(ValueError, match="max_episode_steps"):
        make("diffsim/CopterHover-v0", num_envs=2, max_episode_steps=0)
