"""Environments as gymnasium's registry and their pages have them; pictures as observations."""

from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.wrappers import AddRenderObservation  # noqa: E402

import diffsim.envs as envs  # noqa: E402
from tests.envs.cases import COARSE  # noqa: E402
from tests.scripts import load_script  # noqa: E402


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


def test_pages_are_up_to_date() -> None:
    """Where this fails: python scripts/environment_pages.py."""
    module = load_script("environment_pages.py")
    kept = {path.name: path.read_text(encoding="utf-8") for path in module.FOLDER.glob("*.md")}
    assert kept == module.pages()


def test_every_page_has_its_picture() -> None:
    module = load_script("environment_pages.py")
    for name in module.pages().keys() - {"README.md"}:
        assert (module.IMAGES / f"env_{Path(name).stem}.png").stat().st_size > 5_000


def test_what_a_page_shows_is_a_motion_of_its_environment() -> None:
    """Three moments of the arm, whose nodes have moved."""
    found = load_script("environment_pages.py").moments("TendonReach")
    assert len(found) == 3
    (task, first), (_, second), (_, last) = found
    assert (first["x"] - second["x"]).abs().max() > 0.01
    assert task.picture(last, 0).shape == (360, 480, 3)


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
